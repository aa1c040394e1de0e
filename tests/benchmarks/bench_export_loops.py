"""Generated C beside JAX in a hundred closed loops of a minute.

How it is run is at the head of `export_builds.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.benchmarks.export_builds import (
    FAST,
    KINDS,
    PATH,
    SHARE,
    Fleet,
    Plants,
    code,
    control_loop,
    needs,
    nudged,
    three_floors,
)
from tests.benchmarks.quick import QUICK
from tests.helpers.c_against_jax import records

LOOPS, PERIODS = 100, 1200


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
    """Drive function and first state of the library's own control loop.

    With a nudge its state is off by that much, relatively and at random, after every period.
    """
    p, rng = control_loop(row), np.random.default_rng(0)
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
            assert QUICK or ((most <= 1e-9) | (farthest(own, jax_own) >= 0.1 * most)).all()
