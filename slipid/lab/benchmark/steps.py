"""Runs divided into short steps, with true body poses: the input of all benchmark methods."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.data.log import Log
from slipid.data.runs import Runs
from slipid.data.wheel_signals import integral, interpolate
from slipid.data.windows import Windows
from slipid.fitting.likelihood import corrected
from slipid.model.robot import Robot
from slipid.predict import open_loop
from slipid.predict.slip_model import Run, RunSignals, body_poses

POSES_PER_STEP = 3
"""Minimum number of logged poses in each step, if a run has enough poses.

Between two successive poses, the noise of the poses is nearly as large as the motion.
"""


@dataclass(frozen=True, eq=False)
class RunBatch:
    """Some runs with the same number of steps.

    Attributes:
        numbers: index of each run in its data set.
        runs: the runs; their signals, which methods are given, do not name the floor.
        windows: windows of the same runs; the last segments may be repeated as padding.
    """

    numbers: tuple[int, ...]
    runs: tuple[Run, ...]
    windows: Windows


def run_batches(data: Runs, robot: Robot, poses_per_step: int = POSES_PER_STEP) -> list[RunBatch]:
    """Return all runs divided into steps.

    The steps of a run begin after one centimetre of wheel motion and end at the last pose. Logged
    poses are corrected in scale and lag by the robot's camera model. Nearly all runs get the same
    number of steps, a power of two, so that functions are compiled for few array sizes.
    """
    poses = [int(data.fresh[data.rows(k)].sum()) for k in range(len(data))]
    usual = _step_count(float(np.quantile(poses, 0.1)), poses_per_step)
    steps = [min(usual, _step_count(float(count), poses_per_step)) for count in poses]
    return [_batch(data, robot, w) for w in open_loop.whole_runs(data, robot, steps)]


def in_order(batches: Sequence[RunBatch]) -> list[Run]:
    """Return the runs of all batches in the order of their data set."""
    runs = {k: run for one in batches for k, run in zip(one.numbers, one.runs, strict=True)}
    return [runs[k] for k in sorted(runs)]


def _step_count(poses: float, poses_per_step: int) -> int:
    """Return the number of steps of a run with this number of logged poses, a power of two."""
    return 2 ** max(1, int(np.floor(np.log2(max(0.8 * poses / poses_per_step, 2.0)))))


def _batch(data: Runs, robot: Robot, w: Windows) -> RunBatch:
    numbers = tuple(dict.fromkeys(w.run.tolist()))
    pose = body_poses(robot, w.session, np.asarray(corrected(robot, jnp.asarray(w.pose))))
    runs = []
    for n, k in enumerate(numbers):
        log = data.logs[k]
        edges = w.start[n] + np.concatenate([[0.0], np.cumsum(w.dt[n])]) - w.lag
        signals = RunSignals(
            name=log.name,
            dt=w.dt[n],
            turn=w.turn[n],
            current=w.current[n] if w.has_current else None,
            current_is_signed=w.current_is_signed,
            load=log.load,
            gyro=None if log.gyro is None else _mean(log, log.gyro[:, None], edges)[:, 0],
            command=None if log.twist_command is None else _mean(log, log.twist_command, edges),
        )
        run = Run(
            signals=signals,
            pose=pose[n],
            floor=w.surface[n],
            load=log.load,
            heading=float(data.heading[k]),
            speed=float(data.speed[k]),
        )
        runs.append(run)
    return RunBatch(numbers, tuple(runs), w)


def _mean(
    log: Log, x: Float[np.ndarray, "row column"], edges: Float[np.ndarray, " edge"]
) -> Float[np.ndarray, "step column"]:
    """Return the time average of a logged signal between successive edges [s]."""
    inside = np.clip(edges, log.time[0], log.time[-1])
    total = np.diff(interpolate(log.time, integral(log.time, x), inside), axis=0)
    return np.asarray(total / np.maximum(np.diff(inside), 1e-9)[:, None])
