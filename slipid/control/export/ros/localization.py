"""Parameters of robot_localization's extended Kalman filter for the odometry of a robot.

Its state is x, y, z, roll, pitch, yaw, their rates in the body frame, and accelerations ahead,
sideways and up; it adds process noise times the time that has passed.

Source: github.com/cra-ros-pkg/robot_localization, params/ekf.yaml, `Ekf::predict`.
"""

import numpy as np
from jaxtyping import Float

from slipid.control.controller import Limits
from slipid.control.deployed import DeployedRobot
from slipid.control.export.ros.noise import DISTANCE_M, PERIOD_S, Errs, top_speed
from slipid.control.export.ros.yaml_text import Parameter
from slipid.control.export.text import short

NODE = "ekf_filter_node"
_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
STATE = (*_POSE, *(f"v{name}" for name in _POSE), "ax", "ay", "az")
FUSED = ("vx", "vy", "vyaw")
"""What the filter takes from odometry: its pose is the sum of the same velocities."""
HELD = 1e-6
"""Process noise of what `two_d_mode` holds at zero."""
ACCELERATION = 0.01
"""Process noise of accelerations, which nothing here measures: the package's own default."""


def filter_parameters(
    robot: DeployedRobot, errs: Errs, odometry: str, whose: str
) -> tuple[Parameter, ...]:
    """All parameters, for odometry on a topic that is of `whose` kind and errs like this."""
    about = (
        f"Odometry of {whose}. Velocities only are fused: its pose is their sum, and would count "
        "twice. Order: " + ", ".join(STATE) + "."
    )
    return (
        Parameter("frequency", 1 / PERIOD_S, "As often as odometry is taken to come [Hz]."),
        Parameter("two_d_mode", True, "The robot stays on a plane."),
        Parameter("publish_tf", True, _TF),
        Parameter("odom_frame", "odom"),
        Parameter("base_link_frame", "base_link"),
        Parameter("world_frame", "odom"),
        Parameter("odom0", odometry, about),
        Parameter("odom0_config", tuple(name in FUSED for name in STATE), per_line=3),
        Parameter("odom0_differential", False),
        Parameter("odom0_relative", False),
        Parameter("dynamic_process_noise_covariance", False, _DYNAMIC),
        process_noise(robot, errs),
    )


def process_noise(robot: DeployedRobot, errs: Errs) -> Parameter:
    """Process noise on a floor, 15 x 15 as rows."""
    matrix, most = np.diag(_diagonal(robot, errs)), float(Limits().acceleration)
    about = (
        f"On '{errs.floor}'. Pose: what stays the same all the way and so is no noise of single "
        f"velocities, as a random walk that is as far off after {short(DISTANCE_M)} m, at the "
        f"highest speed seen by the fit, {short(top_speed(robot))} m/s. Velocity: the change that "
        f"the limit of wheel acceleration, {short(most)} rad/s^2, allows within "
        f"{short(PERIOD_S)} s. Accelerations: the package's default. two_d_mode holds the rest."
    )
    entries = tuple(float(x) for x in matrix.reshape(-1))
    return Parameter("process_noise_covariance", entries, about, per_line=len(STATE))


def _diagonal(robot: DeployedRobot, errs: Errs) -> Float[np.ndarray, " state"]:
    """Per second: pose as `Errs.walk`, velocities as (a T)^2 per period T."""
    pose = errs.walk(top_speed(robot), DISTANCE_M)
    change = float(Limits().acceleration) * float(robot.frame.radius)
    speed, turn = change**2 * PERIOD_S, (change / float(robot.frame.base)) ** 2 * PERIOD_S
    known = dict(zip(("x", "y", "yaw"), pose, strict=True))
    known |= {"vx": speed, "vy": speed, "vyaw": turn, "ax": ACCELERATION, "ay": ACCELERATION}
    return np.array([known.get(name, HELD) for name in STATE])


_TF = (
    "Only one node may publish this transform: set enable_odom_tf of the drive controller to false."
)
_DYNAMIC = (
    "False: the pose grows uncertain while the robot stands, too. True would scale it with the "
    "square of the speed, which forgets slow ways."
)
