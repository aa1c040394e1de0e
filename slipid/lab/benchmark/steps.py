"""Runs in short steps with true body poses, as every method of the benchmark is given them."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.data.log import Log
from slipid.data.runs import Runs
from slipid.data.wheel_signals import integral, interpolate
from slipid.data.windows import Windows
from slipid.model.robot import Robot
from slipid.predict import open_loop as replay
from slipid.predict.slip_model import Run, RunSignals, turned

POSES_PER_STEP = 3
"""Poses in each step, where there are enough: a step is hardly shorter than the noise of two."""


@dataclass(frozen=True, eq=False)
class RunBatch:
    """Some runs in equally many steps.

    Attributes:
        numbers: of the runs in their data set.
        runs: as methods are given them, floors not told.
        windows: of the same runs; the last pieces may be repeated.
    """

    numbers: tuple[int, ...]
    runs: tuple[Run, ...]
    windows: Windows


def run_batches(data: Runs, robot: Robot, poses_per_step: int = POSES_PER_STEP) -> list[RunBatch]:
    """All runs in steps, from where the wheels have moved a centimetre to the last pose.

    The robot's camera says how true poses follow from logged ones, and how late they are. Nearly
    all runs have the same number of steps, so that few shapes are compiled; it is a power of two.
    """
    poses = [int(data.fresh[data.rows(k)].sum()) for k in range(len(data))]
    usual = _steps(float(np.quantile(poses, 0.1)), poses_per_step)
    steps = [min(usual, _steps(float(count), poses_per_step)) for count in poses]
    return [_cut(data, robot, w) for w in replay.whole_runs(data, robot, steps)]


def _steps(poses: float, poses_per_step: int) -> int:
    """Number of steps that so many poses allow."""
    return 2 ** max(1, int(np.floor(np.log2(max(0.8 * poses / poses_per_step, 2.0)))))


def _cut(data: Runs, robot: Robot, w: Windows) -> RunBatch:
    numbers = tuple(dict.fromkeys(w.run.tolist()))
    pose = body_poses(robot, w, np.asarray(replay.corrected(robot, jnp.asarray(w.pose))))
    runs = []
    for piece, k in enumerate(numbers):
        log = data.logs[k]
        edges = w.start[piece] + np.concatenate([[0.0], np.cumsum(w.dt[piece])]) - w.lag
        signals = RunSignals(
            name=log.name,
            dt=w.dt[piece],
            turn=w.turn[piece],
            current=w.current[piece] if w.has_current else None,
            current_is_signed=w.current_is_signed,
            load=log.load,
            gyro=None if log.gyro is None else _mean(log, log.gyro[:, None], edges)[:, 0],
            command=None if log.twist_command is None else _mean(log, log.twist_command, edges),
        )
        run = Run(
            signals=signals,
            pose=pose[piece],
            floor=w.surface[piece],
            load=log.load,
            heading=float(data.heading[k]),
            speed=float(data.speed[k]),
        )
        runs.append(run)
    return RunBatch(numbers, tuple(runs), w)


def _mean(
    log: Log, x: Float[np.ndarray, "row column"], edges: Float[np.ndarray, " edge"]
) -> Float[np.ndarray, "step column"]:
    """Mean over time between edges [s]."""
    inside = np.clip(edges, log.time[0], log.time[-1])
    total = np.diff(interpolate(log.time, integral(log.time, x), inside), axis=0)
    return np.asarray(total / np.maximum(np.diff(inside), 1e-9)[:, None])


def body_poses(
    robot: Robot, w: Windows, marker: Float[np.ndarray, "piece edge 3"]
) -> Float[np.ndarray, "piece edge 3"]:
    """Poses of the body from those of its marker in corrected metres."""
    yaws = {s: float(robot.camera.yaw(robot.session_index(s))) for s in set(w.session)}
    out = marker.copy()
    out[..., 2] -= np.array([yaws[s] for s in w.session])[:, None]
    place = np.broadcast_to(np.asarray(robot.camera.marker_place), out[..., :2].shape)
    out[..., :2] -= turned(out[..., 2], place)
    return out
