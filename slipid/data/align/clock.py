"""How the clock of poses goes against that of the robot, from the motion itself.

A camera and a robot that were started by hand have clocks of their own. The motion of the body is
regressed on what turned (`regression`) at

    s = t + offset + drift (t - middle)

with t on the clock of the poses, s on that of the robot. The sizes of both parts of the noise come
from the residuals, the interval from how far parts of the run disagree.
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
"""Step of the search for the offset, and least length of the steps that are compared in it [s]."""
FINE, REACH = 0.01, 0.2
"""Step and half the width of the search around that [s], with a noise model."""
LEAST_SHARED = 1.0
"""Time that both clocks must share [s]."""
DRIFT_STD, OTHER_RATE = 1e-4, 1e-2
"""Prior stds of the drift [1]: quartz errs less; the other where the motion contradicts that, as a
wrong frame rate does."""
BLOCKS = 10
"""Parts of a run that are compared for the interval."""
ROUNDS, SETTLED = 20, 6
"""Rounds of Gauss-Newton, and the first of them, in which the noise is estimated anew."""
MOST_LEFT = 0.5
"""Part of the motion that the best offset may leave unexplained [1]."""
GOOD_STD = 0.03
"""Largest std of an offset that is used [s]."""
SURE_STD = 0.005
"""Largest std of one that needs no other pair of the run [s]."""


@dataclass(frozen=True)
class Clock:
    """The clock of a run's poses: robot's time = t + offset + drift (t - middle).

    Attributes:
        offset: of the robot's clock ahead of the poses', at `middle` [s]; `offset_std` its std.
        drift: of the robot's clock against the poses' [1]; `drift_std` its std.
        middle: time on the poses' clock to which the offset belongs [s].
        left: part of the motion that is not explained [1].
        source: what turned.
    """

    offset: float
    offset_std: float
    drift: float
    drift_std: float
    middle: float
    left: float
    source: Literal["wheels", "gyro"]

    @property
    def offset_interval90(self) -> tuple[float, float]:
        """Interval that holds the offset with 90 % [s]."""
        wide = 1.645 * self.offset_std
        return self.offset - wide, self.offset + wide

    def robot_time(self, time: Float[np.ndarray, " pose"]) -> Float[np.ndarray, " pose"]:
        """Times of poses on the robot's clock [s]."""
        return time + self.offset + self.drift * (time - self.middle)


def best_clock(pairs: Iterable[MotionPair]) -> Clock | None:
    """The first clock that is sure, of several pairs of a run, else the surest; None without any.

    Pairs behind the first that is sure are not asked for.
    """
    found = []
    for pair in pairs:
        clock = clock_of_poses(pair)
        if clock is not None and clock.offset_std <= SURE_STD:
            return clock
        found += [] if clock is None else [clock]
    return min(found, key=lambda clock: clock.offset_std, default=None)


def clock_of_poses(pair: MotionPair) -> Clock | None:
    """The clock of a run's poses; None where its motion does not determine it."""
    if len(pair.pose_time) < LEAST_STEPS or len(pair.time) < LEAST_STEPS:
        return None
    steps = pair.increments(pair.step)
    if len(steps.moved) < LEAST_STEPS:
        return None
    guess = _searched(pair)
    return None if guess is None else _refined(pair, steps, guess)


def _searched(pair: MotionPair) -> float | None:
    """Offset at which least of the motion is unexplained, if no other one does about as well."""
    low = pair.time[0] + LEAST_SHARED - pair.pose_time[-1]
    high = pair.time[-1] - LEAST_SHARED - pair.pose_time[0]
    if not high > low:
        return None
    offsets = np.arange(low, high + COARSE, COARSE)
    left = unexplained([pair], offsets, SEARCHED)
    best = clear_best(offsets, left)
    return None if best is None or not left[best] < MOST_LEFT else float(offsets[best])


def _refined(pair: MotionPair, steps: PoseIncrements, offset: float) -> Clock | None:
    """Gauss-Newton for offset and drift, B profiled out; the interval by blocks."""
    middle = 0.5 * float(steps.first[0] + steps.last[-1])
    grid = offset + np.arange(-REACH, REACH + FINE, FINE)
    at, noise = np.array([offset, 0.0]), tuple(StepNoise(0.0, 1.0) for _ in pair.components)
    for _ in range(2):  # the second time with the noise of the first
        every = [linearised(pair, steps, np.array([o, 0.0]), middle, noise) for o in grid]
        left = [(near.squares, k, near.noise) for k, near in enumerate(every) if near is not None]
        if not left:
            return None
        _, k, noise = min(left)
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
        pull = np.einsum("kci,kc->i", now.slope, now.left) + prior @ at
        change = np.linalg.solve(normal, pull)
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
    """The clock at an optimum; None where its offset is too uncertain to be used."""
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
        left=near.share,
        source=pair.source,
    )


def _spread(near: Linearised, inverse: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2"]:
    """Stds of offset and drift: as parts of the run disagree, but no less than by the noise."""
    blocks = np.array_split(np.arange(len(near.left)), BLOCKS)
    scores = np.stack([np.einsum("kci,kc->i", near.slope[b], near.left[b]) for b in blocks])
    sandwich = inverse @ (scores.T @ scores) @ inverse * BLOCKS / (BLOCKS - 1)
    return np.asarray(np.sqrt(np.maximum(np.diag(sandwich), np.diag(inverse))))
