"""One motion, measured twice: by a robot's wheels or gyro, and as poses with times of their own.

Least squares of pose increments on what wheels or a gyro turned, as a function of an offset.

    moved_k = B (turned(last_k + offset) - turned(first_k + offset)) + e_k

It needs no sizes, signs or order of the wheels, but changes of speed: steady motion looks the same
at any offset. A search compares offsets by what is left over; near the best one `linearised` has
the derivatives by offset and drift, with a noise model: in e is what the camera errs, which
neighbouring steps share, and what slip does to each step of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.linalg import cholesky_banded, solve_banded

from slipid.data.wheel_signals import body_steps, integral


@dataclass(frozen=True, eq=False)
class PoseIncrements:
    """Begin and end of each step by the times of the poses [s], and how the pose changed.

    The components of `moved` are those of the pair: ahead [m], left [m], yaw [rad].
    """

    first: Float[np.ndarray, " step"]
    last: Float[np.ndarray, " step"]
    moved: Float[np.ndarray, "step component"]


@dataclass(frozen=True, eq=False)
class MotionPair:
    """Motion of a run by its robot and by its poses.

    Attributes:
        time, turned: of the robot [s], and angles of its wheels [rad] or what else grows with its
            motion.
        pose_time, pose: of the body [s], x, y [m], heading [rad] without wrap-around.
        source: what turned.
        step: least length of the steps that are compared [s].
        collinear: directions of `turned` below this share of the largest are not fitted: on a
            straight path all wheels say the same.
        body_std: std of the time by which the body follows what turned [s].
        components: those of the pose increments that are compared.
        goes_on: whether the robot moved before and after its record as at its ends; else it stood.
    """

    time: Float[np.ndarray, " row"]
    turned: Float[np.ndarray, "row column"]
    pose_time: Float[np.ndarray, " pose"]
    pose: Float[np.ndarray, "pose 3"]
    source: Literal["wheels", "gyro"]
    step: float
    collinear: float
    body_std: float = 0.0
    components: tuple[int, ...] = (0, 1, 2)
    goes_on: bool = False

    @classmethod
    def of_wheels(
        cls,
        time: Float[np.ndarray, " row"],
        angle: Float[np.ndarray, "row wheel"],
        pose_time: Float[np.ndarray, " pose"],
        pose: Float[np.ndarray, "pose 3"],
    ) -> "MotionPair":
        """The pair of wheels and poses. Steps are longer than a roller takes to pass under a wheel.

        While a robot accelerates its wheels slip more, and a soft floor gives way: nothing tells
        that from a body that comes late, by some 10 ms where the floor is firm and more on carpets.
        """
        robot = time, angle, pose_time, pose
        return cls(*robot, "wheels", step=0.1, collinear=0.1, body_std=0.015)

    @classmethod
    def of_gyro(
        cls,
        time: Float[np.ndarray, " row"],
        gyro: Float[np.ndarray, " row"],
        pose_time: Float[np.ndarray, " pose"],
        pose: Float[np.ndarray, "pose 3"],
    ) -> "MotionPair":
        """The pair of headings and a gyro [rad/s] with a scale and a bias of its own."""
        turned = np.column_stack([integral(time, gyro[:, None]), time])
        return cls(time, turned, pose_time, pose, "gyro", step=0.02, collinear=0.0, components=(2,))

    def increments(self, least: float) -> PoseIncrements:
        """Increments over steps of at least some length [s], none across a gap of the poses."""
        t = self.pose_time
        usual = max(float(np.median(np.diff(t))), 1e-6)
        stride = max(1, int(np.ceil(least / usual - 1e-6)))
        edges = np.arange(0, len(t), stride)
        first, last = t[edges[:-1]], t[edges[1:]]
        whole = last - first < 2.0 * max(stride * usual, least)
        moved = body_steps(self.pose[edges])[:, list(self.components)]
        return PoseIncrements(first[whole], last[whole], moved[whole])

    def turned_at(self, at: Float[np.ndarray, " at"]) -> Float[np.ndarray, "at column"]:
        """Interpolate what had turned at times of the robot."""
        inside = np.clip(at, self.time[0], self.time[-1])
        turned = np.asarray(self._spline(inside))
        if self.goes_on:
            beyond = (at - inside)[:, None]
            turned = turned + beyond * np.where(beyond < 0, *self._end_rates)
        return turned

    def rate_at(self, at: Float[np.ndarray, " at"]) -> Float[np.ndarray, "at column"]:
        """Rate at which it turned then, over a step."""
        half = 0.5 * self.step
        return (self.turned_at(at + half) - self.turned_at(at - half)) / self.step

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.time, self.turned)

    @cached_property
    def _end_rates(self) -> Float[np.ndarray, "2 column"]:
        """Rates in the first and in the last step of the record."""
        ends = self.time[[0, -1]]
        within = np.clip(ends + self.step * np.array([1.0, -1.0]), *ends)
        return np.asarray((self._spline(within) - self._spline(ends)) / (within - ends)[:, None])


LEAST_STEPS = 20
"""Steps that offset and drift are fitted to."""
LEAST_PER_COLUMN = 3
"""Steps that a search needs for every column of what turned."""
ELSEWHERE, BETTER = 0.5, 0.02
"""Other offsets, further away than this [s], must leave more of the motion unexplained, by so much
of it [1]: steady motion, or the same again and again, determines no offset."""


def unexplained(
    pairs: Sequence[MotionPair], offsets: Float[np.ndarray, " offset"], step: float
) -> Float[np.ndarray, " offset"]:
    """Part of the motion of all pairs that one B leaves unexplained at each offset.

    It is the geometric mean of the parts of each component: the profile likelihood, where each
    component has noise of its own size. So units do not matter, and a component that nothing
    explains, such as the sideways motion of two wheels, hides no other.
    """
    steps = [pair.increments(step) for pair in pairs]
    moved = np.concatenate([one.moved for one in steps])
    whole = (moved**2).sum(axis=0)
    moves = whole > 0

    def left(offset: float) -> float:
        turned = np.concatenate(
            [
                pair.turned_at(one.last + offset) - pair.turned_at(one.first + offset)
                for pair, one in zip(pairs, steps, strict=True)
            ]
        )
        if len(turned) < LEAST_PER_COLUMN * turned.shape[1]:
            return 1.0
        rest = moved - turned @ np.linalg.lstsq(turned, moved, rcond=pairs[0].collinear)[0]
        share = np.where(moves, (rest**2).sum(axis=0) / np.where(moves, whole, 1.0), 1.0)
        return float(np.exp(np.log(share.clip(1e-12)).mean()))

    return np.array([left(float(offset)) for offset in offsets])


def clear_best(
    offsets: Float[np.ndarray, " offset"], left: Float[np.ndarray, " offset"]
) -> int | None:
    """Number of the offset that leaves least; None where one elsewhere does about as well."""
    best = int(np.argmin(left))
    others = left[np.abs(offsets - offsets[best]) > ELSEWHERE]
    return best if others.min(initial=np.inf) > left[best] + BETTER else None


@dataclass(frozen=True, eq=False)
class StepNoise:
    """Noise in the steps of one component.

    Attributes:
        seen: variance of where the body was seen, which two neighbouring steps share.
        own: variance of each step of its own, as of slip.
    """

    seen: float
    own: float

    @classmethod
    def of(cls, left: Float[np.ndarray, " step"], joined: Bool[np.ndarray, " step"]) -> "StepNoise":
        """Estimate from residuals of steps; those that are `joined` begin where the last ended."""
        whole = max(float((left**2).mean()), 1e-12)
        neighbours = (left[1:] * left[:-1])[joined[1:]]
        seen = float(np.clip(-neighbours.mean(), 0.0, 0.499 * whole)) if len(neighbours) else 0.0
        return cls(seen, whole - 2.0 * seen)

    def whitened(
        self, rows: Float[np.ndarray, "step column"], joined: Bool[np.ndarray, " step"]
    ) -> Float[np.ndarray, "step column"]:
        """Columns times the inverse root of the covariance: 2 seen + own, and -seen beside it."""
        beside = np.where(joined[1:], -self.seen, 0.0)
        band = np.stack([np.full(len(rows), 2.0 * self.seen + self.own), np.append(beside, 0.0)])
        return np.asarray(solve_banded((1, 0), cholesky_banded(band, lower=True), rows))


@dataclass(frozen=True, eq=False)
class Linearised:
    """The regression near an offset and a drift, whitened.

    Attributes:
        left: weighted residuals.
        slope: their derivatives by offset and drift, less what another B makes of them.
        share: part of the motion that is left over.
        noise: of each component.
    """

    left: Float[np.ndarray, "step component"]
    slope: Float[np.ndarray, "step component 2"]
    share: float
    noise: tuple[StepNoise, ...]

    @property
    def squares(self) -> float:
        """Sum of the squared weighted residuals."""
        return float((self.left**2).sum())


def linearised(
    pair: MotionPair,
    steps: PoseIncrements,
    at: Float[np.ndarray, "2"],
    middle: float,
    noise: Sequence[StepNoise],
) -> Linearised | None:
    """The regression at an offset and a drift about `middle`; None where too few steps are shared.

    Args:
        at: offset [s] and drift [1].
        noise: by which each component is whitened.
    """
    first, last = (t + at[0] + at[1] * (t - middle) for t in (steps.first, steps.last))
    inside = (first > pair.time[0] + pair.step) & (last < pair.time[-1] - pair.step)
    if inside.sum() < LEAST_STEPS:
        return None
    first, last, moved = first[inside], last[inside], steps.moved[inside]
    joined = np.concatenate([[False], steps.first[inside][1:] == steps.last[inside][:-1]])
    turned = pair.turned_at(last) - pair.turned_at(first)
    begins, ends = pair.rate_at(first), pair.rate_at(last)
    since = np.stack([steps.first[inside], steps.last[inside]]) - middle
    by_drift = ends * since[1][:, None] - begins * since[0][:, None]
    left, slope, rest, found = [], [], 0.0, []
    for y, one in zip(moved.T, noise, strict=True):
        white = one.whitened(np.column_stack([y, turned, ends - begins, by_drift]), joined)
        x, *derivatives = np.split(white[:, 1:], 3, axis=1)
        b = np.linalg.lstsq(x, white[:, 0], rcond=pair.collinear)[0]
        by = np.column_stack([derivative @ b for derivative in derivatives])
        left.append(x @ b - white[:, 0])
        slope.append(by - x @ np.linalg.lstsq(x, by, rcond=pair.collinear)[0])
        residual = turned @ b - y
        rest += float((residual**2).sum())
        found.append(StepNoise.of(residual, joined))
    share = rest / max(float((moved**2).sum()), 1e-12)
    return Linearised(np.stack(left, 1), np.stack(slope, 1), share, tuple(found))
