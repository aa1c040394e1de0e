"""Effects of floors: their estimates from the fitted runs, and their correlation over a path.

An effect is what the model misses all the way on a floor: a motion along, across and in yaw per
metre that the wheels would roll without slip. It belongs to a floor and to a direction of travel u,
the unit vector of the twist without slip, yaw as rim speed. Its estimates from the fitted runs, a
mean and a remaining std, are a table over directions and speeds (`EffectLookup`). An effect e is
counted in remaining stds; it decorrelates as the direction changes, and once the robot has left the
floor:

    k = exp(-(1 - a^2) |u - v|^2 / (2 TURN^2) - left far / AWAY),   a = exp(-far / SETTLES)
    e <- k e + sqrt(1 - k^2) noise,   v <- u + a (v - u)

with `far` the path length of the step, v the settled direction and `left` whether no wheel is on
the floor. For a direction that changes at once from v to u this makes exp(-|u - v|^2 / (2 TURN^2)),
in however many steps it is computed, and trembling directions make nearly no change; on a drive
back the effect is a new one. Along an arc on which the direction turns by an angle at a curvature c
it fades more slowly, by about exp(-angle c SETTLES / TURN^2): over a quarter turn on a radius of a
metre a fifth remains.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

TURN = 0.17
"""Change of direction over which an effect becomes another one [rad]; on real logs 10 degrees."""
SETTLES = 0.03
"""Path length over which a direction of travel settles [m]."""
AWAY = 0.1
"""Path length off a floor after which its effect is drawn anew [m]."""
FORGETS = 0.5
"""Difference of log speeds over which the estimates fade beyond the table, as in the fit."""
TRAVELS = 0.2
"""Share of the rim speed above which a turning robot travels in a direction, as in the fit."""


class RolledMotion(eqx.Module):
    """Motion of the body if no wheel slipped, along which effects count.

    Attributes:
        speed: speed of the body plus that of its turn as rim speed [m/s].
        axes: directions along, across and in yaw, as columns in the body frame.
        straight: speed of the body without its turn [m/s].
        angle: direction of travel in the body frame [rad].
        travels: whether the body travels in a direction rather than turning on the spot.
    """

    speed: Float[Array, ""]
    axes: Float[Array, "3 3"]
    straight: Float[Array, ""]
    angle: Float[Array, ""]
    travels: Bool[Array, ""]

    @classmethod
    def of(cls, rolling: Float[Array, "3"], base: Float[Array, ""]) -> "RolledMotion":
        """Return the motion of a twist without slip, for a base radius [m]."""
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


class EffectLookup(eqx.Module):
    """Effects of every floor estimated from the fitted runs, at evenly spaced directions.

    Attributes:
        log_speed: rising logarithms of the table's speeds [m/s].
        table: mean along, across and in yaw, then the remaining share of the whole std in each.
    """

    log_speed: Float[Array, " speed"]
    table: Float[Array, "floor speed direction 6"]

    @classmethod
    def empty(cls, floors: int) -> "EffectLookup":
        """Return the table of unknown effects."""
        row = jnp.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
        return cls(jnp.zeros(1), jnp.broadcast_to(row, (floors, 1, 1, 6)))

    def at(self, rolled: RolledMotion) -> tuple[Float[Array, "floor 3"], Float[Array, "floor 3"]]:
        """Return the mean effect on every floor, and the remaining share of its std.

        The table is interpolated linearly over directions and speeds; beyond its speeds the
        estimates fade.
        """
        around = self.table.shape[2]
        place = jnp.mod(rolled.angle / (2 * jnp.pi), 1.0) * around
        first = jnp.floor(place).astype(jnp.int32)
        columns = jnp.stack([first, first + 1]) % around
        near, weight, beyond = self._speeds(jnp.log(jnp.maximum(rolled.straight, 1e-3)))
        corners = self.table[:, near[:, None], columns]
        by_direction = jnp.stack([1 - (place - first), place - first])
        row = jnp.einsum("s,d,fsdk->fk", weight, by_direction, corners)
        fade = jnp.where(rolled.travels, jnp.exp(-0.5 * (beyond / FORGETS) ** 2), 0.0)
        return fade * row[:, :3], jnp.sqrt(1 - fade**2 * (1 - row[:, 3:] ** 2))

    def _speeds(self, log_speed: Array) -> tuple[Array, Array, Array]:
        """Return two rows of the table, their weights, and how far a log speed lies beyond all."""
        rows = self.log_speed
        within = jnp.clip(log_speed, rows[0], rows[-1])
        if len(rows) == 1:
            return jnp.array([0, 0]), jnp.array([1.0, 0.0]), log_speed - within
        low = jnp.sum(within >= rows[1:-1])
        part = (within - rows[low]) / (rows[low + 1] - rows[low])
        return jnp.stack([low, low + 1]), jnp.stack([1 - part, part]), log_speed - within


def travel_direction(rolling: Float[Array, "3"], base: Float[Array, ""]) -> Float[Array, "3"]:
    """Return the direction of travel of a twist without slip, for a base radius [m]."""
    rim = rolling.at[2].multiply(base)
    return rim / jnp.sqrt(rim @ rim + 1e-12)


def effect_correlation(
    before: Float[Array, "3"],
    now: Float[Array, "3"],
    left: Float[Array, " floor"],
    far: Float[Array, ""],
) -> tuple[Float[Array, "3"], Float[Array, " floor"]]:
    """Return the settled direction after a step, and each floor's correlation of effects over it.

    Args:
        before: settled direction before the step, zeros at the start.
        now: direction of the step.
        left: whether no wheel is on the floor, 0 to 1.
        far: path length of the step [m].
    """
    a = jnp.exp(-far / SETTLES)
    before = jnp.where(before @ before > 0, before, now)
    gap = before - now
    turned = (1 - a**2) * (gap @ gap) / (2 * TURN**2)
    return now + a * gap, jnp.exp(-turned - left * far / AWAY)
