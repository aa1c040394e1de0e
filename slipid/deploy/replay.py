"""An estimator run over a logged run, as if it had run on the robot."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.data.log import Log
from slipid.data.wheel_signals import interpolate
from slipid.robot.estimator import Estimator
from slipid.robot.interface import Measurement, StateEstimate

LONGEST_STEP_S = 0.25
"""Longest step given to an estimator [s]. Longer steps are split, since an estimator rejects steps
of 0.5 s and more."""
ROWS_MULTIPLE = 256
"""The rows of a replay are padded to a multiple of this number, so that the estimator is compiled
for few array sizes."""


@dataclass(frozen=True, eq=False)
class Start:
    """Time and pose at which an estimator starts.

    Attributes:
        time: time in the run [s].
        pose: x, y [m] and heading [rad].
        std: std of the position [m] and of the heading [rad].
    """

    time: float
    pose: tuple[float, float, float]
    std: tuple[float, float]


@dataclass(frozen=True, eq=False)
class EstimatedRun:
    """Estimates in a run.

    Attributes:
        time: time in the run of each estimate [s].
        estimate: the estimates; its arrays are those of numpy, with a leading axis of rows.
    """

    time: Float[np.ndarray, " row"]
    estimate: StateEstimate

    def rows(self, picked: np.ndarray) -> "EstimatedRun":
        """Return some of the estimates."""
        some = jax.tree.map(lambda leaf: leaf[picked], self.estimate)
        return EstimatedRun(self.time[picked], some)


def estimated(estimator: Estimator, log: Log, start: Start) -> EstimatedRun:
    """Return the estimates of a robot that reads its sensors as in a log, without any pose.

    The first row only gives the first angles of the wheels. Readings that a log repeats are given
    once.

    Args:
        estimator: the estimator, for the log's load set-up.
        log: the run.
        start: time and pose at the start.
    """
    times = np.concatenate([[start.time], log.time[log.time > start.time]])
    parts = np.ceil(np.diff(times) / LONGEST_STEP_S - 1e-9).astype(int).clip(1)
    index = np.concatenate([[0], np.cumsum(parts)])
    grid = np.interp(np.arange(index[-1] + 1), index, times)
    logged = np.searchsorted(grid, times[1:])
    kept = log.time > start.time

    def readings(values: np.ndarray | None, fresh: np.ndarray | None = None) -> np.ndarray | None:
        if values is None:
            return None
        out = np.full((len(grid), *values.shape[1:]), np.nan)
        out[logged] = (values if fresh is None else np.where(fresh, values, np.nan))[kept]
        return out

    rows = {
        "wheel_angle": interpolate(log.time, log.wheel_angle, grid),
        "current": readings(log.current, log.current_fresh),
        "voltage": readings(log.voltage, log.voltage_fresh),
        "gyro": readings(log.gyro),
        "steering_angle": readings(log.steering),
    }
    padding = -len(grid) % ROWS_MULTIPLE
    padded = {
        name: jnp.asarray(np.concatenate([x, np.repeat(x[-1:], padding, axis=0)]))
        for name, x in rows.items()
        if x is not None
    }
    dt = np.concatenate([[0.0], np.diff(grid), np.zeros(padding)])
    pose, std = jnp.asarray(start.pose), jnp.asarray(start.std)
    found = _estimates(estimator, pose, std, Measurement(**padded), jnp.asarray(dt))
    whole = jax.tree.map(lambda leaf: np.asarray(leaf)[index[1:]], found)
    return EstimatedRun(times[1:], whole)


@eqx.filter_jit
def _estimates(
    estimator: Estimator,
    pose: Float[Array, "3"],
    std: Float[Array, "2"],
    rows: Measurement,
    dt: Float[Array, " row"],
) -> StateEstimate:
    def step(state: Any, row: tuple[Measurement, Array]) -> Any:
        return estimator.step(state, *row)

    found: StateEstimate = jax.lax.scan(step, estimator.init(pose, std), (rows, dt))[1]
    return found
