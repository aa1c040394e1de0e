"""What odometry errs by on each floor, as the variances that ROS messages and filters take.

On a way d [m] an error grows by a part that stays the same (effect e [per m]) and one that comes
anew (process q [per sqrt(m)]), so that its variance is (e d)^2 + q^2 d. Odometry that believes its
encoders errs by the slip of its wheels as well: its e^2 is effect^2 + slip^2, slip being the root
mean square, over directions of travel, of what the contact model says the wheels slip by. Which way
a robot goes is not known to a constant covariance, so x and y both get the larger of along and
across. A heading that is off carries the robot sideways: with e_w and q_w of the yaw, by
(e_w d^2 / 2)^2 + q_w^2 d^3 / 3.

ROS drive controllers put one constant diagonal into every message, which no true covariance of
odometry is; it is taken at `DISTANCE_M`, and for twists at the highest speed that the fit has seen.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.control.deployed import DeployedRobot, RobotArrays
from slipid.control.robot_file.record import Axes
from slipid.model import contact
from slipid.model.contact_law import ContactSurface

DISTANCE_M = 1.0
"""Way since the pose was last set right for which constant variances are."""
PERIOD_S = 0.02
"""Time between two messages of odometry for which they are."""
UNKNOWN = 1e6
"""Variance of what wheels do not tell: height, roll and pitch."""
WAYS = 24
"""Directions of travel over which slip is averaged."""


@dataclass(frozen=True)
class Errs:
    """What odometry errs by on a floor, along, across and in yaw.

    Attributes:
        process: [m/sqrt(m)], [m/sqrt(m)], [rad/sqrt(m)].
        effect: what the contact model misses all the way; slip: of wheels, which encoders do not
            see; both [m/m], [m/m], [rad/m].
    """

    floor: str
    process: Axes
    effect: Axes
    slip: Axes

    @property
    def stays(self) -> Axes:
        """What stays the same all the way of odometry that believes its encoders, per metre."""
        return _axes(np.hypot(self.effect, self.slip))

    def without_slip(self) -> "Errs":
        """Of odometry that estimates slip, and so errs by what the contact model misses."""
        return replace(self, slip=(0.0, 0.0, 0.0))

    def pose(self, distance: float) -> Axes:
        """Variance of x, y and heading after a way [m^2, m^2, rad^2]."""
        e, q = np.asarray(self.stays), np.asarray(self.process)
        along, across, yaw = (e * distance) ** 2 + q**2 * distance
        across += (e[2] * distance**2 / 2) ** 2 + q[2] ** 2 * distance**3 / 3
        place = max(along, across)
        return _axes(np.array([place, place, yaw]))

    def twist(self, speed: float, period: float) -> Axes:
        """Variance of the velocity over one period, (e v)^2 + q^2 v / period, at a speed [m/s]."""
        e, q = np.asarray(self.stays), np.asarray(self.process)
        return _level((e * speed) ** 2 + q**2 * speed / period)

    def walk(self, speed: float, distance: float) -> Axes:
        """Variance per second of a random walk that is e d off after a way d, e^2 d v."""
        return _level(np.asarray(self.stays) ** 2 * distance * speed)


def errs_of(robot: DeployedRobot) -> tuple[Errs, ...]:
    """Errors of odometry on each floor, in the robot's order."""
    slip = np.asarray(_slip(robot.arrays, jnp.asarray(top_speed(robot))))
    process, effect = np.asarray(robot.process), np.asarray(robot.effect)
    return tuple(
        Errs(name, _axes(process[k]), _axes(effect[k]), _axes(slip[k]))
        for k, name in enumerate(robot.labels)
    )


def worst(errs: tuple[Errs, ...]) -> Errs:
    """Errors on the floor on which the place is least known after `DISTANCE_M`."""
    return max(errs, key=lambda e: e.pose(DISTANCE_M)[0])


def top_speed(robot: DeployedRobot) -> float:
    """Rim speed up to which the fit has seen the robot [m/s]."""
    return float(robot.highest[0] * robot.frame.radius)


def diagonal(planar: Axes) -> tuple[float, ...]:
    """Variances of x, y, z, roll, pitch and yaw."""
    x, y, yaw = planar
    return (x, y, UNKNOWN, UNKNOWN, UNKNOWN, yaw)


@eqx.filter_jit
def _slip(robot: RobotArrays, speed: Float[Array, ""]) -> Float[Array, "floor 3"]:
    """Root mean square of what encoders err by per metre, along, across and in yaw."""
    angle = jnp.linspace(0.0, 2 * jnp.pi, WAYS, endpoint=False)
    way = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros(WAYS)], axis=-1)
    rim = speed * way @ robot.forward.T

    def one(floor: ContactSurface) -> Array:
        return jax.vmap(lambda r: contact.equilibrium(r, robot.frame, floor, robot.rest))(rim)

    miss = way - jax.vmap(one)(robot.floors) / speed
    along = jnp.sum(miss * way, axis=-1)
    across = miss[..., 1] * way[:, 0] - miss[..., 0] * way[:, 1]
    return jnp.sqrt(jnp.mean(jnp.stack([along, across, miss[..., 2]], axis=-1) ** 2, axis=1))


def _axes(row: Float[np.ndarray, "3"]) -> Axes:
    along, across, yaw = (float(x) for x in row)
    return along, across, yaw


def _level(row: Float[np.ndarray, "3"]) -> Axes:
    """The same errors with the larger of along and across for both."""
    return _axes(np.array([row[:2].max(), row[:2].max(), row[2]]))
