"""What ammeters show of motors that also brake: nothing while they do.

The Husky's ammeters measure what a motor takes from the battery. Where the ground pushes a wheel,
as it does on the inner side of a turn, the motor brakes and the meter shows nothing. Over a row the
current scatters, so the mean that is shown is that of a clipped normal variable,

    E[max(I + n, 0)] = I Phi(I / s) + s phi(I / s),   n ~ N(0, s^2)

with I the motor's current along its wheel's motion, Phi and phi the normal distribution and its
density. The motor of one side may be stiffer than that of the other; what it draws more than the
mean of all counts as its own friction.
"""

from dataclasses import fields

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.stats import norm
from jaxtyping import Array, Float

from slipid.model.motor import Motor

TURNING = 0.2
"""Wheel speed beyond which friction is whole, as of `slipid.model.motor` [rad/s]."""
STEADY_A = 0.1
"""Scatter of the current of a wheel that stands [A]."""


class MeteredMotor(Motor):
    """Motor as its ammeter shows it: `current` is never below zero.

    Attributes:
        stiffness: current that each drive's motor takes more than the mean of all [A].
        scatter: std of a current about its mean [A].
    """

    stiffness: Float[Array, " drive"] = eqx.field(kw_only=True)
    scatter: Float[Array, ""] = eqx.field(kw_only=True)

    @classmethod
    def of(cls, motor: Motor, stiffness: Array, scatter: Array) -> "MeteredMotor":
        """A motor with its ammeter."""
        same = {f.name: getattr(motor, f.name) for f in fields(Motor)}
        return cls(**same, stiffness=stiffness, scatter=scatter)

    def current(
        self, torque: Float[Array, " *w"], wheel_speed: Float[Array, " *w"]
    ) -> Float[Array, " *w"]:
        """Mean current [A] that is shown of each drive at a wheel torque [N m]."""
        way = jnp.tanh(wheel_speed / TURNING)
        along = way * super().current(torque, wheel_speed) + jnp.abs(way) * self.stiffness
        return clipped(along, STEADY_A + jnp.abs(way) * self.scatter)


def clipped(mean: Array, std: Array) -> Array:
    """Mean of a normal variable of which what is below zero counts as zero."""
    z = mean / std
    return mean * norm.cdf(z) + std * norm.pdf(z)
