"""`slipid tune`: gains rehearsed on the fit's own twin; the search is on disk while it runs."""

import hashlib
import time
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import jax
import jax.numpy as jnp
import numpy as np

from slipid.app import files
from slipid.app.freeze import fit_hash, frozen_draws, frozen_of, load_of, sensors_of
from slipid.app.progress import Reporter
from slipid.control import reference
from slipid.control.closed_loop import PERIOD
from slipid.control.controller import GAINS
from slipid.control.frozen import Frozen
from slipid.control.search import GRADIENT, Method, Search, State
from slipid.control.tuning import BATCH, HAND, Cases, Task, combined, evaluate
from slipid.data.files import write_arrays, write_json
from slipid.data.log import DataError
from slipid.data.terrain import patchwork
from slipid.identify.result import Fit
from slipid.model.plant import Floor

SCHEMA, CHECKPOINT = "slipid.gains/1", "tuning.npz"
UNITS = dict(zip(GAINS, ("1/s", "1/s", "1/s^2", "1", "1", "s"), strict=True))
CORNERS = ((0.0, 0.0), (0.4, 0.0), (0.4, -0.2))
"""Of the path that is rehearsed [m]."""
SLACK = 1.2
"""Time a rehearsal gives the path, over the path's own."""
TRIED, JUDGED, DRAWS, STABLE = 64, 48, 16, 4
"""Cases the search draws from, other ones it is judged on, draws of the robot, draws whose loops
must be stable."""


def cases(robots: Frozen, count: int, seed: int) -> Cases:
    """Starts on patchworks of the robots' floors, of one of the robots each.

    Args:
        robots: stacked draws.
        count: of cases.
        seed: of floors, starts, noise and which robot.
    """
    rng = np.random.default_rng([seed, count])
    start = np.concatenate(
        [rng.uniform(-0.3, 0.3, (count, 2)), rng.uniform(-np.pi, np.pi, (count, 1))], axis=1
    )
    path = reference.waypoints(CORNERS)
    picked = rng.integers(len(robots.rest), size=count)
    floors = [floor(robots.labels, int(s)) for s in rng.integers(2**31, size=count)]
    return Cases(
        truth=jax.tree.map(lambda x: x[picked], robots),
        floor=jax.tree.map(lambda *x: jnp.stack(x), *floors),
        path=jax.tree.map(lambda *x: jnp.stack(x), *[path.moved(s) for s in start.tolist()]),
        start=jnp.asarray(start),
        key=jax.random.split(jax.random.PRNGKey(seed), count),
    )


def floor(labels: tuple[str, ...], seed: int) -> Floor:
    """A patchwork as arrays, its surfaces numbered as the robot's."""
    drawn = patchwork(labels, seed, half=1.0, cell=0.02)
    return Floor(jnp.asarray(drawn.cells), jnp.asarray(drawn.corner), jnp.asarray(drawn.cell))


def task_of(fit: Fit, load: str, gyro: bool) -> Task:
    """What is tuned for a fit: its sensors, its robot, the rehearsed path."""
    settings, habits = sensors_of(fit, gyro)
    steps = int(np.ceil(SLACK * reference.waypoints(CORNERS).duration / PERIOD))
    return Task(frozen_of(fit, load), settings, habits, steps=steps)


def tune(
    fit: Fit,
    out: Path,
    load: str | None,
    method: Method,
    rollouts: int,
    seed: int,
    gyro: bool,
    report: Reporter,
) -> dict[str, Any]:
    """Tune, write gains.json, and say what it holds.

    Args:
        fit: of OUT; out: the folder.
        load: name of the load set-up, the first one by default.
        method: of the search; rollouts: it may spend.
        seed: of draws, floors, noise and search.
        gyro: whether the robot has one.
        report: told what is going on.

    Raises:
        DataError: no such load set-up or method, or too few rollouts for one step.
    """
    if method not in ("gradient", "pso"):
        raise DataError(f"method '{method}'; expected gradient or pso")
    name = load_of(fit, load)
    report.stage("draws of the robot")
    task = task_of(fit, name, gyro)
    robots = frozen_draws(fit, name, DRAWS, seed)
    stable = jax.tree.map(lambda x: x[:STABLE], robots)
    search = Search(task, cases(robots, TRIED, seed), stable, method, rollouts, seed)
    if rollouts < search.cost:
        raise DataError(f"{rollouts} rollouts; expected {search.cost} or more with {method}")
    key = _key(fit, name, search, gyro)
    state = _searched(search, out / CHECKPOINT, key, report)
    report.stage("judging on other cases")
    fresh = frozen_draws(fit, name, DRAWS, seed + 1)
    content = _content(search, state, cases(fresh, JUDGED, seed + 1), stable)
    content["settings"] |= {"load": name, "gyro": gyro, "voltage": task.habits.voltage}
    content |= {"seed": seed, "fit": fit_hash(fit)}
    write_json(out / "gains.json", content)
    (out / CHECKPOINT).unlink(missing_ok=True)
    return content


def _searched(search: Search, path: Path, key: str, report: Reporter) -> State:
    """The search's end; every step is kept on disk, and one that was left goes on."""
    state = _kept(path, key) or search.start()
    done = int(state["count"])
    if done:
        report.line(f"goes on after {done * search.cost} of {search.rollouts} rollouts")
    report.stage(f"tuning by {search.method}")
    begun: tuple[float, int] | None = None
    while not search.done(state):
        state = search.step(state)
        write_arrays(path, state | {"key": np.asarray(key)}, compress=False)
        done, now = int(state["count"]), time.monotonic()
        begun = begun or (now, done)  # what the first step compiles tells nothing of the others
        what = "rollouts"
        if done > begun[1]:
            left = (now - begun[0]) / (done - begun[1]) * (search.steps - done)
            what += f", about {left:.0f} s left" if left else ""
        report.step(done * search.cost, search.rollouts, what)
    return state


def _kept(path: Path, key: str) -> State | None:
    """State of this very search, or None."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
            if str(kept["key"]) != key:
                return None
            return {name: kept[name] for name in kept.files if name != "key"}
    except (OSError, EOFError, KeyError, ValueError, BadZipFile):
        return None


def _content(search: Search, state: State, judged: Cases, stable: Frozen) -> dict[str, Any]:
    """Content of gains.json but for where it comes from."""
    task = search.task
    best, spread = search.best(state), search.spread(state)
    losses = {"hand": evaluate(task, HAND, judged), "tuned": evaluate(task, best, judged)}
    margin = {
        name: task.margins(jnp.asarray(g), stable)
        for name, g in (("hand", np.asarray(HAND)), ("tuned", best))
    }
    values = {
        g: {"value": float(v), "unit": UNITS[g], "spread": float(s)}
        for g, v, s in zip(GAINS, best, spread, strict=True)
    }
    return {
        "schema": SCHEMA,
        "gains": values,
        "method": search.method,
        "rollouts": search.rollouts,
        "loss": {k: float(combined(jnp.asarray(v))) for k, v in losses.items()},
        "loss_mean": {k: float(v.mean()) for k, v in losses.items()},
        "loss_interval90": {k: np.quantile(v, [0.05, 0.95]).tolist() for k, v in losses.items()},
        "better_than_hand": float((losses["tuned"] < losses["hand"]).mean()),
        "stability_margin": {
            "worst": float(margin["tuned"].min()),
            "median": float(np.median(margin["tuned"])),
            "hand_worst": float(margin["hand"].min()),
            "draws": margin["tuned"].reshape(len(stable.mass), -1).min(axis=1).tolist(),
        },
        "settings": {
            "loss_unit": "mm",
            "cases": TRIED,
            "judged_on": JUDGED,
            "draws": DRAWS,
            "batch": BATCH,
            "gradient_counts_as": GRADIENT,
            "path_m": [list(c) for c in CORNERS],
            "delay_s": task.habits.delay_s,
            "lag_s": task.habits.lag_s,
            "period_s": task.period,
            "steps": task.steps,
            "hand": dict(zip(GAINS, HAND, strict=True)),
        },
    }


def _key(fit: Fit, load: str, search: Search, gyro: bool) -> str:
    """Hash of everything a search depends on, the code included."""
    mark = hashlib.sha256(files.code("control", "model"))
    for leaf in jax.tree.leaves((search.task, search.cases, search.stable)):
        values = (
            jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        )
        mark.update(np.ascontiguousarray(values).tobytes())
    parts = [*fit_hash(fit).values(), load, search.method, search.steps, search.seed, gyro]
    task = search.task
    parts += [task.settings, task.habits, task.weights, task.limits, task.steps, task.period]
    parts += sorted(files.versions().items())
    mark.update("\n".join(map(str, parts)).encode())
    return mark.hexdigest()
