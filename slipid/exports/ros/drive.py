"""Drive controller of ros2_controllers whose kinematics are those of a robot, if there is one.

The drive controllers convert a body twist (vx, vy, yaw rate W) to wheel speeds by

    omni      r w_k = sin(t_k) vx - cos(t_k) vy - R W,   t_k = wheel_offset + 2 pi k / n
    mecanum   r w   = vx -/+ vy -/+ s W,                 s = lx + ly
    diff      m r w = vx -/+ b B W / 2,                  - left, + right, with their own m

where w_k is the speed of wheel k [rad/s], t_k its direction from the middle [rad], r the wheel
radius [m] and R the base radius [m]. The n omni wheels are evenly spaced on a circle and numbered
counter-clockwise from 0; a positive speed turns the robot clockwise. For mecanum wheels the twist
is that of the middle of the wheels; the two signs are - - front left, + + front right, - + rear
right and + - rear left; lx and ly are half the wheelbase and half the track [m].

Source: github.com/ros-controls/ros2_controllers, `compute_robot_velocity` of
omni_wheel_drive_controller, `update_and_write_commands` of mecanum_drive_controller and
diff_drive_controller.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from slipid.exports.ros.yaml_text import Parameter
from slipid.robot.deployed import DeployedRobot
from slipid.robot.limits import Limits

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
        parameters: parameters of the controller that hold on every floor.
        by_floor: parameters of the controller that are of one floor.
        wheel_speeds: matrix (drive, 3) from a body twist to the robot's wheel speeds under this
            controller [rad/m, rad/m, 1].
        difference: largest difference of the controller's kinematics from the robot's, as in
            `LARGEST_DIFFERENCE` [1].
    """

    name: str
    odometry: str
    covariances: tuple[str, str]
    wheels: tuple[int, ...]
    turned: tuple[bool, ...]
    parameters: tuple[Parameter, ...]
    by_floor: tuple[Parameter, ...]
    wheel_speeds: Float[np.ndarray, "drive 3"]
    difference: float

    @property
    def plugin(self) -> str:
        """Type of the controller for the controller manager."""
        return f"{self.name}/{self.name.title().replace('_', '')}"


def drive_controllers(robot: DeployedRobot) -> tuple[DriveController, ...]:
    """Return the controller for a robot on each floor; empty if none has the robot's kinematics."""
    by_floor = []
    for floor in range(len(robot.labels)):
        found = (_mecanum(robot), _omni(robot)) if robot.holonomic else (_diff(robot, floor),)
        fitting = [c for c in found if c is not None and c.difference <= LARGEST_DIFFERENCE]
        by_floor += fitting[:1]
    return tuple(by_floor) if len(by_floor) == len(robot.labels) else ()


def rolling(robot: DeployedRobot) -> Float[np.ndarray, "drive 3"]:
    """Return the matrix from a body twist to wheel speeds without slip [rad/m, rad/m, 1]."""
    return np.asarray(robot.forward) / float(robot.frame.radius)


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
    rows = np.asarray(robot.at_wheels(robot.forward.T)).T[order]
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
        by_floor=(),
        wheel_speeds=rolling(robot),
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
        by_floor=(),
        wheel_speeds=rolling(robot),
        difference=_difference(robot, own - rows),
    )


def _diff(robot: DeployedRobot, floor: int) -> DriveController | None:
    """Return the controller for wheels that point ahead, as many on the left as on the right.

    The result is None for another arrangement of wheels.
    """
    speeds = np.asarray(robot.inverse_kinematics)[floor]
    x, y = np.asarray(robot.places).T
    of = np.asarray(robot.drive_of or range(robot.wheels))
    # front wheels first
    sides = [[int(k) for k in np.argsort(-x, kind="stable") if s * y[k] > 0] for s in (1, -1)]
    drives = [sorted(set(of[side].tolist())) for side in sides]
    if not len(sides[0]) == len(sides[1]) == robot.wheels / 2 or set(drives[0]) & set(drives[1]):
        return None
    signs = np.where(speeds[:, 0] < 0, -1.0, 1.0)
    ahead = signs[:, None] * speeds
    # the controller has one radius for each side, and one separation
    left, right = (1 / float(ahead[rows, 0].mean()) for rows in drives)
    levers = [
        s * r * ahead[rows, 2].mean()
        for s, r, rows in zip((-1, 1), (left, right), drives, strict=True)
    ]
    apart, radius = float(sum(levers)), float(robot.frame.radius)
    nominal = float(y[sides[0]].mean() - y[sides[1]].mean())
    own = np.zeros_like(speeds)
    for sign, r, rows in ((-1, left, drives[0]), (1, right, drives[1])):
        own[rows] = np.array([1.0, 0.0, sign * apart / 2]) / r
    limits = Limits.of(robot)
    wheels = tuple(sides[0] + sides[1])
    names = [tuple(map(joint, side)) for side in sides]
    change = float(limits.acceleration)
    return DriveController(
        name="diff_drive_controller",
        odometry="odom",
        covariances=("pose_covariance_diagonal", "twist_covariance_diagonal"),
        wheels=wheels,
        turned=tuple(bool(signs[of[k]] < 0) for k in wheels),
        parameters=(
            Parameter("left_wheel_names", names[0], f"{_JOINTS} {_SEVERAL}"),
            Parameter("right_wheel_names", names[1]),
            Parameter("wheel_separation", nominal, _SEPARATION),
            Parameter("wheel_radius", radius, "robot.wheel_radius [m]."),
            *_limits("linear.x", float(limits.speed), change, _LIMITS),
            *_limits("angular.z", float(limits.yaw_rate), change / (nominal / 2), ""),
        ),
        by_floor=(
            Parameter("wheel_separation_multiplier", apart / nominal, _floor_of(robot, floor)),
            Parameter("left_wheel_radius_multiplier", left / radius),
            Parameter("right_wheel_radius_multiplier", right / radius),
        ),
        wheel_speeds=signs[:, None] * own,
        difference=_difference(robot, radius * (own - ahead)),
    )


def _limits(axis: str, speed: float, change: float, about: str) -> tuple[Parameter, ...]:
    """Return the limits of speed [m/s, rad/s] and its change [m/s^2, rad/s^2] along an axis."""
    return (
        Parameter(f"{axis}.max_velocity", speed, about),
        Parameter(f"{axis}.min_velocity", -speed),
        Parameter(f"{axis}.max_acceleration", change),
        Parameter(f"{axis}.max_deceleration", -change),
    )


def _floor_of(robot: DeployedRobot, floor: int) -> str:
    """Return the description of the multipliers on a floor."""
    source = (
        "the calibrated kinematics"
        if robot.calibrated[floor]
        else "the force balance, linearised over straight runs, turns and both together"
    )
    return (
        f"On '{robot.labels[floor]}': from {source}. Apparent values, which include the mean slip "
        "on this floor."
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
_SEVERAL = (
    "A motor that turns several wheels may have a single joint instead: then enter one name on "
    "each side."
)
_SEPARATION = (
    "Distance from the left to the right wheels [m], by robot.base_radius. The multipliers below "
    "belong to it and to wheel_radius: copy all of them, not the multipliers alone."
)
_LIMITS = (
    "Limits of the robot: m/s, m/s^2, rad/s, rad/s^2. The largest change of the yaw rate is the "
    "largest acceleration of a rim, over half the wheel separation. Releases of ros2_controllers "
    "before 4.18 apply limits only where linear.x.has_velocity_limits, "
    "linear.x.has_acceleration_limits and those of angular.z are true."
)
