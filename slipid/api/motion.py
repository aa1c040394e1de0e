"""What a robot whose numbers are known does with a command: motion, slip, torque and current."""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.model.robot import Robot, twist, wheel_torque


@dataclass(frozen=True, eq=False)
class Motion:
    """Steady motions, a row per command.

    Attributes:
        twist: of the body, x [m/s], y [m/s], yaw rate [rad/s].
        wheel_speed: that the command asks for [rad/s].
        slip: 1 - v / (r w) of every wheel along its drive; of one that stands it is no number.
        torque: at every wheel, positive where it drives [N m].
        current: of every motor, positive where it drives [A].
    """

    twist: Float[np.ndarray, "command 3"]
    wheel_speed: Float[np.ndarray, "command wheel"]
    slip: Float[np.ndarray, "command wheel"]
    torque: Float[np.ndarray, "command wheel"]
    current: Float[np.ndarray, "command wheel"]


def move(
    robot: Robot, floor: str, command: Sequence[Sequence[float]] | np.ndarray, load: str = ""
) -> Motion:
    """Steady motion of a robot whose wheels keep the speeds that commands ask for.

    Args:
        robot: with its numbers, such as `fit.robot`.
        floor: name.
        command: body twists x [m/s], y [m/s], yaw rate [rad/s], a row each.
        load: name of the load set-up, the first one by default.

    Raises:
        ValueError: no such floor or load set-up.

    Source: the force balance of `slipid.model.contact`.
    """
    places = robot.surface_index(floor), robot.load_index(load or robot.body.loads[0])
    rows = jnp.atleast_2d(jnp.asarray(command, dtype=float))
    return Motion(*(np.asarray(x) for x in _moved(robot, rows, *map(jnp.asarray, places))))


@eqx.filter_jit
def _moved(
    robot: Robot, command: Float[Array, "command 3"], floor: Array, load: Array
) -> tuple[Array, ...]:
    frame = robot.geometry.frame()

    def one(row: Float[Array, "3"]) -> tuple[Array, ...]:
        speed = robot.geometry.forward() @ row / frame.radius
        way, stands = jnp.sign(speed), jnp.abs(speed) < 1e-6
        xi = twist(robot, frame, speed, floor, load)
        torque = wheel_torque(robot, frame, xi, speed, floor, load)
        rim = jnp.where(stands, jnp.nan, frame.radius * frame.pull * speed)
        current = robot.motor.current(torque, speed)
        return xi, speed, 1 - frame.hold @ xi / rim, torque * way, current * way

    return jax.vmap(one)(command)
