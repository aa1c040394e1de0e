"""Clock offset and drift between a run's poses and its robot, estimated from the motion itself.

A camera and a robot that were started separately have independent clocks. The increments of the
pose are regressed on the rotation of the wheels, or of the gyro (see `regression`), at the time

    s = t + offset + drift (t - middle)

where t is the time of a pose on the clock of the poses and s the time on the robot's clock. The
noise variances are estimated from the residuals; the stds of offset and drift are estimated from
the disagreement between blocks of the run.
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

COARSE_GRID_S, COARSE_STEP_S = 0.05, 0.1
"""Grid spacing of the first search for the offset, and shortest duration of the pose increments
that it compares [s]."""
FINE_GRID_S, FINE_HALF_WIDTH_S = 0.01, 0.2
"""Grid spacing and half width of the second search, which has a noise model, around the offset that
the first search found [s]."""
LEAST_OVERLAP_S = 1.0
"""Shortest overlap of the record of poses with the robot's record at any searched offset [s]."""
DRIFT_STD, WIDE_DRIFT_STD = 1e-4, 1e-2
"""Prior stds of the drift [1]: the first is larger than the error of any quartz clock; the second
replaces it if the motion contradicts it, for example because the declared frame rate is wrong."""
BLOCKS = 10
"""Number of blocks of a run whose disagreement gives the stds of offset and drift."""
MOST_ITERATIONS, NOISE_ITERATIONS = 20, 6
"""Largest number of Gauss-Newton iterations, and number of initial iterations that re-estimate the
noise."""
MOST_UNEXPLAINED = 0.5
"""Largest fraction of the motion that the regression at the best offset may leave unexplained
[1]."""
LARGEST_STD_S = 0.03
"""Std above which an offset is discarded [s]."""
SUFFICIENT_STD_S = 0.005
"""Std below which an offset is accepted without evaluating further motion pairs of the run [s]."""


@dataclass(frozen=True)
class Clock:
    """Clock of a run's poses: the robot's time is t + offset + drift (t - middle).

    Attributes:
        offset: the robot's clock minus the poses' clock at `middle` [s].
        offset_std: std of the offset [s].
        drift: rate of the robot's clock relative to the poses' clock, less one [1].
        drift_std: std of the drift [1].
        middle: time on the poses' clock at which the offset holds [s].
        unexplained: fraction of the motion that the regression leaves unexplained [1].
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
    """Return a run's clock offset and drift from the first motion pair that determines them well.

    A pair determines them well if the std of the offset is at most `SUFFICIENT_STD_S`; the pairs
    after it are not evaluated. If no pair reaches this std, the result is the clock whose offset
    has the smallest std, or None if no pair determines offset and drift.
    """
    found = []
    for pair in pairs:
        clock = clock_of_poses(pair)
        if clock is not None and clock.offset_std <= SUFFICIENT_STD_S:
            return clock
        found += [] if clock is None else [clock]
    return min(found, key=lambda clock: clock.offset_std, default=None)


def clock_of_poses(pair: MotionPair) -> Clock | None:
    """Return the clock offset and drift of a run's poses; None if the motion does not show them."""
    if len(pair.pose_time) < LEAST_STEPS or len(pair.time) < LEAST_STEPS:
        return None
    steps = pair.increments(pair.step)
    if len(steps.moved) < LEAST_STEPS:
        return None
    guess = _searched(pair)
    return None if guess is None else _refined(pair, steps, guess)


def _searched(pair: MotionPair) -> float | None:
    """Return the offset [s] that explains the motion best, or None if no offset is clearly best."""
    low = pair.time[0] + LEAST_OVERLAP_S - pair.pose_time[-1]
    high = pair.time[-1] - LEAST_OVERLAP_S - pair.pose_time[0]
    if not high > low:
        return None
    offsets = np.arange(low, high + COARSE_GRID_S, COARSE_GRID_S)
    rest = unexplained([pair], offsets, COARSE_STEP_S)
    best = clear_best(offsets, rest)
    return None if best is None or not rest[best] < MOST_UNEXPLAINED else float(offsets[best])


def _refined(pair: MotionPair, steps: PoseIncrements, offset: float) -> Clock | None:
    """Return the clock offset and drift from Gauss-Newton iterations.

    The matrix B of the regression (see module `regression`) is profiled out. The result is None if
    the iterations do not converge, or if the offset leaves the given one [s] by more than
    `FINE_HALF_WIDTH_S`.
    """
    middle = 0.5 * float(steps.first[0] + steps.last[-1])
    grid = offset + np.arange(-FINE_HALF_WIDTH_S, FINE_HALF_WIDTH_S + FINE_GRID_S, FINE_GRID_S)
    at, noise = np.array([offset, 0.0]), tuple(StepNoise(0.0, 1.0) for _ in steps.moved.T)
    for _ in range(2):  # the second search whitens with the noise estimated in the first
        every = [linearised(pair, steps, np.array([o, 0.0]), middle, noise) for o in grid]
        fits = [(near.squares, k, near.noise) for k, near in enumerate(every) if near is not None]
        if not fits:
            return None
        _, k, noise = min(fits)
        at[0] = grid[k]
    quartz, change = True, np.full(2, np.inf)
    for k in range(MOST_ITERATIONS):
        now = linearised(pair, steps, at, middle, noise)
        if now is None or abs(at[0] - offset) > FINE_HALF_WIDTH_S:
            return None
        prior = np.diag([0.0, (DRIFT_STD if quartz else WIDE_DRIFT_STD) ** -2])
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
        at = at - np.clip(change, -COARSE_GRID_S, COARSE_GRID_S)
        noise = now.noise if k < NOISE_ITERATIONS else noise
    return None


def _clock(
    pair: MotionPair,
    near: Linearised,
    at: Float[np.ndarray, "2"],
    inverse: Float[np.ndarray, "2 2"],
    middle: float,
) -> Clock | None:
    """Return the clock at an optimum, or None if its offset std is not below `LARGEST_STD_S`.

    Args:
        pair: motion pair.
        near: regression linearised at the optimum.
        at: optimal offset at `middle` [s] and drift [1].
        inverse: inverse of the normal matrix at the optimum, for offset and drift.
        middle: time on the poses' clock at which the offset holds [s].
    """
    std = _spread(near, inverse)
    std[0] = np.hypot(std[0], pair.body_std)
    if not std[0] < LARGEST_STD_S:
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
    """Return the stds of offset [s] and drift [1] from the gradients of blocks of the run.

    The sandwich formula is used. The stds are at least the model-based ones, which follow from
    `inverse`, the inverse of the normal matrix.
    """
    blocks = np.array_split(np.arange(len(near.residual)), BLOCKS)
    scores = np.stack([np.einsum("kci,kc->i", near.slope[b], near.residual[b]) for b in blocks])
    sandwich = inverse @ (scores.T @ scores) @ inverse * BLOCKS / (BLOCKS - 1)
    return np.asarray(np.sqrt(np.maximum(np.diag(sandwich), np.diag(inverse))))
