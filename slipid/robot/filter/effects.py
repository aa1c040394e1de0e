"""What the model misses all the way on a floor: what is told of it, and how far it stays the same.

An effect is a motion along, across and in yaw per metre that wheels without slip would go. It
belongs to a floor and to a direction of travel u, the unit vector of the twist without slip, yaw as
rim speed. What the fitted runs tell of it, a mean and a std that is left, is a table over
directions and speeds (`EffectTable`). An effect e counts in stds left; it correlates less and less
as the direction changes, and once the robot has left the floor:

    k = exp(-(1 - a^2) |u - v|^2 / (2 TURN^2) - left far / AWAY),   a = exp(-far / SETTLES)
    e <- k e + sqrt(1 - k^2) noise,   v <- u + a (v - u)

Over a direction that changes at once from v to u that makes exp(-|u - v|^2 / (2 TURN^2)), in
however many steps of the way, and directions that tremble make next to nothing: a way back errs
anew. Along an arc on which the direction turns by an angle at a curvature c it fades more slowly,
by exp(-angle c SETTLES / TURN^2) about: of a quarter turn on a radius of a metre a fifth stays.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

TURN = 0.17
"""Change of direction over which an effect becomes another one [rad]; on real logs 10 degrees."""
SETTLES = 0.03
"""Way on which a direction of travel counts as taken [m]."""
AWAY = 0.1
"""Way off a floor after which it is met anew [m]."""
FORGETS = 0.5
"""Difference of logarithms of speed over which what is told fades, as in the fit."""
TRAVELS = 0.2
"""Part of the rim speed from which a robot that turns travels in a direction, as in the fit."""


class RolledMotion(eqx.Module):
    """Where the wheels would take the body if none slipped: effects count along it.

    Attributes:
        speed: of the body and, as rim speed, of its turn together [m/s].
        axes: along, across and yaw as columns in the body frame.
        straight: speed of the body alone [m/s]; angle: its direction in the body frame [rad].
        travels: whether it goes in a direction and does not turn on the spot.
    """

    speed: Float[Array, ""]
    axes: Float[Array, "3 3"]
    straight: Float[Array, ""]
    angle: Float[Array, ""]
    travels: Bool[Array, ""]

    @classmethod
    def of(cls, rolling: Float[Array, "3"], base: Float[Array, ""]) -> "RolledMotion":
        """From the twist without slip and the base radius [m]."""
        straight = jnp.sqrt(rolling[:2] @ rolling[:2] + 1e-24)
        speed = straight + base * jnp.abs(rolling[2])
        u = jnp.where(straight > 1e-6, rolling[:2] / straight, jnp.array([1.0, 0.0]))
        return cls(
            speed=speed,
            axes=jnp.array([[u[0], -u[1], 0.0], [u[1], u[0], 0.0], [0.0, 0.0, 1.0]]),
            straight=straight,
            angle=jnp.arctan2(u[1], u[0]),
            travels=straight > TRAVELS * speed,
        )


class EffectTable(eqx.Module):
    """What the fitted runs tell of the effects of every floor, at evenly spaced directions.

    Attributes:
        log_speed: logarithms of the speeds of the table [m/s], rising.
        table: mean along, across and in yaw, then the part of the whole std that is left in each.
    """

    log_speed: Float[Array, " speed"]
    table: Float[Array, "floor speed direction 6"]

    @classmethod
    def nothing(cls, floors: int) -> "EffectTable":
        """Of effects of which nothing is known."""
        row = jnp.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
        return cls(jnp.zeros(1), jnp.broadcast_to(row, (floors, 1, 1, 6)))

    def at(self, course: RolledMotion) -> tuple[Float[Array, "floor 3"], Float[Array, "floor 3"]]:
        """Mean of the effects on every floor, and the part of their std that is left.

        Linear between the table's directions and speeds; what is told fades beyond its speeds.
        """
        around = self.table.shape[2]
        place = jnp.mod(course.angle / (2 * jnp.pi), 1.0) * around
        first = jnp.floor(place).astype(jnp.int32)
        columns = jnp.stack([first, first + 1]) % around
        near, weight, beyond = self._speeds(jnp.log(jnp.maximum(course.straight, 1e-3)))
        corners = self.table[:, near[:, None], columns]
        across = jnp.stack([1 - (place - first), place - first])
        found = jnp.einsum("s,d,fsdk->fk", weight, across, corners)
        fade = jnp.where(course.travels, jnp.exp(-0.5 * (beyond / FORGETS) ** 2), 0.0)
        return fade * found[:, :3], jnp.sqrt(1 - fade**2 * (1 - found[:, 3:] ** 2))

    def _speeds(self, log_speed: Array) -> tuple[Array, Array, Array]:
        """Two rows of the table, their weights, and how far beyond all rows a speed lies."""
        rows = self.log_speed
        within = jnp.clip(log_speed, rows[0], rows[-1])
        if len(rows) == 1:
            return jnp.array([0, 0]), jnp.array([1.0, 0.0]), log_speed - within
        low = jnp.sum(within >= rows[1:-1])
        part = (within - rows[low]) / (rows[low + 1] - rows[low])
        return jnp.stack([low, low + 1]), jnp.stack([1 - part, part]), log_speed - within


def travel_direction(rolling: Float[Array, "3"], base: Float[Array, ""]) -> Float[Array, "3"]:
    """Of travel, from the twist without slip and the base radius [m]."""
    rim = rolling.at[2].multiply(base)
    return rim / jnp.sqrt(rim @ rim + 1e-12)


def effect_correlation(
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
