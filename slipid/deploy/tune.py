"""`slipid tune`: gains rehearsed on the fit's own twin; the search is on disk while it runs."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from slipid.control import trajectory
from slipid.control.closed_loop import PERIOD
from slipid.control.deployed import DeployedRobot, drawn
from slipid.control.tuning.objective import Cases, Task
from slipid.control.tuning.optimisers import Method, Search, State
from slipid.data.floor_map import patchwork
from slipid.deploy.deploy import ROBOT, habits_of, read_robot
from slipid.deploy.trial_site import floor_of
from slipid.deploy.tuned import CORNERS, DRAWS, Tuned, hashes, judged
from slipid.support.checkpoint import Checkpoint, key_of, source_hash
from slipid.support.errors import DataError
from slipid.support.files import write_json
from slipid.support.progress import Reporter

CHECKPOINT = "tuning"
SLACK = 1.2
"""Time a rehearsal gives the path, over the path's own."""
TRIED, JUDGED, STABLE = 64, 48, 4
"""Cases the search draws from, other ones it is judged on, draws whose loops must be stable."""


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
    task = search.task
    own = (hashes(task.robot), task.robot.load_setup, search.method, search.steps, search.seed)
    hashed = source_hash("control", "model")
    return (hashed, *map(np.asarray, arrays), *own, task.habits, task.steps)
