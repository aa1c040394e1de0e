"""What the model misses all the way on a floor, and how far it stays the same.

An effect is a motion per metre along, across and in yaw. It belongs to a floor and to a direction
of travel u, the unit vector of the twist without slip, yaw as rim speed. Its std is the same
everywhere; it correlates less and less as the direction changes, and once the robot has left the
floor:

    k = exp(-(1 - a^2) |u - v|^2 / (2 TURN^2) - left far / AWAY),   a = exp(-far / SETTLES)
    e <- k e + sqrt(1 - k^2) std noise,   v <- u + a (v - u)

Over a direction that changes at once from v to u that makes exp(-|u - v|^2 / (2 TURN^2)), in
however many steps of the way, and directions that tremble make next to nothing: a way back errs
anew. Along an arc on which the direction turns by an angle at a curvature c it fades more slowly,
by exp(-angle c SETTLES / TURN^2) about: of a quarter turn on a radius of a metre a fifth stays.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

TURN = 0.17
"""Change of direction over which an effect becomes another one [rad]; on real logs 10 degrees."""
SETTLES = 0.03
"""Way on which a direction of travel counts as taken [m]."""
AWAY = 0.1
"""Way off a floor after which it is met anew [m]."""


def direction(rolling: Float[Array, "3"], base: Float[Array, ""]) -> Float[Array, "3"]:
    """Of travel, from the twist without slip and the base radius [m]."""
    rim = rolling.at[2].multiply(base)
    return rim / jnp.sqrt(rim @ rim + 1e-12)


def stays(
    before: Float[Array, "3"],
    now: Float[Array, "3"],
    left: Float[Array, " floor"],
    far: Float[Array, ""],
) -> tuple[Float[Array, "3"], Float[Array, " floor"]]:
    """Direction that counts as taken after a step, and how each floor's effect correlates over it.

    Args:
        before: direction that counted as taken, zeros at the start.
        now: direction of the step.
        left: whether no wheel is on the floor, 0 to 1.
        far: how far the step goes [m].
    """
    a = jnp.exp(-far / SETTLES)
    before = jnp.where(before @ before > 0, before, now)
    gap = before - now
    turned = (1 - a**2) * (gap @ gap) / (2 * TURN**2)
    return now + a * gap, jnp.exp(-turned - left * far / AWAY)
