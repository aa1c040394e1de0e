"""What wheels, commands and poses say of the same steps of motion, at a lag of the poses."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.data.sanity.motion.recorded import Flat, Recorded

STEP_S = 0.4
"""Length of a step [s]: long beside jitter and rounding, short beside a turn of the robot."""
MOST_STEPS = 20_000
"""Steps beyond which they are made longer; that happens where time is in the wrong unit."""


@dataclass(frozen=True, eq=False)
class Edges:
    """Times between which motion is compared, and where the poses were then.

    Attributes:
        before, after: begin and end of each step on the clock of `Recorded` (step,) [s].
        run: that each step belongs to (step,).
        pose_before, pose_after: poses then (step, 3), as logged.
    """

    before: Float[np.ndarray, " step"]
    after: Float[np.ndarray, " step"]
    run: Int[np.ndarray, " step"]
    pose_before: Float[np.ndarray, "step 3"]
    pose_after: Float[np.ndarray, "step 3"]


@dataclass(frozen=True, eq=False)
class Steps:
    """Increments over the same steps.

    Attributes:
        lag: of the poses behind the encoders that was assumed [s].
        wheels: rotation of each wheel [rad]; nan where it was not recorded for the whole step.
        commanded: rotation of each wheel that was commanded [rad], or None.
        twist: step of the body that was commanded, in its axes [m, m, rad], or None.
        gyro: turn by the gyro [rad], or None.
    """

    lag: float
    wheels: Float[np.ndarray, "step wheel"]
    commanded: Float[np.ndarray, "step wheel"] | None
    twist: Float[np.ndarray, "step 3"] | None
    gyro: Float[np.ndarray, "step 1"] | None


def edges(data: Recorded) -> Edges:
    """Steps of about `STEP_S` of every run, from its first pose to its last."""
    length = data.end - data.begin
    step = max(min(STEP_S, float(np.median(length)) / 8), float(np.median(data.row)))
    step = max(step, float(length.sum()) / MOST_STEPS)
    count = np.maximum(np.round(length / step).astype(int), 1)
    run = np.repeat(np.arange(len(count)), count)
    within = np.arange(len(run)) - np.repeat(np.cumsum(count) - count, count)
    each = (length / count)[run]
    before = data.begin[run] + within * each
    after = before + each
    return Edges(before, after, run, data.pose.at(before), data.pose.at(after))


def turns(data: Recorded, at: Edges, lag: float) -> Float[np.ndarray, "step wheel"]:
    """Rotation of each wheel [rad], `lag` before the poses; nan where it was not recorded."""
    return _moved(data, data.angle, at, lag)


def _moved(
    data: Recorded, channel: Flat, at: Edges, lag: float
) -> Float[np.ndarray, "step column"]:
    """Change of a channel over each step; nan outside of its run."""
    change = channel.at(at.after - lag) - channel.at(at.before - lag)
    change[~_inside(data, at, lag)] = np.nan
    return change


def _inside(data: Recorded, at: Edges, lag: float) -> Bool[np.ndarray, " step"]:
    slack = data.row[at.run]
    begins = at.before - lag >= data.begin[at.run] - slack
    return np.asarray(begins & (at.after - lag <= data.end[at.run] + slack))


def steps(data: Recorded, at: Edges, lag: float) -> Steps:
    """Increments of every channel on the robot's clock, `lag` before those of the poses."""

    def maybe(channel: Flat | None) -> np.ndarray | None:
        return None if channel is None else _moved(data, channel, at, lag)

    return Steps(
        lag,
        turns(data, at, lag),
        maybe(data.commanded),
        maybe(data.twist),
        maybe(data.gyro),
    )
