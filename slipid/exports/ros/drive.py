"""Drive controller of ros2_controllers whose kinematics are those of a robot, if there is one.

The drive controllers convert a body twist (vx, vy, yaw rate W) to wheel speeds by

    omni      r w_k = sin(t_k) vx - cos(t_k) vy - R W,   t_k = wheel_offset + 2 pi k / n
    mecanum   r w   = vx -/+ vy -/+ s W,                 s = lx + ly

where w_k is the speed of wheel k [rad/s], t_k its direction from the middle [rad], r the wheel
radius [m] and R the base radius [m]. The n omni wheels are evenly spaced on a circle and numbered
counter-clockwise from 0; a positive speed turns the robot clockwise. For mecanum wheels the twist
is that of the middle of the wheels; the two signs are - - front left, + + front right, - + rear
right and + - rear left; lx and ly are half the wheelbase and half the track [m].

Source: github.com/ros-controls/ros2_controllers, `compute_robot_velocity` of
omni_wheel_drive_controller, `update_and_write_commands` of mecanum_drive_controller.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from slipid.exports.ros.yaml_text import Parameter
from slipid.robot.deployed import DeployedRobot

LARGEST_DIFFERENCE = 0.05
"""Largest difference of kinematics with which a controller is still used for a robot.

The difference is the largest error of a rim speed, as a fraction of the body's speed [1]; while the
body turns on the spot, its speed is the speed of points on the base radius."""
CORNERS = ("front_left", "front_right", "rear_right", "rear_left")
"""Names of the four wheels in the parameters of mecanum_drive_controller, in its order."""


@dataclass(frozen=True)
class DriveController:
    """A drive controller with its parameters set for a robot.

    Attributes:
        name: name of the controller.
        odometry: topic of the controller's odometry, relative to the controller's name.
        covariances: names of the parameters for the diagonals of the covariances of pose and twist.
        wheels: indices of the robot's wheels in the controller's order.
        turned: for each of `wheels`, True if its speed has the opposite sign in the controller.
        parameters: parameters of the controller.
        difference: largest difference of the controller's kinematics from the robot's, as in
            `LARGEST_DIFFERENCE` [1].
    """

    name: str
    odometry: str
    covariances: tuple[str, str]
    wheels: tuple[int, ...]
    turned: tuple[bool, ...]
    parameters: tuple[Parameter, ...]
    difference: float

    @property
    def plugin(self) -> str:
        """Type of the controller for the controller manager."""
        return f"{self.name}/{self.name.title().replace('_', '')}"


def drive_controller_of(robot: DeployedRobot) -> DriveController | None:
    """Return the controller for a robot; None if no controller has the robot's kinematics."""
    found = (_mecanum(robot), _omni(robot))
    fitting = (c for c in found if c is not None and c.difference <= LARGEST_DIFFERENCE)
    return next(fitting, None)


def joint(wheel: int) -> str:
    """Return a placeholder for the name of a wheel's joint."""
    return f"wheel_{wheel + 1}_joint"


def _with_signs(
    robot: DeployedRobot, order: Int[np.ndarray, " wheel"], axis: int, sign: float
) -> tuple[Float[np.ndarray, "wheel 3"], tuple[bool, ...]]:
    """Return the rows of the robot's kinematics J in a controller's order and sign convention.

    Rows are negated where needed so that column `axis` has the sign `sign`; the second result is
    True for each negated row.
    """
    rows = np.asarray(robot.forward)[order]
    turned = rows[:, axis] * sign < 0
    return np.where(turned, -1.0, 1.0)[:, None] * rows, tuple(turned.tolist())


def _difference(robot: DeployedRobot, kinematics: Float[np.ndarray, "wheel 3"]) -> float:
    """Return the largest error, as in `LARGEST_DIFFERENCE`, for a difference of matrices J [1]."""
    scale = np.array([1.0, 1.0, 1.0 / float(robot.frame.base)])
    return float(np.abs(kinematics * scale).max())


def _omni(robot: DeployedRobot) -> DriveController | None:
    """Return the controller for omni wheels evenly spaced on a circle, beginning at wheel 0.

    The result is None for fewer than three wheels. For other arrangements of wheels the result has
    a large `difference`.
    """
    places, count = np.asarray(robot.places), robot.wheels
    if count < 3:
        return None
    azimuth = np.arctan2(places[:, 1], places[:, 0])
    # add 1e-6, so that an azimuth a rounding error below the first wheel's does not wrap to 2 pi
    order = np.argsort(np.mod(azimuth - azimuth[0] + 1e-6, 2 * np.pi))
    rows, turned = _with_signs(robot, order, axis=2, sign=-1.0)
    even = 2 * np.pi * np.arange(count) / count
    beyond = np.arctan2(rows[:, 0], -rows[:, 1]) - azimuth[0] - even
    offset = float(azimuth[0] + np.mean(np.mod(beyond + np.pi, 2 * np.pi) - np.pi))
    base, angle = float(robot.frame.base), offset + even
    own = np.stack([np.sin(angle), -np.cos(angle), np.full(count, -base)], axis=-1)
    return DriveController(
        name="omni_wheel_drive_controller",
        odometry="odom",
        covariances=("diagonal_covariance.pose", "diagonal_covariance.twist"),
        wheels=tuple(order.tolist()),
        turned=turned,
        parameters=(
            Parameter("wheel_names", tuple(map(joint, order.tolist())), _JOINTS),
            Parameter("wheel_offset", offset, _OFFSET),
            Parameter("robot_radius", base, _BASE),
            Parameter("wheel_radius", float(robot.frame.radius), _RADIUS),
        ),
        difference=_difference(robot, own - rows),
    )


def _mecanum(robot: DeployedRobot) -> DriveController | None:
    """Return the controller for four mecanum wheels at the corners of a rectangle, or None."""
    places = np.asarray(robot.places)
    middle = places.mean(axis=0)
    by_corner = {(x > 0, y > 0): k for k, (x, y) in enumerate((places - middle).tolist())}
    if robot.wheels != 4 or len(by_corner) != 4:
        return None
    corners = ((True, True), (True, False), (False, False), (False, True))
    order = np.array([by_corner[corner] for corner in corners])
    rows, turned = _with_signs(robot, order, axis=0, sign=1.0)
    about = rows[:, 2] - (middle[0] * rows[:, 1] - middle[1] * rows[:, 0])
    turns, aside = np.array([-1.0, 1.0, 1.0, -1.0]), np.array([-1.0, 1.0, -1.0, 1.0])
    reach = float(np.mean(about * turns))
    own = np.stack([np.ones(4), aside, reach * turns + middle[0] * aside - middle[1]], axis=-1)
    x, y = (float(-m) if abs(m) > 1e-12 else 0.0 for m in middle)
    joints = [
        Parameter(f"{corner}_wheel_command_joint_name", joint(int(k)), "" if n else _JOINTS)
        for n, (corner, k) in enumerate(zip(CORNERS, order, strict=True))
    ]
    return DriveController(
        name="mecanum_drive_controller",
        odometry="odometry",
        covariances=("pose_covariance_diagonal", "twist_covariance_diagonal"),
        wheels=tuple(order.tolist()),
        turned=turned,
        parameters=(
            *joints,
            Parameter("kinematics.base_frame_offset.x", x, _MIDDLE),
            Parameter("kinematics.base_frame_offset.y", y),
            Parameter("kinematics.base_frame_offset.theta", 0.0),
            Parameter("kinematics.wheels_radius", float(robot.frame.radius), _RADIUS),
            Parameter("kinematics.sum_of_robot_center_projection_on_X_Y_axis", reach, _REACH),
        ),
        difference=_difference(robot, own - rows),
    )


_JOINTS = (
    "Replace these names by the names of your joints, in this order; the number in a name is the "
    "wheel's number in robot.json and in the logs. README.md lists the joints to reverse."
)
_OFFSET = (
    "Direction from the middle to the first of these wheels, from straight ahead [rad]: a mean "
    "over the wheels, computed from their identified drive directions."
)
_BASE = (
    "robot.base_radius, distance from the middle to the wheels [m], as identified. The controller "
    "has no multiplier for it."
)
_RADIUS = "robot.wheel_radius [m], as identified. The controller has no multiplier for it."
_MIDDLE = "Pose of the body's origin relative to the middle of the wheels [m, m, rad]."
_REACH = "lx + ly [m]: mean lever arm of the wheels about their middle, as identified."
