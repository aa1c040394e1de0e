"""Effects of floors: their estimates from the fitted runs, and their correlation over a path.

An effect is a constant error of the model on a floor: motion along, across and in yaw that the
model does not predict, per metre that the wheels would roll without slip [m/m, m/m, rad/m]. It
belongs to a floor and to a direction of travel u: the unit vector of the twist without slip, whose
yaw rate is multiplied by the base radius first. A table over directions and speeds (`EffectLookup`)
holds the mean of the effects estimated from the fitted runs, and the std that remains. An effect e,
less its mean and in units of its remaining std, decorrelates as the direction changes, and once the
robot has left the floor:

    a = exp(-far / SETTLING_LENGTH)
    k = exp(-(1 - a^2) |u - v|^2 / (2 DIRECTION_STD^2) - left far / LEAVING_LENGTH)
    e <- k e + sqrt(1 - k^2) noise,   v <- u + a (v - u)

where `far` is the path length of the step [m], k the correlation of the effect over the step, v the
settled direction (u after a low-pass filter with the factor a), and `left` is 1 if no wheel is on
the floor, else 0.
If the direction changes at once from v to u, the correlation becomes
exp(-|u - v|^2 / (2 DIRECTION_STD^2)), in however many steps it is computed. Jitter of the direction
barely changes the correlation, and on a drive back the effect is independent of the effect on the
way out. Along an arc of curvature c [1/m] on which the direction turns by an angle [rad], the
correlation falls more slowly, to about exp(-angle c SETTLING_LENGTH / DIRECTION_STD^2): after a
quarter turn on a radius of one metre it is a fifth.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

DIRECTION_STD = 0.17
"""Width sigma of the Gaussian over changes of direction with which an effect decorrelates [rad];
the value, 10 deg, was estimated from real logs."""
SETTLING_LENGTH = 0.03
"""Path length constant of the low-pass filter of the direction of travel [m]."""
LEAVING_LENGTH = 0.1
"""Path length off a floor over which its effect decorrelates by a factor of e [m]."""
LOG_SPEED_STD = 0.5
"""Width sigma of the Gaussian over log speed with which the table's means fade to 0 outside its
range of speeds [1]; the fit uses the same value."""
TRAVEL_SHARE = 0.2
"""Ratio of translational speed to `RolledMotion.speed` above which a robot counts as travelling in
a direction, not as turning on the spot [1]; the fit uses the same value."""


class RolledMotion(eqx.Module):
    """Motion of the body if no wheel slipped; effects are relative to its speed and direction.

    Attributes:
        speed: speed of the body plus base radius times its absolute yaw rate [m/s].
        axes: unit vectors along, across and in yaw, as columns in the body frame.
        straight: translational speed of the body [m/s].
        angle: direction of travel in the body frame [rad].
        travels: True if the body travels in a direction rather than turning on the spot.
    """

    speed: Float[Array, ""]
    axes: Float[Array, "3 3"]
    straight: Float[Array, ""]
    angle: Float[Array, ""]
    travels: Bool[Array, ""]

    @classmethod
    def of(cls, rolling: Float[Array, "3"], base: Float[Array, ""]) -> "RolledMotion":
        """Return the motion for the twist without slip `rolling` and the base radius `base` [m]."""
        straight = jnp.sqrt(rolling[:2] @ rolling[:2] + 1e-24)
        speed = straight + base * jnp.abs(rolling[2])
        u = jnp.where(straight > 1e-6, rolling[:2] / straight, jnp.array([1.0, 0.0]))
        return cls(
            speed=speed,
            axes=jnp.array([[u[0], -u[1], 0.0], [u[1], u[0], 0.0], [0.0, 0.0, 1.0]]),
            straight=straight,
            angle=jnp.arctan2(u[1], u[0]),
            travels=straight > TRAVEL_SHARE * speed,
        )


class EffectLookup(eqx.Module):
    """Table of the effects estimated from the fitted runs, at evenly spaced directions.

    Attributes:
        log_speed: logarithms of the table's speeds [m/s], in rising order.
        table: mean effect along, across [m/m] and in yaw [rad/m], then the remaining std of each of
            the three as a fraction of its std without a table [1].
    """

    log_speed: Float[Array, " speed"]
    table: Float[Array, "floor speed direction 6"]

    @classmethod
    def empty(cls, floors: int) -> "EffectLookup":
        """Return a table without estimates: means are 0, remaining fractions of stds are 1."""
        rows = np.tile([0.0, 0.0, 0.0, 1.0, 1.0, 1.0], (floors, 1, 1, 1))
        return cls(jax.device_put(np.zeros(1)), jax.device_put(rows))

    def at(self, rolled: RolledMotion) -> tuple[Float[Array, "floor 3"], Float[Array, "floor 3"]]:
        """Return the mean effect on every floor, and the remaining fraction of the effect's std.

        The table is interpolated linearly over directions and speeds. Outside its range of speeds,
        and while the robot turns on the spot, means fade to 0 and fractions to 1.
        """
        around = self.table.shape[2]
        place = jnp.mod(rolled.angle / (2 * jnp.pi), 1.0) * around
        first = jnp.floor(place).astype(jnp.int32)
        columns = jnp.stack([first, first + 1]) % around
        near, weight, beyond = self._speeds(jnp.log(jnp.maximum(rolled.straight, 1e-3)))
        corners = self.table[:, near[:, None], columns]
        by_direction = jnp.stack([1 - (place - first), place - first])
        row = jnp.einsum("s,d,fsdk->fk", weight, by_direction, corners)
        fade = jnp.where(rolled.travels, jnp.exp(-0.5 * (beyond / LOG_SPEED_STD) ** 2), 0.0)
        return fade * row[:, :3], jnp.sqrt(1 - fade**2 * (1 - row[:, 3:] ** 2))

    def _speeds(self, log_speed: Array) -> tuple[Array, Array, Array]:
        """Return the table's two rows next to a log speed, their weights, and the excess.

        The excess is the signed distance of the log speed from the table's range; it is 0 inside.
        """
        rows = self.log_speed
        within = jnp.clip(log_speed, rows[0], rows[-1])
        if len(rows) == 1:
            return jnp.array([0, 0]), jnp.array([1.0, 0.0]), log_speed - within
        low = jnp.sum(within >= rows[1:-1])
        part = (within - rows[low]) / (rows[low + 1] - rows[low])
        return jnp.stack([low, low + 1]), jnp.stack([1 - part, part]), log_speed - within


def travel_direction(rolling: Float[Array, "3"], base: Float[Array, ""]) -> Float[Array, "3"]:
    """Return the direction of travel of a twist without slip as a unit vector.

    The yaw rate is multiplied by the base radius `base` [m] first.
    """
    rim = rolling.at[2].multiply(base)
    return rim / jnp.sqrt(rim @ rim + 1e-12)


def effect_correlation(
    before: Float[Array, "3"],
    now: Float[Array, "3"],
    left: Float[Array, " floor"],
    far: Float[Array, ""],
) -> tuple[Float[Array, "3"], Float[Array, " floor"]]:
    """Return the settled direction after a step, and each floor's correlation k over the step.

    Args:
        before: settled direction before the step; zeros at the start.
        now: direction of travel in the step.
        left: probability that no wheel is on each floor [1].
        far: path length of the step [m].
    """
    a = jnp.exp(-far / SETTLING_LENGTH)
    before = jnp.where(before @ before > 0, before, now)
    gap = before - now
    turned = (1 - a**2) * (gap @ gap) / (2 * DIRECTION_STD**2)
    return now + a * gap, jnp.exp(-turned - left * far / LEAVING_LENGTH)
