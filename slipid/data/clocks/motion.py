"""What a robot and a camera saw of one motion, each on its own clock."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from slipid.data.wheel_signals import body_steps, integral

LEVER = 0.2
"""Length at which a turn counts as a way [m]."""


@dataclass(frozen=True, eq=False)
class Steps:
    """Ends of steps on the clock of the poses [s], and the motion ahead, left [m], in yaw [rad]."""

    first: Float[np.ndarray, " step"]
    last: Float[np.ndarray, " step"]
    moved: Float[np.ndarray, "step 3"]


@dataclass(frozen=True, eq=False)
class Motion:
    """A run on the robot's clock and on that of its poses.

    Attributes:
        time, turned: of the robot [s], and angles of its wheels [rad] or what else grows with its
            motion.
        pose_time, pose: of the body [s], x, y [m], heading [rad] without wrap-around.
        step: least length of the steps that are compared [s].
        collinear: what turned less than this part of the most is not fitted by itself: on a
            straight way all wheels say the same.
        told_by: what turned: "wheels" or "gyro".
        body_std: how far the body may come behind what turned, or ahead of it [s].
    """

    time: Float[np.ndarray, " row"]
    turned: Float[np.ndarray, "row column"]
    pose_time: Float[np.ndarray, " pose"]
    pose: Float[np.ndarray, "pose 3"]
    step: float
    collinear: float
    told_by: Literal["wheels", "gyro"]
    body_std: float

    @classmethod
    def of_wheels(
        cls,
        time: Float[np.ndarray, " row"],
        angle: Float[np.ndarray, "row wheel"],
        pose_time: Float[np.ndarray, " pose"],
        pose: Float[np.ndarray, "pose 3"],
    ) -> "Motion":
        """By the wheels. Steps are longer than it takes a roller to pass under a wheel.

        While a robot accelerates its wheels slip more, and a soft floor gives way: nothing tells
        that from a body that comes late, by some 10 ms where the floor is firm and more on carpets.
        """
        return cls(
            time, angle, pose_time, pose, step=0.1, collinear=0.1, told_by="wheels", body_std=0.015
        )

    @classmethod
    def of_gyro(
        cls,
        time: Float[np.ndarray, " row"],
        gyro: Float[np.ndarray, " row"],
        pose_time: Float[np.ndarray, " pose"],
        pose: Float[np.ndarray, "pose 3"],
    ) -> "Motion":
        """By a gyro [rad/s] with a scale and a bias of its own, from the heading alone."""
        turned = np.column_stack([integral(time, gyro[:, None]), time])
        heading = pose * np.array([0.0, 0.0, 1.0])
        return cls(
            time, turned, pose_time, heading, step=0.02, collinear=0.0, told_by="gyro", body_std=0.0
        )

    def steps(self, least: float) -> Steps:
        """The body's motion over steps of at least some length [s], none of them without poses."""
        t = self.pose_time
        usual = max(float(np.median(np.diff(t))), 1e-6)
        edges = np.arange(0, len(t), max(1, int(np.ceil(least / usual - 1e-6))))
        first, last = t[edges[:-1]], t[edges[1:]]
        whole = last - first < 2.0 * max(float(np.median(last - first)), least)
        return Steps(first[whole], last[whole], body_steps(self.pose[edges])[whole])

    @staticmethod
    def scaled(moved: Float[np.ndarray, "step 3"]) -> Float[np.ndarray, "step 3"]:
        """Motion in units of its root mean square, turns as ways of a lever."""
        ways = moved * np.array([1.0, 1.0, LEVER])
        return np.asarray(ways / max(float(np.sqrt((ways**2).mean())), 1e-12))

    def turned_at(self, at: Float[np.ndarray, " at"]) -> Float[np.ndarray, "at column"]:
        """What had turned at times of the robot's clock; beyond its record nothing moved."""
        return np.asarray(self._spline(np.clip(at, self.time[0], self.time[-1])))

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.time, self.turned)

    def rate_at(self, at: Float[np.ndarray, " at"]) -> Float[np.ndarray, "at column"]:
        """How fast it turned then, over a step."""
        half = 0.5 * self.step
        return (self.turned_at(at + half) - self.turned_at(at - half)) / self.step
