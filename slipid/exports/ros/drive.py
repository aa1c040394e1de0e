"""The drive controller of ros2_controllers that has a robot's kinematics, if there is one.

Such controllers convert a body twist (vx, vy, yaw rate W) to wheel speeds by

    omni      r w_k = sin(t_k) vx - cos(t_k) vy - R W,   t_k = wheel_offset + 2 pi k / n
    mecanum   r w   = vx -/+ vy -/+ s W,                 s = lx + ly, about the middle of the wheels

where w_k is the speed of wheel k [rad/s], r the wheel radius [m] and R the base radius [m]. For
mecanum wheels the two signs are - - front left, + + front right, - + rear right and + - rear left;
lx and ly are half the wheelbase and half the track [m]. The n omni wheels stand evenly on a circle
and are numbered counter-clockwise from 0; a positive speed turns the robot clockwise.

Source: github.com/ros-controls/ros2_controllers, `compute_robot_velocity` of
omni_wheel_drive_controller, `update_and_write_commands` of mecanum_drive_controller.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from slipid.exports.ros.yaml_text import Parameter
from slipid.robot.deployed import DeployedRobot

MOST = 0.05
"""Largest difference of kinematics up to which a controller still fits a robot.

It is the error of a rim speed as a share of the body's speed [1], the speed being that of points on
the base radius where the body turns on the spot."""
CORNERS = ("front_left", "front_right", "rear_right", "rear_left")


@dataclass(frozen=True)
class ControllerPlugin:
    """A drive controller with the names of its parameters and topics.

    Attributes:
        name: name of the controller.
        plugin: type of the controller.
        odometry: topic of its odometry, relative to the controller's name.
        pose: parameter with the diagonal of the pose's covariance.
        twist: parameter with the diagonal of the twist's covariance.
    """

    name: str
    plugin: str
    odometry: str
    pose: str
    twist: str


OMNI = ControllerPlugin(
    "omni_wheel_drive_controller",
    "omni_wheel_drive_controller/OmniWheelDriveController",
    "odom",
    "diagonal_covariance.pose",
    "diagonal_covariance.twist",
)
MECANUM = ControllerPlugin(
    "mecanum_drive_controller",
    "mecanum_drive_controller/MecanumDriveController",
    "odometry",
    "pose_covariance_diagonal",
    "twist_covariance_diagonal",
)


@dataclass(frozen=True)
class DriveController:
    """A drive controller with its parameters set for a robot.

    Attributes:
        controller: type of the controller and its names.
        wheels: numbers of the robot's wheels in the controller's order.
        turned: for each of these, whether the controller counts its speed with the opposite sign.
        parameters: parameters of the controller.
        off: largest difference of the controller's kinematics from the robot's, see `MOST` [1].
    """

    controller: ControllerPlugin
    wheels: tuple[int, ...]
    turned: tuple[bool, ...]
    parameters: tuple[Parameter, ...]
    off: float


def drive_controller_of(robot: DeployedRobot) -> DriveController | None:
    """Return the controller for a robot; None where no controller has its kinematics."""
    controller = _mecanum(robot) or _omni(robot)
    return controller if controller is not None and controller.off <= MOST else None


def joint(wheel: int) -> str:
    """Return the name of a wheel's joint, a placeholder for the user's own."""
    return f"wheel_{wheel + 1}_joint"


@dataclass(frozen=True)
class _OrderedWheels:
    """The robot's wheels in a controller's order.

    Attributes:
        order: numbers of the robot's wheels.
        turned: whether the controller counts the speed of each wheel with the opposite sign.
        rows: rows of the robot's kinematics J with the controller's signs.
    """

    order: Int[np.ndarray, " wheel"]
    turned: tuple[bool, ...]
    rows: Float[np.ndarray, "wheel 3"]

    @classmethod
    def of(
        cls, robot: DeployedRobot, order: Int[np.ndarray, " wheel"], axis: int, sign: float
    ) -> "_OrderedWheels":
        """Return the wheels, their signs such that column `axis` of the kinematics has `sign`."""
        rows = np.asarray(robot.forward)[order]
        turned = rows[:, axis] * sign < 0
        return cls(order, tuple(turned.tolist()), np.where(turned, -1.0, 1.0)[:, None] * rows)

    def drive(
        self,
        controller: ControllerPlugin,
        robot: DeployedRobot,
        own: Float[np.ndarray, "wheel 3"],
        parameters: tuple[Parameter, ...],
    ) -> DriveController:
        """Return the controller with kinematics `own`, and its difference from the robot's."""
        scale = np.array([1.0, 1.0, 1.0 / float(robot.frame.base)])
        return DriveController(
            controller=controller,
            wheels=tuple(self.order.tolist()),
            turned=self.turned,
            parameters=parameters,
            off=float(np.abs((own - self.rows) * scale).max()),
        )


def _omni(robot: DeployedRobot) -> DriveController | None:
    """Return the controller for omni wheels evenly on a circle, beginning with the first wheel.

    It is None for fewer than three wheels.
    """
    places, count = np.asarray(robot.places), robot.wheels
    azimuth = np.arctan2(places[:, 1], places[:, 0])
    # a wheel whose azimuth is a rounding error below that of the first one counts as being at 0
    order = np.argsort(np.mod(azimuth - azimuth[0] + 1e-6, 2 * np.pi))
    wheels = _OrderedWheels.of(robot, order, axis=2, sign=-1.0)
    even = 2 * np.pi * np.arange(count) / count
    beyond = np.arctan2(wheels.rows[:, 0], -wheels.rows[:, 1]) - azimuth[0] - even
    offset = float(azimuth[0] + np.mean(np.mod(beyond + np.pi, 2 * np.pi) - np.pi))
    base, angle = float(robot.frame.base), offset + even
    own = np.stack([np.sin(angle), -np.cos(angle), np.full(count, -base)], axis=-1)
    parameters = (
        Parameter("wheel_names", tuple(joint(k) for k in order.tolist()), _JOINTS),
        Parameter("wheel_offset", offset, _OFFSET),
        Parameter("robot_radius", base, _BASE),
        Parameter("wheel_radius", float(robot.frame.radius), _RADIUS),
    )
    return wheels.drive(OMNI, robot, own, parameters) if count >= 3 else None


def _mecanum(robot: DeployedRobot) -> DriveController | None:
    """Return the controller for four mecanum wheels at the corners of a rectangle, or None."""
    places = np.asarray(robot.places)
    middle = places.mean(axis=0)
    by_corner = {(x > 0, y > 0): k for k, (x, y) in enumerate((places - middle).tolist())}
    if robot.wheels != 4 or len(by_corner) != 4:
        return None
    corners = ((True, True), (True, False), (False, False), (False, True))
    order = np.array([by_corner[corner] for corner in corners])
    wheels = _OrderedWheels.of(robot, order, axis=0, sign=1.0)
    rows = wheels.rows
    about = rows[:, 2] - (middle[0] * rows[:, 1] - middle[1] * rows[:, 0])
    turns, aside = np.array([-1.0, 1.0, 1.0, -1.0]), np.array([-1.0, 1.0, -1.0, 1.0])
    reach = float(np.mean(about * turns))
    yaw = reach * turns + middle[0] * aside - middle[1]
    own = np.stack([np.ones(4), aside, yaw], axis=-1)
    parameters = (*_joints(order), *_kinematics(robot, reach, middle))
    controller = wheels.drive(MECANUM, robot, own, parameters)
    return controller if controller.off <= MOST else None


def _joints(order: Int[np.ndarray, "4"]) -> tuple[Parameter, ...]:
    names = [
        (f"{corner}_wheel_command_joint_name", joint(int(k)))
        for corner, k in zip(CORNERS, order, strict=True)
    ]
    return tuple(Parameter(*pair, "" if n else _JOINTS) for n, pair in enumerate(names))


def _kinematics(
    robot: DeployedRobot, reach: float, middle: Float[np.ndarray, "2"]
) -> tuple[Parameter, ...]:
    x, y = (float(-m) if abs(m) > 1e-12 else 0.0 for m in middle)
    return (
        Parameter("kinematics.base_frame_offset.x", x, _MIDDLE),
        Parameter("kinematics.base_frame_offset.y", y),
        Parameter("kinematics.base_frame_offset.theta", 0.0),
        Parameter("kinematics.wheels_radius", float(robot.frame.radius), _RADIUS),
        Parameter("kinematics.sum_of_robot_center_projection_on_X_Y_axis", reach, _REACH),
    )


_JOINTS = (
    "Put in your own joint names, in this order; the number is that of the wheel in robot.json and "
    "in the logs. README.md says which joints must be reversed."
)
_OFFSET = (
    "Direction in which the first of these wheels stands, from ahead [rad]: the mean over the "
    "wheels of what their identified drive directions say."
)
_BASE = "robot.base_radius, from the middle to the wheels [m]. It has no multiplier."
_RADIUS = "robot.wheel_radius [m]. It has no multiplier: the identified value itself stands in."
_MIDDLE = "The origin of the body as seen from the middle of the wheels [m, m, rad]."
_REACH = "lx + ly [m]: the mean over the wheels of their identified levers about their middle."
