"""One motion, measured twice: by a robot's wheels or gyro, and as poses with times of their own."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

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
