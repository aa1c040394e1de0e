"""Generated C beside JAX: a million steps from common states, a hundred closed loops of a minute.

How it is run is at the head of `export_builds.py`.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, field, fields

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.benchmarks.export_builds import (
    FAST,
    KINDS,
    PATH,
    Fleet,
    Plants,
    code,
    needs,
    pilot,
    three_floors,
)
from tests.control.test_estimator import SENSED, adversary
from tests.helpers.c_against_jax import LEAST, Batch, Source, records, wander
from tests.helpers.compiled_c import CompiledC

SHARE = float(os.environ.get("SLIPID_BENCH_SHARE", "1"))
"""Part of all steps and runs that is done, to try the benchmark."""
STEPS = {"wander": 1_000_000, "extreme": 10_000}
ROBOTS, ROWS_OF_BATCH = 50, 40
BARS = {"double": 1e-12, "float": 1e-5}
NUDGE, NUDGES = 1e-14, 24
"""What states and inputs of a doubtful step are changed by, relatively, and how often."""
TIE = 1e-9
"""Change of JAX's own result by such a nudge from which it is a decision that falls otherwise."""
LOOPS, PERIODS = 100, 1200


# steps ----------------------------------------------------------------------------------------


def extreme(key, angle):
    """Readings most of which are broken in some way."""
    z, dt, _ = adversary(key, len(angle), angle)
    return jax.vmap(SENSED.unravel)(z), dt


def source(row: str, drawn: str) -> Source:
    draw = wander(three_floors().wheels) if drawn == "wander" else extreme
    return Source(pilot(row), draw, ROBOTS, ROWS_OF_BATCH)


def flat(tree) -> dict[str, np.ndarray]:
    """Fields of states, estimates and commands after a step, a row of numbers each."""
    paths = jax.tree_util.tree_leaves_with_path(tree)
    rows = {jax.tree_util.keystr(p, simple=True, separator="."): np.asarray(x) for p, x in paths}
    return {k: x.reshape(len(x), -1).astype(float) for k, x in rows.items() if x.size}


def by_c(compiled: CompiledC, batch: Batch) -> dict[str, np.ndarray]:
    """The same of generated code, under the names that JAX's have."""
    count, names = len(batch.dt), list(flat(batch.after))
    parts = (compiled.estimator, compiled.controller, compiled.reading)
    trees = (batch.seen, batch.held, batch.reading)
    seen, held, z = (records(p, t, count) for p, t in zip(parts, trees, strict=True))
    said, command = compiled.many(seen, held, z, batch.reference, batch.dt)
    found = [r[name] for r in (seen, held, said) for name in r.dtype.names]
    rows = [x.reshape(count, -1).astype(float) for x in (*found, command)]
    return dict(zip(names, [x for x in rows if x.size], strict=True))


def gaps(want: dict, got: dict, scale: dict) -> dict[str, np.ndarray]:
    """Largest difference of each field in each step, over the number or the field's scale."""
    out = {}
    with np.errstate(invalid="ignore", over="ignore"):
        for name, b in want.items():
            a = got[name]
            same = (np.isnan(a) & np.isnan(b)) | (a == b)
            gap = np.where(same, 0.0, np.abs(a - b) / np.maximum(np.abs(b), scale[name]))
            out[name] = np.max(np.where(np.isnan(gap), np.inf, gap), axis=1)
    return out


def scales(row: str, drawn: str) -> dict[str, float]:
    """Of each field, the median over 20 000 steps of its largest number, and no less than LEAST."""
    batches, sizes = source(row, drawn), {}
    for _ in range(max(1, round(10 * min(SHARE, 1.0)))):
        for name, x in flat(batches.next().after).items():
            large = np.max(np.where(np.isfinite(x), np.abs(x), 0.0), axis=1)
            sizes.setdefault(name, []).append(large)
    return {name: max(float(np.median(np.concatenate(x))), LEAST) for name, x in sizes.items()}


class Again:
    """JAX's step of some steps of a batch, as it is and from states that are changed a little."""

    def __init__(self, row: str, lot: int):
        p = pilot(row)

        def one(given):
            seen, held, z, reference, dt = given
            seen, said = p.estimator.step(seen, z, dt)
            held, command = p.controller.step(held, reference, said, dt)
            return seen, held, said, command

        self._lot, self._run = lot, jax.jit(lambda given: jax.lax.map(one, given))

    def of(self, given, count: int) -> dict[str, np.ndarray]:
        """Results of the steps, `lot` at a time."""
        found = []
        for first in range(0, count, self._lot):
            at = np.minimum(np.arange(first, first + self._lot), count - 1)
            part = flat(self._run(jax.tree.map(lambda x, at=at: x[at], given)))
            found.append({name: x[: count - first] for name, x in part.items()})
        return {name: np.concatenate([f[name] for f in found]) for name in found[0]}


def given_of(batch: Batch, at=slice(None)):
    """What goes into some steps of a batch."""
    parts = (batch.seen, batch.held, batch.reading, batch.reference, batch.dt)
    return jax.tree.map(lambda x: np.asarray(x)[at], parts)


def nudged(given, rng, nudge=NUDGE):
    """The same with every number off by a few roundings."""

    def one(x):
        if x.dtype != float:
            return x
        return x * (1 + nudge * rng.uniform(-1.0, 1.0, x.shape))

    return jax.tree.map(one, given)


def flushed(batch: Batch, at: np.ndarray) -> Batch:
    """Steps of a batch with 0 for numbers too small to be normal, as XLA takes them."""

    def one(x):
        small = x.dtype == float and np.abs(x) < np.finfo(float).tiny
        return np.where(small, np.copysign(0.0, x), x) if np.any(small) else x

    given = jax.tree.map(one, given_of(batch, at))
    return Batch(*given, jax.tree.map(lambda x: np.asarray(x)[at], batch.after))


def single(given):
    """The same rounded to 32 bits."""
    with np.errstate(over="ignore"):
        return jax.tree.map(
            lambda x: x.astype(np.float32).astype(float) if x.dtype == float else x, given
        )


@dataclass
class Tally:
    """What became of all steps.

    Attributes:
        double, float, rounded: largest gap of each step, of C in either precision and of JAX on
            rounded numbers; worst: of each field and kind.
        doubtful: steps of double beyond the bar, by what they are; unexplained: those that remain.
    """

    double: list = field(default_factory=list)
    float: list = field(default_factory=list)
    rounded: list = field(default_factory=list)
    worst: dict = field(default_factory=dict)
    doubtful: Counter = field(default_factory=Counter)
    unexplained: list = field(default_factory=list)

    def add(self, kind: str, found: dict[str, np.ndarray]) -> np.ndarray:
        most = np.max(np.stack(list(found.values())), axis=0)
        getattr(self, kind).append(most)
        for name, x in found.items():
            known = self.worst.setdefault(kind, {})
            known[name] = max(known.get(name, 0.0), float(x.max()))
        return most

    def told(self) -> str:
        """Quantiles and counts, a line for each kind."""
        lines = []
        for f in fields(self)[:3]:
            x = np.concatenate(getattr(self, f.name))
            at = " ".join(f"{v:.1e}" for v in np.quantile(x, [0.5, 0.9, 0.99, 0.999, 1.0]))
            bar = BARS.get(f.name, BARS["float"])
            first = sorted(self.worst[f.name].items(), key=lambda kv: -kv[1])[:4]
            far = ", ".join(f"{name} {v:.1e}" for name, v in first)
            lines.append(
                f"  {f.name:8s} {len(x)} steps, quantiles 50 90 99 99.9 100 %: {at}; beyond "
                f"{bar:.0e}: {int((x > bar).sum())}; farthest {far}"
            )
        return "\n".join([*lines, f"  double beyond the bar: {dict(self.doubtful)}"])


def beyond_bar(found: dict[str, np.ndarray]) -> np.ndarray:
    """Numbers of the steps of double that are beyond the bar."""
    return np.flatnonzero(np.max(np.stack(list(found.values())), axis=0) > BARS["double"])


def looked_into(
    tally: Tally, again: Again, compiled: CompiledC, batch: Batch, found: dict, scale: dict
) -> None:
    """Why C is beyond the bar: numbers that XLA takes for 0, or JAX itself is as uncertain."""
    at = beyond_bar(found)
    if not len(at):
        return
    found = {name: x[at] for name, x in found.items()}
    part = flushed(batch, at)
    without = gaps(flat(part.after), by_c(compiled, part), scale)
    small = np.setdiff1d(np.arange(len(at)), beyond_bar(without))
    tally.doubtful["numbers below 2e-308"] += len(small)
    at, found = np.delete(at, small), {n: np.delete(x, small) for n, x in found.items()}
    if not len(at):
        return
    given, rng = given_of(batch, at), np.random.default_rng(len(tally.double))
    own = again.of(given, len(at))
    moved = [
        gaps(own, again.of(nudged(given, rng), len(at)), scale) for _ in range(NUDGES)
    ]  # each by field, in every doubtful step
    spread = {name: np.max([m[name] for m in moved], axis=0) for name in own}
    for k in range(len(at)):
        beyond = {n: (x[k], spread[n][k]) for n, x in found.items() if x[k] > BARS["double"]}
        if all(jax_own >= c for c, jax_own in beyond.values()):
            tie = any(jax_own > TIE for _, jax_own in beyond.values())
            tally.doubtful["decision ties" if tie else "ill-conditioned"] += 1
        else:
            tally.doubtful["unexplained"] += 1
            tally.unexplained.append({n: f"C {c:.1e}, JAX {j:.1e}" for n, (c, j) in beyond.items()})


@needs("cc")
@pytest.mark.parametrize("drawn", STEPS)
@pytest.mark.parametrize("row", ["slip_odometry", "contact"])
def test_steps_from_common_states(tmp_path, row, drawn):
    scale, batches, tally = scales(row, drawn), source(row, drawn), Tally()
    builds = {}
    for kind, flags in KINDS.items():
        folder = tmp_path / kind
        folder.mkdir()
        builds[kind] = CompiledC(code(row), folder, (*FAST, *flags))
    every, few = Again(row, ROBOTS * ROWS_OF_BATCH), Again(row, 8)
    for number in range(max(1, round(SHARE * STEPS[drawn] / (ROBOTS * ROWS_OF_BATCH)))):
        batch = batches.next()
        want, count = flat(batch.after), len(batch.dt)
        found = gaps(want, by_c(builds["double"], batch), scale)
        tally.add("double", found)
        looked_into(tally, few, builds["double"], batch, found, scale)
        tally.add("float", gaps(want, by_c(builds["float"], batch), scale))
        if number % 10 == 0:
            rounded = every.of(single(given_of(batch)), count)
            tally.add("rounded", gaps(want, rounded, scale))
    print(f"\n{row}, {drawn}:\n{tally.told()}")
    for one in tally.unexplained[:10]:
        print("  unexplained:", one)
    assert not tally.unexplained


# closed loops ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Loops:
    """Closed loops, an axis of periods and one of runs in front.

    Attributes:
        command: [rad/s]; believed, true: poses [m, m, rad]; angle: of the wheels as read [rad].
    """

    command: np.ndarray
    believed: np.ndarray
    true: np.ndarray
    angle: np.ndarray


def looped(plants: Plants, drive, state, periods: int) -> Loops:
    """A drive function, (state, reading) to state, command and pose, on all plants at once."""
    rows, (plant, read) = [], plants.begin()
    for number in range(1, periods + 1):
        angle, true = np.asarray(read.wheel_angle), np.asarray(plant.pose)
        state, command, pose = drive(state, read)
        rows.append((np.array(command, float), np.array(pose, float), true, angle))
        plant, read = plants.step(plant, command, number)
    return Loops(*(np.stack(x) for x in zip(*rows, strict=True)))


def by_jax(row: str, count: int, nudge: float = 0.0):
    """Drive function and first state of the library's own pilot.

    With a nudge its state is off by that much, relatively and at random, after every period.
    """
    p, rng = pilot(row), np.random.default_rng(0)
    step = jax.jit(
        lambda state, z: jax.lax.map(lambda g: p.step(PATH, g[0], g[1], 0.05), (state, z))
    )

    def drive(state, read):
        state, said = step(state, read)
        if nudge:
            state = nudged(jax.tree.map(np.asarray, state), rng, nudge)
        return state, said.command, said.estimate.pose

    begin = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), p.init())
    return drive, begin


def by_fleet(fleet: Fleet, count: int):
    """The same of generated code; its state is changed in place."""

    def drive(state, read):
        said, _, command = fleet.drive(state, records(fleet.reading, read, count))
        return state, command, said["pose"]

    return drive, fleet.start(count)


def farthest(own: Loops, other: Loops) -> np.ndarray:
    """Largest difference of commands and poses of each run."""
    pairs = [(getattr(own, n), getattr(other, n)) for n in ("command", "believed", "true")]
    return np.max([np.abs(a - b).max(axis=(0, 2)) for a, b in pairs], axis=0)


def reason(own: Loops, other: Loops, jax_own: Loops, run: int) -> str:
    """Why a run differs: how its difference grew, and how JAX's own loop does when nudged."""
    parts = ("command", "believed", "true")
    gap = [np.abs(getattr(own, n) - getattr(other, n))[:, run].max(-1) for n in parts]
    gap = np.maximum.accumulate(np.max(gap, axis=0))
    read = np.abs(own.angle - other.angle)[:, run].max(-1)
    tick = int(np.argmax(read > 1e-6)) if (read > 1e-6).any() else None
    grown = gap[1:] / np.maximum(gap[:-1], 1e-13)
    jump = int(np.argmax(grown))
    own_gap = farthest(own, jax_own)[run]
    text = "no encoder read another tick" if tick is None else f"another tick in period {tick}"
    return (
        f"run {run}: {gap[-1]:.1e}; it grew most, {grown[jump]:.0f} times to {gap[jump + 1]:.1e}, "
        f"in period {jump + 1}, and passed 1e-9 in period {int(np.argmax(gap > 1e-9))}; {text}; "
        f"JAX's own loop, nudged, differs by {own_gap:.1e}"
    )


NUDGED = {"double": 1e-15, "float": 6e-8}
"""What JAX's own state is nudged by each period, as arithmetic in either precision does."""


def told_of(name: str, own: Loops, other: Loops) -> str:
    """How far two sets of loops are from each other."""
    most = farthest(own, other)
    text = [f"  {name}: largest difference of each run, median {np.median(most):.1e}, most"]
    text.append(f"{most.max():.1e}; beyond 1e-9: {int((most > 1e-9).sum())}; at the end in mm")
    for what in ("believed", "true"):
        gap = getattr(own, what)[-1, :, :2] - getattr(other, what)[-1, :, :2]
        end = 1e3 * np.linalg.norm(gap, axis=-1)
        at = ", ".join(f"{x:.1e}" for x in np.quantile(end, [0.5, 0.9, 1.0]))
        text.append(f"{what} (50 90 100 %) {at};")
    return " ".join(text)


@needs("cc")
@pytest.mark.parametrize("row", ["slip_odometry", "contact"])
def test_closed_loops(tmp_path, row):
    count, periods = max(2, round(SHARE * LOOPS)), max(100, round(min(SHARE, 1.0) * PERIODS))
    plants = Plants(three_floors(), PATH, count)
    own = looped(plants, *by_jax(row, count), periods)
    way = np.linalg.norm(np.diff(own.true[..., :2], axis=0), axis=-1).sum(0)
    print(f"\n{row}: {count} runs of {periods} periods, way {way.min():.1f} to {way.max():.1f} m")
    for kind, flags in KINDS.items():
        folder = tmp_path / kind
        folder.mkdir()
        fleet = Fleet(code(row), folder, (*FAST, *flags))
        other = looped(plants, *by_fleet(fleet, count), periods)
        jax_own = looped(plants, *by_jax(row, count, NUDGED[kind]), periods)
        print(told_of(f"C in {kind}", own, other))
        print(told_of(f"JAX, nudged by {NUDGED[kind]:g} each period", own, jax_own))
        if kind == "double":
            most = farthest(own, other)
            for k in np.flatnonzero(most > 1e-9):
                print("  ", reason(own, other, jax_own, int(k)))
            # a run that drifts apart is one that rounding alone drives apart
            assert ((most <= 1e-9) | (farthest(own, jax_own) >= 0.1 * most)).all()
