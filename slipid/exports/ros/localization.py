"""Errors of odometry on each floor as variances for ROS messages, and filter parameters.

Over a path length d [m] an error has a constant part (std e of the effect [m/m, rad/m]) and a
random part (std q of the process noise [m/sqrt(m), rad/sqrt(m)]), so that its variance is
(e d)^2 + q^2 d. For odometry that ignores slip, the slip of the wheels is an error as well: e^2 is
then effect^2 + slip^2, where slip is the root mean square difference, over the motions that the
robot can make, of the motion that a drive controller computes from the wheels and that of the
robot's model. A constant covariance cannot depend on the direction of travel, so x and y both get
the larger of the variances along and across; only the velocity of a robot that cannot drive
sideways always has the same direction in its own frame. Such a robot slips sideways as it turns
about a centre of rotation ahead of or behind its origin: turning back undoes this shift of the
origin, so that it counts in the velocity but not in the pose. A wrong heading moves the robot
sideways; with the values e_w and q_w of e and q in yaw, this adds the variance
(e_w d^2 / 2)^2 + q_w^2 d^3 / 3 across.

ROS drive controllers put one constant diagonal into every message, although the true covariance of
odometry grows with the path. Here the diagonal of the pose is computed for the path length
`DISTANCE_M`, and the diagonal of the twist for the highest speed of the fitted runs.

The filter is robot_localization's extended Kalman filter for the odometry of a robot. Its state is
x, y, z, roll, pitch, yaw, their rates in the body frame, and accelerations ahead, sideways and up;
in every prediction it adds process noise times the elapsed time to the covariance.

Source: github.com/cra-ros-pkg/robot_localization, params/ekf.yaml, `Ekf::predict`.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.exports.ros.yaml_text import Parameter
from slipid.exports.text import short
from slipid.model import contact
from slipid.model.contact_law import ContactSurface
from slipid.robot.deployed import DeployedRobot, RobotArrays
from slipid.robot.limits import Limits
from slipid.robot.record import Axes, axes_of

DISTANCE_M = 1.0
"""Path length since the last correction of the pose for which its variances are computed [m]."""
PERIOD_S = 0.02
"""Time between two odometry messages for which the variances of twists are computed [s]."""
UNKNOWN = 1e6
"""Variance of height [m^2], roll and pitch [rad^2], which wheels do not measure."""
DIRECTIONS = 24
"""Number of directions of travel over which the squared slip is averaged."""


@dataclass(frozen=True)
class OdometryErrors:
    """Errors of odometry on a floor: along and across the direction of travel, and in yaw.

    Attributes:
        floor: name of the floor.
        process: std of random errors [m/sqrt(m)], [m/sqrt(m)], [rad/sqrt(m)].
        effect: std of the contact model's effects [m/m], [m/m], [rad/m].
        slip: root mean square slip of the wheels, which odometry from encoders ignores [m/m],
            [m/m], [rad/m].
        sideways: True if the robot can drive sideways.
    """

    floor: str
    process: Axes
    effect: Axes
    slip: Axes
    sideways: bool = True

    @property
    def constant(self) -> Axes:
        """Std of the constant error (effect and slip) per metre of path [m/m, m/m, rad/m]."""
        along, across, yaw = self.slip
        return axes_of(np.hypot(self.effect, (along, across * self.sideways, yaw)))

    def without_slip(self) -> "OdometryErrors":
        """Return the errors of odometry that estimates slip: only the contact model's errors."""
        return replace(self, slip=(0.0, 0.0, 0.0))

    def pose(self, distance: float) -> Axes:
        """Return the variances of x, y and heading [m^2, m^2, rad^2] after a path length [m]."""
        e, q = np.asarray(self.constant), np.asarray(self.process)
        along, across, yaw = (e * distance) ** 2 + q**2 * distance
        across += (e[2] * distance**2 / 2) ** 2 + q[2] ** 2 * distance**3 / 3
        place = max(along, across)
        return axes_of(np.array([place, place, yaw]))

    def twist(self, speed: float, period: float) -> Axes:
        """Return the variances of the velocity over a period [m^2/s^2, m^2/s^2, rad^2/s^2].

        At the speed v [m/s] the variances are (e v)^2 + q^2 v / period.
        """
        e, q = np.hypot(self.effect, self.slip), np.asarray(self.process)
        variances = (e * speed) ** 2 + q**2 * speed / period
        return _larger_in_plane(variances) if self.sideways else axes_of(variances)

    def walk(self, speed: float, distance: float) -> Axes:
        """Return the variances per second of a random walk that replaces the constant error.

        After the path length d [m] at the speed v [m/s] the std of the walk equals the constant
        error e d, so the variance per second is e^2 d v [m^2/s, m^2/s, rad^2/s].
        """
        return _larger_in_plane(np.asarray(self.constant) ** 2 * distance * speed)


def odometry_errors(
    robot: DeployedRobot, wheel_speeds: Float[np.ndarray, "floor drive 3"]
) -> tuple[OdometryErrors, ...]:
    """Return the errors of odometry on each floor, in the order of the robot's `labels`.

    `wheel_speeds` are the matrices from a body twist to wheel speeds that the odometry assumes on
    the floors [rad/m, rad/m, 1].
    """
    slip = _slip(robot.arrays, jnp.asarray(wheel_speeds), jnp.asarray(top_speed(robot)))
    rows = (robot.process, robot.effect, np.round(slip, 12))
    process, effect, lost = (list(map(axes_of, np.asarray(x))) for x in rows)
    return tuple(
        OdometryErrors(name, process[k], effect[k], lost[k], robot.holonomic)
        for k, name in enumerate(robot.labels)
    )


def worst_of(errors: tuple[OdometryErrors, ...]) -> OdometryErrors:
    """Return the errors on the floor with the largest position error after `DISTANCE_M`."""
    return max(errors, key=lambda e: e.pose(DISTANCE_M)[0])


def top_speed(robot: DeployedRobot) -> float:
    """Return the highest rim speed of the fitted runs [m/s]."""
    return float(robot.highest[0] * robot.frame.radius)


def diagonal(planar: Axes) -> tuple[float, ...]:
    """Return variances of x, y, z [m^2], roll, pitch, yaw [rad^2]; `planar` has x, y and yaw."""
    x, y, yaw = planar
    return (x, y, UNKNOWN, UNKNOWN, UNKNOWN, yaw)


@eqx.filter_jit
def _slip(
    robot: RobotArrays, wheel_speeds: Float[Array, "floor drive 3"], speed: Float[Array, ""]
) -> Float[Array, "floor 3"]:
    """Return the root mean square slip on each floor, along, across [m/m] and in yaw [rad/m].

    A robot that cannot drive sideways drives ahead and back, and turns on the spot or on the way;
    its slip is per metre that its wheels roll.
    """
    if robot.holonomic:
        angle = jnp.linspace(0.0, 2 * jnp.pi, DIRECTIONS, endpoint=False)
        way = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
        twist = jnp.concatenate([way, jnp.zeros((DIRECTIONS, 1))], axis=-1)
    else:
        moves = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]
        moves += [(0.7 * x, 0.5 * turn) for x in (1, -1) for turn in (1, -1)]
        ahead, turn = jnp.asarray(moves).T
        twist = jnp.stack([ahead, jnp.zeros_like(ahead), turn / robot.frame.base], axis=-1)
        way = jnp.tile(jnp.array([1.0, 0.0]), (len(moves), 1))

    def moved(floor: ContactSurface, by_wheels: Array, kinematics: Array, known: Array) -> Array:
        turned = speed * twist @ by_wheels.T
        rim = robot.at_wheels(turned) * robot.frame.radius
        forces = jax.vmap(lambda r: contact.equilibrium(r, robot.frame, floor, robot.rest))(rim)
        return jnp.where(known, turned @ kinematics.T, forces) / speed

    known = jnp.asarray(robot.calibrated)
    slip = twist - jax.vmap(moved)(robot.floors, wheel_speeds, robot.kinematics, known)
    along = jnp.sum(slip[..., :2] * way, axis=-1)
    across = slip[..., 1] * way[:, 0] - slip[..., 0] * way[:, 1]
    return jnp.sqrt(jnp.mean(jnp.stack([along, across, slip[..., 2]], axis=-1) ** 2, axis=1))


def _larger_in_plane(row: Float[np.ndarray, "3"]) -> Axes:
    """Replace the variances along and across by the larger of the two."""
    return axes_of(np.array([row[:2].max(), row[:2].max(), row[2]]))


FILTER_NODE = "ekf_filter_node"
_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
STATE = (*_POSE, *(f"v{name}" for name in _POSE), "ax", "ay", "az")
"""States of the filter, in the filter's order."""
FUSED = ("vx", "vy", "vyaw")
"""States that the filter reads from odometry messages. The messages' pose is not used, since it is
the integral of the same velocities."""
PLANAR_NOISE = 1e-6
"""Process noise (variance per second) of the states that `two_d_mode` keeps at zero."""
ACCELERATION = 0.01
"""Process noise of accelerations (variance per second) [m^2/s^5]; it is robot_localization's
default, since no sensor measures accelerations here."""


def filter_parameters(
    robot: DeployedRobot, errors: OdometryErrors, odometry: str, source: str
) -> tuple[Parameter, ...]:
    """Return all parameters of robot_localization's filter.

    Args:
        robot: identified robot.
        errors: errors of the odometry.
        odometry: topic of the odometry.
        source: description of the odometry's source, for a comment.
    """
    rest = "" if robot.holonomic else _AHEAD
    about = (
        f"Odometry of {source}. Only velocities are fused, since the odometry's pose is their "
        f"integral and contains no further information. {rest}Order: {', '.join(STATE)}."
    )
    return (
        Parameter("frequency", 1 / PERIOD_S, "Assumed rate of the odometry [Hz]."),
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
        process_noise(robot, errors),
    )


def process_noise(robot: DeployedRobot, errors: OdometryErrors) -> Parameter:
    """Return the process noise on a floor, a 15 x 15 matrix in row-major order.

    The diagonal is the variance per second of each state. For the pose it is `OdometryErrors.walk`;
    for velocities it is (a T)^2 per period T [s], where a is the largest acceleration
    [m/s^2, rad/s^2]. Nothing accelerates a robot sideways that cannot drive sideways.
    """
    change = float(Limits.of(robot).acceleration)
    speed, turn = change**2 * PERIOD_S, (change / float(robot.frame.base)) ** 2 * PERIOD_S
    noise = dict(zip(("x", "y", "yaw"), errors.walk(top_speed(robot), DISTANCE_M), strict=True))
    noise |= {"vx": speed, "vyaw": turn, "ax": ACCELERATION}
    if robot.holonomic:
        noise |= {"vy": speed, "ay": ACCELERATION}
    matrix = np.diag([noise.get(name, PLANAR_NOISE) for name in STATE])
    about = (
        f"On '{errors.floor}'. Pose: a random walk that replaces the errors that stay constant "
        f"over a path, with the same error after {short(DISTANCE_M)} m at the highest speed of "
        f"the fitted runs, {short(top_speed(robot))} m/s. Velocity: the change that the limit of "
        f"acceleration, {short(change)} m/s^2, allows within {short(PERIOD_S)} s. "
        "Accelerations: the default of robot_localization. All other states are held at zero by "
        f"{'two_d_mode' if robot.holonomic else 'two_d_mode, vy and ay by the wheels'}."
    )
    entries = tuple(matrix.reshape(-1).tolist())
    return Parameter("process_noise_covariance", entries, about, per_line=len(STATE))


_AHEAD = (
    "The robot cannot drive sideways, so that vy is fused as 0, with the small variance of its "
    "sideslip. "
)
_TF = (
    "Only one node may publish this transform: set enable_odom_tf of the drive controller to false."
)
_DYNAMIC = (
    "With false, the uncertainty of the pose also grows at standstill. True would scale the noise "
    "with the square of the speed and so neglect the errors of slow motion."
)
