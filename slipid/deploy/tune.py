"""`slipid tune`: gains rehearsed on the fit's own twin; the search is on disk while it runs."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.control import trajectory
from slipid.control.closed_loop import PERIOD
from slipid.control.controller import Gains
from slipid.control.deployed import DeployedRobot, drawn
from slipid.control.robot_file.record import (
    GainRecord,
    GainsRecord,
    GainsVerdict,
    GainValues,
    Losses,
)
from slipid.control.tuning import objective
from slipid.control.tuning.objective import BATCH, GAINS, HAND, UNITS, Cases, Task
from slipid.control.tuning.optimisers import GRADIENT, Method, Search, State
from slipid.data.floor_map import patchwork
from slipid.deploy.deploy import ROBOT, habits_of, read_robot
from slipid.deploy.floors import floor_of
from slipid.support.checkpoint import Checkpoint, key_of, source_hash
from slipid.support.errors import DataError
from slipid.support.files import write_json
from slipid.support.progress import Reporter

SCHEMA = "slipid.gains/1"
CORNERS = ((0.0, 0.0), (0.4, 0.0), (0.4, -0.2))
"""Of the path that is rehearsed [m]."""
DRAWS = 16
"""Of the robot, to search with and to judge on."""
CHECKPOINT = "tuning"
SLACK = 1.2
"""Time a rehearsal gives the path, over the path's own."""
TRIED, JUDGED, STABLE = 64, 48, 4
"""Cases the search draws from, other ones it is judged on, draws whose loops must be stable."""
SURE = 2.0
"""Standard errors from which on a difference of losses is no chance."""
RESAMPLED = 2000
"""Times the cases are drawn anew for that error."""


@dataclass(frozen=True, eq=False)
class Tuned:
    """What a search has come to.

    Attributes:
        search: what was tuned, and how.
        best, spread: gains and their stds over the end of the search, in the order of `GAINS`.
        losses: of every case not tuned on [mm], by hand and tuned.
        margins: 1 - spectral radius of every loop of every draw, by hand and tuned.
    """

    search: Search
    best: Float[np.ndarray, " gain"]
    spread: Float[np.ndarray, " gain"]
    losses: Mapping[str, Float[np.ndarray, " case"]]
    margins: Mapping[str, Float[np.ndarray, "draw loop"]]

    def record(self) -> GainsRecord:
        """As robot.json has it."""
        loss = Losses(
            **{k: float(objective.combined(jnp.asarray(v))) for k, v in self.losses.items()}
        )
        task, better = self.search.task, self.losses["tuned"] < self.losses["hand"]
        rows = zip(GAINS, self.best, UNITS, self.spread, strict=True)
        return GainsRecord(
            values=GainValues(**{g: GainRecord(float(v), u, float(s)) for g, v, u, s in rows}),
            load=task.robot.load_setup,
            gyro=task.habits.gyro,
            method=self.search.method,
            loss=loss,
            better_than_hand=float(better.mean()),
            stability_margin=float(self.margins["tuned"].min()),
            verdict=verdict(*improvement(self.losses)),
        )

    def to_json(self) -> dict[str, object]:
        """Content of gains.json."""
        task, kept, record = self.search.task, self.search, self.record()
        gained, error = improvement(self.losses)
        quantiles = {k: np.quantile(v, [0.05, 0.95]).tolist() for k, v in self.losses.items()}
        return {
            "schema": SCHEMA,
            "gains": asdict(record.values),
            "method": kept.method,
            "rollouts": kept.rollouts,
            "loss": asdict(record.loss),
            "loss_mean": {k: float(v.mean()) for k, v in self.losses.items()},
            "loss_interval90": quantiles,
            "improvement": {"value": gained, "se": error},
            "verdict": record.verdict,
            "better_than_hand": record.better_than_hand,
            "stability_margin": {
                "worst": record.stability_margin,
                "median": float(np.median(self.margins["tuned"])),
                "hand_worst": float(self.margins["hand"].min()),
                "draws": self.margins["tuned"].min(axis=1).tolist(),
            },
            "settings": {
                "loss_unit": "mm",
                "cases": len(kept.cases),
                "judged_on": len(self.losses["tuned"]),
                "draws": DRAWS,
                "batch": BATCH,
                "gradient_counts_as": GRADIENT,
                "path_m": [list(c) for c in CORNERS],
                "delay_s": task.habits.delay_s,
                "lag_s": task.habits.lag_s,
                "period_s": PERIOD,
                "steps": task.steps,
                "hand": dict(zip(GAINS, HAND, strict=True)),
                "load": record.load,
                "gyro": record.gyro,
                "voltage": task.habits.voltage,
            },
            "seed": kept.seed,
            "fit": {"data": task.robot.record.data, "numbers": task.robot.record.numbers},
        }


_both = jax.jit(jax.vmap(jax.vmap(objective.combined)))


def improvement(losses: Mapping[str, Float[np.ndarray, " case"]]) -> tuple[float, float]:
    """Loss by hand less tuned [mm] and its standard error, by drawing pairs of losses anew.

    Both gains drive the same cases, which differ more from each other than gains do.
    """
    pairs = np.stack([losses["hand"], losses["tuned"]])
    count = pairs.shape[1]
    picked = np.random.default_rng(0).integers(count, size=(RESAMPLED, count))
    by_hand, tuned = np.asarray(_both(jnp.asarray(pairs[:, picked])))
    gained = np.subtract(*np.asarray(_both(jnp.asarray(pairs[:, None])))[:, 0])
    return float(gained), float(np.std(by_hand - tuned, ddof=1))


def verdict(gained: float, error: float) -> GainsVerdict:
    """Better only by more than `SURE` standard errors."""
    if gained > SURE * error:
        return "better than by hand"
    return "worse than by hand" if gained < -SURE * error else "no better than by hand"


def judged(search: Search, state: State, others: Cases, stable: DeployedRobot) -> Tuned:
    """The end of a search, on cases it has not seen."""
    task, best = search.task, search.best(state)
    by = {"hand": np.asarray(HAND), "tuned": best}
    return Tuned(
        search=search,
        best=best,
        spread=search.spread(state),
        losses={name: objective.evaluate(task, g, others) for name, g in by.items()},
        margins={name: task.margins(Gains.at(g), stable) for name, g in by.items()},
    )


def cases(robots: DeployedRobot, count: int, seed: int) -> Cases:
    """Starts on patchworks of the robots' floors, of one of the stacked robots each."""
    rng = np.random.default_rng([seed, count])
    start = np.concatenate(
        [rng.uniform(-0.3, 0.3, (count, 2)), rng.uniform(-np.pi, np.pi, (count, 1))], axis=1
    )
    path = trajectory.waypoints(CORNERS)
    picked = rng.integers(len(robots.rest), size=count)
    seeds = rng.integers(2**31, size=count).tolist()
    drawn = [patchwork(robots.labels, s, half=1.0, cell=0.02) for s in seeds]
    floors = [floor_of(floor, robots.labels) for floor in drawn]
    return Cases(
        truth=jax.tree.map(lambda x: x[picked], robots),
        floor=jax.tree.map(lambda *x: jnp.stack(x), *floors),
        path=jax.tree.map(lambda *x: jnp.stack(x), *[path.moved(s) for s in start.tolist()]),
        start=jnp.asarray(start),
        key=jax.random.split(jax.random.PRNGKey(seed), count),
    )


def task_of(robot: DeployedRobot, gyro: bool) -> Task:
    """What is tuned for a robot: its sensors, its numbers, the rehearsed path."""
    steps = int(np.ceil(SLACK * trajectory.waypoints(CORNERS).duration / PERIOD))
    return Task(robot, habits_of(robot, gyro), steps)


def robots_of(robot: DeployedRobot, seed: int) -> tuple[DeployedRobot, DeployedRobot]:
    """Draws of a robot to search with, and other ones to judge on."""
    order = np.random.default_rng(seed).permutation(max(robot.record.drawn, 2 * DRAWS)).tolist()
    return drawn(robot, tuple(order[:DRAWS])), drawn(robot, tuple(order[DRAWS : 2 * DRAWS]))


def tune(
    out: Path,
    load: str | None,
    method: Method,
    rollouts: int,
    seed: int,
    gyro: bool,
    report: Reporter,
) -> Tuned:
    """Tune the robot of a folder, write gains.json, and the gains into robot.json.

    Args:
        load: name of the load set-up, the first one by default.
        method: of the search; rollouts: it may spend.
        seed: of draws, floors, noise and search.
        gyro: whether the robot has one.

    Raises:
        DataError: no robot, no such load set-up or method, or too few rollouts for one step.
    """
    if method not in ("gradient", "pso"):
        raise DataError(f"method '{method}'; expected gradient or pso")
    robot = read_robot(out, load)
    report.stage("draws of the robot")
    robots, fresh = robots_of(robot, seed)
    stable = jax.tree.map(lambda x: x[:STABLE], robots)
    tried = cases(robots, TRIED, seed)
    search = Search(task_of(robot, gyro), tried, stable, method, rollouts, seed)
    if rollouts < search.cost:
        raise DataError(f"{rollouts} rollouts; expected {search.cost} or more with {method}")
    kept = Checkpoint(out, key_of(*_everything(search)))
    state = _searched(search, kept, report)
    report.stage("judging on other cases")
    found = judged(search, state, cases(fresh, JUDGED, seed + 1), stable)
    write_json(out / "gains.json", found.to_json())
    record = replace(robot.record, gains=found.record())
    DeployedRobot.of(record, robot.load_setup).save(out / ROBOT)
    kept.remove(f"{CHECKPOINT}.npz")
    return found


def _searched(search: Search, kept: Checkpoint, report: Reporter) -> State:
    """The search's end; every step is kept on disk, and one that was left goes on."""
    state = kept.load(CHECKPOINT) or search.start()
    done = int(state["count"])
    if done:
        report.line(f"goes on after {done * search.cost} of {search.rollouts} rollouts")
    report.stage(f"tuning by {search.method}")
    while not search.done(state):
        state = search.step(state)
        kept.save(CHECKPOINT, state)
        spent = int(state["count"]) * search.cost
        report.advance(spent, search.rollouts, f"{spent} of {search.rollouts} rollouts")
    return state


def _everything(search: Search) -> tuple[object, ...]:
    """All that a search depends on, the code included."""
    arrays = [
        jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        for leaf in jax.tree.leaves((search.task, search.cases, search.stable))
    ]
    task, robot = search.task, search.task.robot
    own = (robot.record.numbers, robot.load_setup, search.method, search.steps, search.seed)
    hashed = source_hash("control", "model")
    return (hashed, *map(np.asarray, arrays), *own, task.habits, task.steps)
