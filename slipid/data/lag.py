"""How far poses come behind the turns of the wheels, from the motion itself.

Over steps of a run the motion of the body is regressed on the turns of the wheels a lag earlier,

    (ahead, left, yaw)_k = B (angle(t_k+1 - lag) - angle(t_k - lag)) + e_k

with one B for all runs, and the lag is where least is left over. It needs no sizes, signs or order
of the wheels, but runs in which the speed changes: steady motion looks the same at any lag.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.data.runs import Runs
from slipid.data.wheel_signals import body_steps, interpolate

LONGEST = 3.0
"""Lag of either sign that is looked for [s]."""
COARSE, FINE = 0.1, 0.01
"""Steps of the search [s]."""
STEP = 0.2
"""Least length of the steps that are compared [s]."""
MOST_RUNS = 40
"""Runs that are looked at, evenly picked from all."""
TOLD = 0.02
"""Part of what is left at a lag of zero, or at the ends, that the best must be better by."""


@dataclass(frozen=True)
class Lag:
    """Lag of the poses behind the encoders [s], and the part of the motion that is left over.

    Attributes:
        seconds: positive where poses are late.
        left: sum of squares that is left over that of the motion.
        left_at_zero: the same without a lag.
    """

    seconds: float
    left: float
    left_at_zero: float


def pose_lag(data: Runs) -> Lag | None:
    """Lag of the poses of some runs; None where no lag is told apart from others."""
    some = np.unique(np.linspace(0, len(data) - 1, MOST_RUNS).round().astype(int))
    steps = [_steps(data, k) for k in some.tolist()]
    if not any(len(run.edge) > 1 for run in steps):
        return None
    coarse = np.arange(-LONGEST, LONGEST + COARSE / 2, COARSE)
    left = np.array([_left(steps, lag) for lag in coarse])
    best = int(np.argmin(left))
    if best in (0, len(coarse) - 1) or left.max() - left[best] < TOLD * left.max():
        return None
    fine = coarse[best] + np.arange(-COARSE, COARSE + FINE / 2, FINE)
    near = np.array([_left(steps, lag) for lag in fine])
    k = int(np.argmin(near))
    return Lag(float(fine[k]), float(near[k]), _left(steps, 0.0))


@dataclass(frozen=True, eq=False)
class _Steps:
    """Edges of the steps of a run [s], the motion in between, and when which wheel stood how."""

    edge: Float[np.ndarray, " edge"]
    motion: Float[np.ndarray, "step 3"]
    time: Float[np.ndarray, " time"]
    angle: Float[np.ndarray, "time wheel"]

    def angle_at(self, at: Float[np.ndarray, " at"]) -> Float[np.ndarray, "at wheel"]:
        """Wheel angles at some times, going on as they were before the log begins and ends.

        Every lag is then judged by the same steps.
        """
        out = interpolate(self.time, self.angle, at)
        for end, row, near in ((self.time[0], 0, STEP), (self.time[-1], -1, -STEP)):
            other = interpolate(self.time, self.angle, np.array([end + near]))[0]
            beyond = (at < end) if near > 0 else (at > end)
            out[beyond] += (at[beyond] - end)[:, None] * (other - self.angle[row]) / near
        return out


def _steps(data: Runs, run: int) -> _Steps:
    rows = data.rows(run)
    time, angle = data.time[rows], data.wheel_angle[rows]
    fresh = np.flatnonzero(data.fresh[rows])
    # steps are of the same length where poses come evenly, and none is shorter than STEP
    usual = float(np.median(np.diff(time[fresh]))) if len(fresh) > 1 else STEP
    edges = fresh[:: max(1, int(np.ceil(STEP / max(usual, 1e-6) - 1e-6)))]
    return _Steps(time[edges], body_steps(data.pose[rows][edges]), time, angle)


def _left(steps: list[_Steps], lag: float) -> float:
    """Part of the motion that the turns of the wheels a lag earlier do not explain."""
    turned = [np.diff(run.angle_at(run.edge - lag), axis=0) for run in steps]
    x, y = np.concatenate(turned), np.concatenate([run.motion for run in steps])
    if len(y) < 3 * x.shape[1]:
        return 1.0
    size = np.maximum(np.sqrt((y**2).mean(axis=0)), 1e-12)
    y = y / size
    rest = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    # sideways motion that wheels cannot tell is the same at every lag, and noise
    whole = np.maximum((y**2).sum(axis=0), 1e-12)
    told = np.clip(1.0 - (rest**2).sum(axis=0) / whole, 0.0, None)
    return float(1.0 - told.mean())
