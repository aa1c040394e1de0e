"""Regression of pose increments on the rotation of wheels or gyro, as a function of a time offset.

    moved_k = B (turned(last_k + offset) - turned(first_k + offset)) + e_k

where moved_k is the pose increment over step k, from first_k to last_k [s], turned are the angles
of the wheels or of the gyro, B is the fitted matrix and e_k the noise. Sizes, signs and order of
the wheels need not be known, since B absorbs them. Positions without headings show only the length
of their steps, whose square is a quadratic form of the turns of the wheels:

    |moved_k|^2 = sum_ij B_ij turned_i turned_j + b + e_k

with turned_i short for the difference above, and b for the noise of positions. The speed must
change during the motion, because steady motion looks the same at any offset. A search compares
offsets by the unexplained fraction of the motion; near the best offset, `linearised` gives the
derivatives with respect to offset and drift under a noise model, in which e is the sum of pose
noise, which successive steps share, and of slip, which is independent in each step.
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
    """Increments of the pose over time steps.

    Attributes:
        first, last: begin and end of each step on the clock of the poses [s].
        moved: increments in the `components` that the `MotionPair` compares, out of ahead [m], left
            [m] and heading [rad].
    """

    first: Float[np.ndarray, " step"]
    last: Float[np.ndarray, " step"]
    moved: Float[np.ndarray, "step component"]


@dataclass(frozen=True, eq=False)
class MotionPair:
    """Motion of a run, measured by the robot's own sensors and by its poses.

    Attributes:
        time: times of the robot's samples [s].
        turned: angles of the wheels [rad], or other integrals that grow with the motion.
        pose_time: times of the poses on their own clock [s].
        pose: x, y [m], heading [rad] without wrap-around; nan in coordinates without a sensor.
        source: sensor that measured `turned`.
        step: shortest duration of the compared pose increments [s].
        collinear: relative threshold below which singular values of the turns are dropped [1]; on a
            straight path the turns of all wheels are proportional, so that some are near zero.
        body_std: std of the delay between the body and `turned` [s].
        components: indices of the compared components: 0 ahead, 1 left, 2 heading; of positions
            without headings, the squares of the lengths of their steps are compared instead.
        goes_on: True to extrapolate the motion beyond the ends of the record at the rates there;
            False to assume standstill there.
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
        """Return the motion pair of wheels and poses.

        Steps are longer than the time in which a roller passes under an omni wheel. While a robot
        accelerates, its wheels slip more and a soft floor gives way. The data cannot distinguish
        this from a delay of the body: some 10 ms on firm floors, more on carpets. Therefore
        `body_std` is 15 ms.
        """
        components = (2,) if np.isnan(pose[:, 0]).all() else (0, 1, 2)
        robot = time, angle, pose_time, pose
        return cls(*robot, "wheels", step=0.1, collinear=0.1, body_std=0.015, components=components)

    @classmethod
    def of_gyro(
        cls,
        time: Float[np.ndarray, " row"],
        gyro: Float[np.ndarray, " row"],
        pose_time: Float[np.ndarray, " pose"],
        pose: Float[np.ndarray, "pose 3"],
    ) -> "MotionPair":
        """Return the motion pair of headings and a gyro [rad/s].

        Scale and bias of the gyro are fitted, so time, the integral of a constant bias, is the
        second column of `turned`.
        """
        turned = np.column_stack([integral(time, gyro[:, None]), time])
        return cls(time, turned, pose_time, pose, "gyro", step=0.02, collinear=0.0, components=(2,))

    def increments(self, least: float) -> PoseIncrements:
        """Return the pose increments over steps of at least `least` [s].

        Steps across a gap in the poses are left out.
        """
        t = self.pose_time
        usual = max(float(np.median(np.diff(t))), 1e-6)
        stride = max(1, int(np.ceil(least / usual - 1e-6)))
        edges = np.arange(0, len(t), stride)
        first, last = t[edges[:-1]], t[edges[1:]]
        whole = last - first < 2.0 * max(stride * usual, least)
        if self.unheaded:
            moved = (np.diff(self.pose[edges, :2], axis=0) ** 2).sum(axis=1, keepdims=True)
        else:
            moved = body_steps(self.pose[edges])[:, list(self.components)]
        return PoseIncrements(first[whole], last[whole], moved[whole])

    @cached_property
    def unheaded(self) -> bool:
        """True if positions are compared whose headings are unknown."""
        return self.components != (2,) and bool(np.isnan(self.pose[:, 2]).all())

    def regressors(
        self, turned: Float[np.ndarray, "step column"], change: Float[np.ndarray, "step column"]
    ) -> tuple[Float[np.ndarray, "step regressor"], Float[np.ndarray, "step regressor"]]:
        """Return what B multiplies at differences of `turned`, and the change of it at `change`."""
        if not self.unheaded:
            return turned, change
        i, j = np.triu_indices(turned.shape[1])
        one = np.ones((len(turned), 1))
        products = turned[:, i] * turned[:, j]
        slope = turned[:, i] * change[:, j] + change[:, i] * turned[:, j]
        return np.hstack([products, one]), np.hstack([slope, 0 * one])

    def turned_at(self, at: Float[np.ndarray, "*at"]) -> Float[np.ndarray, "*at column"]:
        """Return `turned` interpolated at times on the robot's clock [s]."""
        inside = np.clip(at, self.time[0], self.time[-1])
        turned = np.asarray(self._spline(inside))
        if self.goes_on:
            beyond = (at - inside)[..., None]
            turned = turned + beyond * np.where(beyond < 0, *self._end_rates)
        return turned

    def rate_at(self, at: Float[np.ndarray, " at"]) -> Float[np.ndarray, "at column"]:
        """Return the mean rate of `turned` over one step centred at each time [s]."""
        half = 0.5 * self.step
        return (self.turned_at(at + half) - self.turned_at(at - half)) / self.step

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.time, self.turned)

    @cached_property
    def _end_rates(self) -> Float[np.ndarray, "2 column"]:
        """Return the mean rates of `turned` in the first and in the last step of the record."""
        ends = self.time[[0, -1]]
        within = np.clip(ends + self.step * np.array([1.0, -1.0]), *ends)
        return np.asarray((self._spline(within) - self._spline(ends)) / (within - ends)[:, None])


_MOST_AT_ONCE = 50_000
"""Largest number of interpolated times in all pairs at once."""
LEAST_STEPS = 20
"""Least number of steps for a fit of offset and drift."""
LEAST_PER_COLUMN = 3
"""Least number of steps per column of `turned` for the regression at a searched offset."""
DISTANT_S, CLEAR_MARGIN = 0.5, 0.02
"""The best offset is clear if the unexplained fraction of the motion at every offset further than
`DISTANT_S` [s] from it is larger by at least `CLEAR_MARGIN` [1]; steady or periodic motion has no
clear best offset."""


def unexplained(
    pairs: Sequence[MotionPair], offsets: Float[np.ndarray, " offset"], step: float
) -> Float[np.ndarray, " offset"]:
    """Return the fraction of the motion that the regression leaves unexplained at each offset.

    One matrix B is fitted to all pairs. The result is the geometric mean of the components'
    unexplained fractions, which ranks offsets as the profile likelihood does if each component has
    a separate noise variance. Therefore units do not matter, and a component that cannot be
    explained, such as the sideways motion of a robot with two wheels, does not hide the other
    components.

    Args:
        pairs: motion pairs.
        offsets: offsets to compare [s].
        step: shortest duration of the pose increments [s].
    """
    steps = [pair.increments(step) for pair in pairs]
    moved = np.concatenate([one.moved for one in steps])
    whole = (moved**2).sum(axis=0)
    moves = whole > 0

    def share(turned: Float[np.ndarray, "step column"]) -> float:
        turned, _ = pairs[0].regressors(turned, turned)
        if len(turned) < LEAST_PER_COLUMN * turned.shape[1]:
            return 1.0
        rest = moved - turned @ np.linalg.lstsq(turned, moved, rcond=pairs[0].collinear)[0]
        shares = np.where(moves, (rest**2).sum(axis=0) / np.where(moves, whole, 1.0), 1.0)
        return float(np.exp(np.log(shares.clip(1e-12)).mean()))

    # The turns are interpolated at several offsets at once, in blocks that need little memory.
    size = max(1, _MOST_AT_ONCE // max(len(moved), 1))
    out = []
    for block in (offsets[k : k + size, None] for k in range(0, len(offsets), size)):
        turned = [
            pair.turned_at(one.last + block) - pair.turned_at(one.first + block)
            for pair, one in zip(pairs, steps, strict=True)
        ]
        out += [share(one) for one in np.concatenate(turned, axis=1)]
    return np.array(out)


def clear_best(
    offsets: Float[np.ndarray, " offset"], rest: Float[np.ndarray, " offset"]
) -> int | None:
    """Return the index of the best offset, or None if a distant offset is nearly as good.

    `rest` is the unexplained fraction of the motion at each offset [1].
    """
    best = int(np.argmin(rest))
    others = rest[np.abs(offsets - offsets[best]) > DISTANT_S]
    return best if others.min(initial=np.inf) > rest[best] + CLEAR_MARGIN else None


@dataclass(frozen=True, eq=False)
class StepNoise:
    """Noise of the pose increments in one component.

    Attributes:
        shared: variance of a single pose, whose error two successive increments share.
        separate: variance of the errors that are independent in each increment, such as slip.
    """

    shared: float
    separate: float

    @classmethod
    def of(cls, rest: Float[np.ndarray, " step"], joined: Bool[np.ndarray, " step"]) -> "StepNoise":
        """Return the noise estimated from residuals.

        `joined` is True for a step that begins where the previous one ended.
        """
        whole = max(float((rest**2).mean()), 1e-12)
        neighbours = (rest[1:] * rest[:-1])[joined[1:]]
        shared = float(np.clip(-neighbours.mean(), 0.0, 0.499 * whole)) if len(neighbours) else 0.0
        return cls(shared, whole - 2.0 * shared)

    def whitened(
        self, rows: Float[np.ndarray, "step column"], joined: Bool[np.ndarray, " step"]
    ) -> Float[np.ndarray, "step column"]:
        """Return `rows` multiplied on the left by the inverse Cholesky factor of the covariance.

        The noise covariance is 2 shared + separate on the diagonal, and -shared between a step and
        the previous one if `joined` is True, that is, if it begins where the previous one ended.
        """
        beside = np.where(joined[1:], -self.shared, 0.0)
        band = np.stack(
            [np.full(len(rows), 2.0 * self.shared + self.separate), np.append(beside, 0.0)]
        )
        return np.asarray(solve_banded((1, 0), cholesky_banded(band, lower=True), rows))


@dataclass(frozen=True, eq=False)
class Linearised:
    """The whitened regression, linearised at an offset and a drift.

    Attributes:
        residual: weighted residuals.
        slope: derivatives of the residuals with respect to offset and drift, with B profiled out.
        share: unexplained fraction of the motion [1].
        noise: noise of each component, estimated from the residuals.
    """

    residual: Float[np.ndarray, "step component"]
    slope: Float[np.ndarray, "step component 2"]
    share: float
    noise: tuple[StepNoise, ...]

    @property
    def squares(self) -> float:
        """Return the sum of the squared weighted residuals."""
        return float((self.residual**2).sum())


def linearised(
    pair: MotionPair,
    steps: PoseIncrements,
    at: Float[np.ndarray, "2"],
    middle: float,
    noise: Sequence[StepNoise],
) -> Linearised | None:
    """Return the regression linearised at an offset and a drift.

    The result is None if fewer than `LEAST_STEPS` steps lie in the robot's record.

    Args:
        pair: motion pair.
        steps: pose increments of the pair.
        at: offset at `middle` [s] and drift [1].
        middle: time on the poses' clock at which the offset holds [s].
        noise: noise model of each component, by which the regression is whitened.
    """
    first, last = (t + at[0] + at[1] * (t - middle) for t in (steps.first, steps.last))
    inside = (first > pair.time[0] + pair.step) & (last < pair.time[-1] - pair.step)
    if inside.sum() < LEAST_STEPS:
        return None
    first, last, moved = first[inside], last[inside], steps.moved[inside]
    joined = np.concatenate([[False], steps.first[inside][1:] == steps.last[inside][:-1]])
    differences = pair.turned_at(last) - pair.turned_at(first)
    begins, ends = pair.rate_at(first), pair.rate_at(last)
    since = np.stack([steps.first[inside], steps.last[inside]]) - middle
    by_drift = ends * since[1][:, None] - begins * since[0][:, None]
    residuals, slopes, squares, found = [], [], 0.0, []
    turned, by_offset = pair.regressors(differences, ends - begins)
    _, by_drift = pair.regressors(differences, by_drift)
    for y, one in zip(moved.T, noise, strict=True):
        white = one.whitened(np.column_stack([y, turned, by_offset, by_drift]), joined)
        x, *derivatives = np.split(white[:, 1:], 3, axis=1)
        b = np.linalg.lstsq(x, white[:, 0], rcond=pair.collinear)[0]
        by = np.column_stack([derivative @ b for derivative in derivatives])
        residuals.append(x @ b - white[:, 0])
        slopes.append(by - x @ np.linalg.lstsq(x, by, rcond=pair.collinear)[0])
        residual = turned @ b - y
        squares += float((residual**2).sum())
        found.append(StepNoise.of(residual, joined))
    share = squares / max(float((moved**2).sum()), 1e-12)
    return Linearised(np.stack(residuals, 1), np.stack(slopes, 1), share, tuple(found))
