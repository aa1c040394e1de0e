"""How the clock of poses goes against that of the robot, from the motion itself.

A camera and a robot that were started by hand have clocks of their own. Over short steps the motion
of the body is regressed on what turned at the same moments,

    (ahead, left, yaw)_k = B (turned(s_k+1) - turned(s_k)) + e_k
    s = t + offset + drift (t - middle)

with t on the clock of the poses, s on that of the robot, and one B for the run. It needs no sizes,
signs or order of the wheels, but changes of speed: starts, stops and turns. In e is what the camera
errs and, of each step of its own, what slip does; their sizes are told from what is left over. The
interval is told by how far parts of the run disagree.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.data.clocks.motion import Motion, Steps
from slipid.data.clocks.noise import StepNoise

COARSE, SEARCHED = 0.05, 0.1
"""Step of the search for the offset, and least length of the steps that are compared in it [s]."""
FINE, REACH = 0.01, 0.2
"""Step and half the width of the search around that [s], in which noise is told from slip."""
LEAST_SHARED = 1.0
"""Time that both clocks must share [s]."""
DRIFT_STD, OTHER_RATE = 1e-4, 1e-2
"""Of the rates of two clocks, before the motion is looked at [1]: quartz errs less; and where the
motion contradicts that, as a frame rate does that is not what it is said to be."""
BLOCKS = 10
"""Parts of a run that are compared for the interval."""
ROUNDS, SETTLED = 20, 6
"""Of Gauss-Newton, and of those the ones in which the noise is told anew."""
ELSEWHERE, BETTER = 0.5, 0.02
"""Other offsets, further away than this [s], must leave more of the motion unexplained, by so much
of it [1]: steady motion, or the same again and again, tells no offset."""
MOST_LEFT = 0.5
"""Part of the motion that the best offset may leave unexplained [1]."""
GOOD_STD = 0.03
"""Std of an offset that is told [s]."""
SURE_STD = 0.005
"""Std of one that needs no other view of the run [s]."""
LEAST_STEPS = 20


@dataclass(frozen=True)
class Clock:
    """The clock of a run's poses: robot's time = t + offset + drift (t - middle).

    Attributes:
        offset: of the robot's clock ahead of the poses', at `middle` [s]; `offset_std` its std.
        drift: of the robot's clock against the poses' [1]; `drift_std` its std.
        middle: time on the poses' clock to which the offset belongs [s].
        left: part of the motion that is not explained [1].
        told_by: "gyro" or "wheels".
    """

    offset: float
    offset_std: float
    drift: float
    drift_std: float
    middle: float
    left: float
    told_by: str

    @property
    def offset_interval90(self) -> tuple[float, float]:
        """Interval that holds the offset with 90 % [s]."""
        wide = 1.645 * self.offset_std
        return self.offset - wide, self.offset + wide

    def robot_time(self, time: Float[np.ndarray, " pose"]) -> Float[np.ndarray, " pose"]:
        """Times of poses on the robot's clock [s]."""
        return time + self.offset + self.drift * (time - self.middle)

    def __str__(self) -> str:
        """What was found, with 90 % intervals."""
        return (
            f"{self.offset:+.4f} s (+- {1.645 * self.offset_std:.4f}), "
            f"{1e6 * self.drift:+.0f} ppm (+- {1.645e6 * self.drift_std:.0f})"
        )


def best_clock(motions: Iterable[Motion]) -> Clock | None:
    """The first clock that is sure, of several views of a run, else the surest; None without any.

    Views behind the first that is sure are not asked for.
    """
    found = []
    for motion in motions:
        clock = clock_of_poses(motion)
        if clock is not None and clock.offset_std <= SURE_STD:
            return clock
        found += [] if clock is None else [clock]
    return min(found, key=lambda clock: clock.offset_std, default=None)


def clock_of_poses(motion: Motion) -> Clock | None:
    """The clock of a run's poses; None where its motion does not tell it."""
    if len(motion.pose_time) < LEAST_STEPS or len(motion.time) < LEAST_STEPS:
        return None
    steps = motion.steps(motion.step)
    if len(steps.moved) < LEAST_STEPS:
        return None
    guess = _searched(motion)
    return None if guess is None else _refined(motion, steps, guess)


def _searched(motion: Motion) -> float | None:
    """Offset at which least of the motion is unexplained, if no other one does about as well."""
    steps = motion.steps(SEARCHED)
    moved = motion.scaled(steps.moved)
    low = motion.time[0] + LEAST_SHARED - steps.last[-1]
    high = motion.time[-1] - LEAST_SHARED - steps.first[0]
    if not high > low:
        return None
    offsets = np.arange(low, high + COARSE, COARSE)
    left = np.array([_unexplained(motion, steps, moved, offset) for offset in offsets])
    best = int(np.argmin(left))
    others = left[np.abs(offsets - offsets[best]) > ELSEWHERE]
    if (len(others) and not others.min() > left[best] + BETTER) or not left[best] < MOST_LEFT:
        return None
    return float(offsets[best])


def _unexplained(
    motion: Motion, steps: Steps, moved: Float[np.ndarray, "step 3"], offset: float
) -> float:
    """Part of the motion that what turned does not explain at an offset."""
    x = motion.turned_at(steps.last + offset) - motion.turned_at(steps.first + offset)
    rest = moved - x @ np.linalg.lstsq(x, moved, rcond=motion.collinear)[0]
    return float((rest**2).sum() / max((moved**2).sum(), 1e-12))


@dataclass(frozen=True, eq=False)
class _Near:
    """The motion near a clock, whitened.

    Attributes:
        left: what is left over, component by component.
        slope: its derivative by offset and drift, less what another B makes of it.
        share: part of the motion that is left over.
        noise: of each component.
    """

    left: Float[np.ndarray, "step 3"]
    slope: Float[np.ndarray, "step 3 2"]
    share: float
    noise: tuple[StepNoise, ...]

    @property
    def squares(self) -> float:
        """Sum of the squares of what is left over."""
        return float((self.left**2).sum())


def _refined(motion: Motion, steps: Steps, offset: float) -> Clock | None:
    """Gauss-Newton for offset and drift, B profiled out; the interval by blocks."""
    middle = 0.5 * float(steps.first[0] + steps.last[-1])
    grid = offset + np.arange(-REACH, REACH + FINE, FINE)
    at, noise = np.array([offset, 0.0]), tuple(StepNoise(0.0, 1.0) for _ in range(3))
    for _ in range(2):  # the second time with the noise of the first
        every = [_near(motion, steps, np.array([o, 0.0]), middle, noise) for o in grid]
        told = [(near.squares, k, near.noise) for k, near in enumerate(every) if near is not None]
        if not told:
            return None
        _, k, noise = min(told)
        at[0] = grid[k]
    quartz, change = True, np.full(2, np.inf)
    for k in range(ROUNDS):
        now = _near(motion, steps, at, middle, noise)
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
            return _told(motion, now, at, np.linalg.inv(normal), middle)
        pull = np.einsum("kci,kc->i", now.slope, now.left) + prior @ at
        change = np.linalg.solve(normal, pull)
        at = at - np.clip(change, -COARSE, COARSE)
        noise = now.noise if k < SETTLED else noise
    return None


def _told(
    motion: Motion,
    near: _Near,
    at: Float[np.ndarray, "2"],
    inverse: Float[np.ndarray, "2 2"],
    middle: float,
) -> Clock | None:
    """The clock at an optimum; None where it is not told well enough to be used."""
    std = _spread(near, inverse)
    std[0] = np.hypot(std[0], motion.body_std)
    if not std[0] < GOOD_STD:
        return None
    return Clock(
        offset=float(at[0]),
        offset_std=float(std[0]),
        drift=float(at[1]),
        drift_std=float(std[1]),
        middle=middle,
        left=near.share,
        told_by=motion.told_by,
    )


def _spread(near: _Near, inverse: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2"]:
    """Stds of offset and drift: as parts of the run disagree, but no less than the noise tells."""
    blocks = np.array_split(np.arange(len(near.left)), BLOCKS)
    scores = np.stack([np.einsum("kci,kc->i", near.slope[b], near.left[b]) for b in blocks])
    sandwich = inverse @ (scores.T @ scores) @ inverse * BLOCKS / (BLOCKS - 1)
    return np.asarray(np.sqrt(np.maximum(np.diag(sandwich), np.diag(inverse))))


def _near(
    motion: Motion,
    steps: Steps,
    at: Float[np.ndarray, "2"],
    middle: float,
    noise: Sequence[StepNoise],
) -> _Near | None:
    """The motion at an offset and a drift; None where the records share too little."""
    first, last = (t + at[0] + at[1] * (t - middle) for t in (steps.first, steps.last))
    inside = (first > motion.time[0] + motion.step) & (last < motion.time[-1] - motion.step)
    if inside.sum() < LEAST_STEPS:
        return None
    first, last, moved = first[inside], last[inside], steps.moved[inside]
    joined = np.concatenate([[False], steps.first[inside][1:] == steps.last[inside][:-1]])
    turned = motion.turned_at(last) - motion.turned_at(first)
    begins, ends = motion.rate_at(first), motion.rate_at(last)
    since = np.stack([steps.first[inside], steps.last[inside]]) - middle
    by_drift = ends * since[1][:, None] - begins * since[0][:, None]
    parts = [
        _component(np.column_stack([y, turned, ends - begins, by_drift]), one, joined, motion)
        for y, one in zip(moved.T, noise, strict=True)
    ]
    share = sum(p.squares for p in parts) / max(float((moved**2).sum()), 1e-12)
    left, slope = np.stack([p.left for p in parts], 1), np.stack([p.slope for p in parts], 1)
    return _Near(left, slope, share, tuple(p.noise for p in parts))


@dataclass(frozen=True, eq=False)
class _Component:
    """`_Near` of one component; `squares` is of what is left over before it is whitened."""

    left: Float[np.ndarray, " step"]
    slope: Float[np.ndarray, "step 2"]
    squares: float
    noise: StepNoise


def _component(
    columns: Float[np.ndarray, "step column"],
    noise: StepNoise,
    joined: np.ndarray,
    motion: Motion,
) -> _Component:
    """Regress the first column on the next ones; the last are their derivatives."""
    count = motion.turned.shape[1]
    white = noise.whitened(columns, joined)
    y, x = white[:, 0], white[:, 1 : 1 + count]
    b = np.linalg.lstsq(x, y, rcond=motion.collinear)[0]
    by = np.column_stack([m @ b for m in np.split(white[:, 1 + count :], 2, axis=1)])
    by = by - x @ np.linalg.lstsq(x, by, rcond=motion.collinear)[0]
    rest = columns[:, 1 : 1 + count] @ b - columns[:, 0]
    return _Component(x @ b - y, by, float((rest**2).sum()), StepNoise.of(rest, joined))
