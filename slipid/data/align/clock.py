"""Clock offset and drift between a run's poses and its robot, estimated from the motion itself.

A camera and a robot that were started by hand have clocks of their own. The motion of the body is
regressed on what turned (`regression`) at

    s = t + offset + drift (t - middle)

where t is the time of a pose on its own clock and s the time on the robot's clock. The noise
variances are estimated from the residuals, the interval from the disagreement between blocks of
the run.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from slipid.data.align.regression import (
    LEAST_STEPS,
    Linearised,
    MotionPair,
    PoseIncrements,
    StepNoise,
    clear_best,
    linearised,
    unexplained,
)

COARSE, SEARCHED = 0.05, 0.1
"""Step of the search for the offset, and shortest increment that the search compares [s]."""
FINE, REACH = 0.01, 0.2
"""Step and half width of the second search, with a noise model, around the first one's offset
[s]."""
LEAST_SHARED = 1.0
"""Least overlap of the two clocks that an offset must leave [s]."""
DRIFT_STD, OTHER_RATE = 1e-4, 1e-2
"""Prior stds of the drift [1]: the first is above the error of any quartz; the second replaces it
where the motion contradicts the first, for example because the frame rate is wrong."""
BLOCKS = 10
"""Number of blocks of a run whose disagreement gives the interval."""
ROUNDS, SETTLED = 20, 6
"""Most Gauss-Newton rounds, and the number of first rounds that estimate the noise anew."""
MOST_LEFT = 0.5
"""Largest part of the motion that the best offset may leave unexplained [1]."""
GOOD_STD = 0.03
"""Largest std of an offset that is used at all [s]."""
SURE_STD = 0.005
"""Std of an offset below which no other motion pair of the run is evaluated [s]."""


@dataclass(frozen=True)
class Clock:
    """Clock of a run's poses, with robot's time = t + offset + drift (t - middle).

    Attributes:
        offset: the robot's clock minus the poses' clock at `middle` [s].
        offset_std: its std [s].
        drift: rate of the robot's clock relative to the poses' clock, less one [1].
        drift_std: its std [1].
        middle: time on the poses' clock at which the offset holds [s].
        unexplained: part of the motion that the regression leaves unexplained [1].
        source: sensor that the poses were compared with.
    """

    offset: float
    offset_std: float
    drift: float
    drift_std: float
    middle: float
    unexplained: float
    source: Literal["wheels", "gyro"]

    @property
    def offset_interval90(self) -> tuple[float, float]:
        """Return the 90 % interval of the offset [s]."""
        wide = 1.645 * self.offset_std
        return self.offset - wide, self.offset + wide

    def robot_time(self, time: Float[np.ndarray, " pose"]) -> Float[np.ndarray, " pose"]:
        """Return the times of poses on the robot's clock [s]."""
        return time + self.offset + self.drift * (time - self.middle)


def best_clock(pairs: Iterable[MotionPair]) -> Clock | None:
    """Return the first certain clock from several motion pairs of a run, else the most certain one.

    The result is None where no pair determines a clock. Pairs after the first certain one are not
    evaluated.
    """
    found = []
    for pair in pairs:
        clock = clock_of_poses(pair)
        if clock is not None and clock.offset_std <= SURE_STD:
            return clock
        found += [] if clock is None else [clock]
    return min(found, key=lambda clock: clock.offset_std, default=None)


def clock_of_poses(pair: MotionPair) -> Clock | None:
    """Return the clock of a run's poses, or None where the motion does not determine it."""
    if len(pair.pose_time) < LEAST_STEPS or len(pair.time) < LEAST_STEPS:
        return None
    steps = pair.increments(pair.step)
    if len(steps.moved) < LEAST_STEPS:
        return None
    guess = _searched(pair)
    return None if guess is None else _refined(pair, steps, guess)


def _searched(pair: MotionPair) -> float | None:
    """Return the offset that explains the motion best, or None if it is not clearly the best."""
    low = pair.time[0] + LEAST_SHARED - pair.pose_time[-1]
    high = pair.time[-1] - LEAST_SHARED - pair.pose_time[0]
    if not high > low:
        return None
    offsets = np.arange(low, high + COARSE, COARSE)
    rest = unexplained([pair], offsets, SEARCHED)
    best = clear_best(offsets, rest)
    return None if best is None or not rest[best] < MOST_LEFT else float(offsets[best])


def _refined(pair: MotionPair, steps: PoseIncrements, offset: float) -> Clock | None:
    """Return the clock after Gauss-Newton steps in offset and drift, with B profiled out."""
    middle = 0.5 * float(steps.first[0] + steps.last[-1])
    grid = offset + np.arange(-REACH, REACH + FINE, FINE)
    at, noise = np.array([offset, 0.0]), tuple(StepNoise(0.0, 1.0) for _ in pair.components)
    for _ in range(2):  # the second round has the noise of the first
        every = [linearised(pair, steps, np.array([o, 0.0]), middle, noise) for o in grid]
        fits = [(near.squares, k, near.noise) for k, near in enumerate(every) if near is not None]
        if not fits:
            return None
        _, k, noise = min(fits)
        at[0] = grid[k]
    quartz, change = True, np.full(2, np.inf)
    for k in range(ROUNDS):
        now = linearised(pair, steps, at, middle, noise)
        if now is None or abs(at[0] - offset) > REACH:
            return None
        prior = np.diag([0.0, (DRIFT_STD if quartz else OTHER_RATE) ** -2])
        normal = np.einsum("kci,kcj->ij", now.slope, now.slope) + prior
        if not normal[0, 0] > 0.0:
            return None
        settled = abs(change[0]) < 1e-5
        if settled and quartz and abs(at[1]) > 3 * DRIFT_STD:
            quartz, settled = False, False
        if settled:
            return _clock(pair, now, at, np.linalg.inv(normal), middle)
        gradient = np.einsum("kci,kc->i", now.slope, now.residual) + prior @ at
        change = np.linalg.solve(normal, gradient)
        at = at - np.clip(change, -COARSE, COARSE)
        noise = now.noise if k < SETTLED else noise
    return None


def _clock(
    pair: MotionPair,
    near: Linearised,
    at: Float[np.ndarray, "2"],
    inverse: Float[np.ndarray, "2 2"],
    middle: float,
) -> Clock | None:
    """Return the clock at an optimum, or None where its offset is too uncertain to be used."""
    std = _spread(near, inverse)
    std[0] = np.hypot(std[0], pair.body_std)
    if not std[0] < GOOD_STD:
        return None
    return Clock(
        offset=float(at[0]),
        offset_std=float(std[0]),
        drift=float(at[1]),
        drift_std=float(std[1]),
        middle=middle,
        unexplained=near.share,
        source=pair.source,
    )


def _spread(near: Linearised, inverse: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2"]:
    """Return the stds of offset and drift from block scores, at least those of the model."""
    blocks = np.array_split(np.arange(len(near.residual)), BLOCKS)
    scores = np.stack([np.einsum("kci,kc->i", near.slope[b], near.residual[b]) for b in blocks])
    sandwich = inverse @ (scores.T @ scores) @ inverse * BLOCKS / (BLOCKS - 1)
    return np.asarray(np.sqrt(np.maximum(np.diag(sandwich), np.diag(inverse))))
