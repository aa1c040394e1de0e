"""Brushed DC motor: U = R I + C_e wm + L_a dI/dt + brush drop, wm the motor speed [rad/s]."""

from functools import partial

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.parameter import as_numbers, parameter

electric = partial(parameter, electric=True)

REST = 2.5
"""Motor speed w0 below which the sign of the speed is unreliable [rad/s].

It is about the resolution of the speed signal."""

FRICTION_SPEED = 0.2
"""Wheel speed over which friction changes its sign [rad/s]."""

held = partial(electric, free=False)
"""Declaration of an electric parameter that is fixed unless the user frees it."""


class Motor(eqx.Module):
    """Brushed DC motor behind a gear; all wheels have the same motor.

    Attributes:
        gear_ratio: n, motor speed over wheel speed.
    """

    resistance: Array = electric("ohm", "R", "winding resistance", start=1.0, lower=0.0, spread=0.5)
    back_emf: Array = electric(
        "V*s/rad", "C_e", "back-EMF constant", start=0.05, lower=0.0, spread=0.5
    )
    inductance: Array = held("H", "L_a", "inductance", start=0.005, lower=0.0, spread=1.0)
    brush_drop: Array = held("V", "U_b", "voltage drop of the brushes", start=0.0, spread=0.5)
    efficiency: Array = held(
        "1", "eta", "efficiency of the gear", start=0.9, lower=0.0, upper=1.001, spread=0.5
    )
    coulomb_friction: Array = electric(
        "N*m", "tau_c", "friction at the wheel", start=0.02, lower=0.0, spread=1.5
    )
    viscous_friction: Array = electric(
        "N*m*s/rad", "b_w", "friction per speed", start=0.005, lower=0.0, spread=1.5
    )
    rolling_drag: Array = held(
        "1",
        "k_d",
        "drag of a wheel that rolls along its drive, over that of its rollers at an even load",
        start=0.0,
        spread=1.0,
    )
    current_offset: Array = held("A", "I_0", "zero of the ammeter", start=0.0, spread=0.05)
    rotor_inertia: Array = held(
        "kg*m^2", "J_m", "inertia of the rotor", start=1e-5, lower=0.0, spread=1.0
    )
    gear_ratio: Array = eqx.field(converter=as_numbers, default=1.0)

    def voltage(
        self, current: Float[Array, " *w"], wheel_speed: Float[Array, " *w"]
    ) -> Float[Array, " *w"]:
        """Return the steady terminal voltage [V] at a signed current and wheel speed [rad/s]."""
        wm = self.gear_ratio * wheel_speed
        drop = self.brush_drop * jnp.tanh(current / 0.05)
        return self.resistance * current + self.back_emf * wm + drop

    def friction(
        self, wheel_speed: Float[Array, " *w"], direction: Float[Array, " *w"] | None = None
    ) -> Float[Array, " *w"]:
        """Return the friction torque at the wheel [N m], with the sign of the wheel speed.

        If `wheel_speed` is a mean over some time, `direction` is the mean of `sign_of_motion` over
        the same time [1], which differs from that of the mean speed where wheels rest or reverse.
        """
        along = sign_of_motion(wheel_speed) if direction is None else direction
        return self.coulomb_friction * along + self.viscous_friction * wheel_speed

    def opposing_force(self, motor_force: Float[Array, "*w 2"]) -> Float[Array, " *w"]:
        """Return the force that a motor works against: traction, plus drag in the drive direction.

        `motor_force` holds the traction, and the drag that would result from `rolling_drag` = 1, as
        `slipid.model.robot.Standing.motor_forces` returns them. The result has the same unit.
        """
        return motor_force[..., 0] + self.rolling_drag * motor_force[..., 1]

    @property
    def gain(self) -> Array:
        """Torque at the wheel per current, n eta C_e [N m/A]."""
        return self.gear_ratio * self.efficiency * self.back_emf

    def torque(
        self, current: Float[Array, " *w"], wheel_speed: Float[Array, " *w"]
    ) -> Float[Array, " *w"]:
        """Return the torque at the wheel [N m] of a signed current: n eta C_e I - friction."""
        return self.gain * current - self.friction(wheel_speed)

    def current(
        self,
        torque: Float[Array, " *w"],
        wheel_speed: Float[Array, " *w"],
        direction: Float[Array, " *w"] | None = None,
    ) -> Float[Array, " *w"]:
        """Return the signed current [A] for a wheel torque [N m], the inverse of `torque`.

        `direction` is as in `friction`.
        """
        return (torque + self.friction(wheel_speed, direction)) / self.gain

    def characteristic(
        self, current: Float[Array, " *w"], wheel_speed: Float[Array, " *w"]
    ) -> Float[Array, " *w"]:
        """Return the "torque characterising variable" M of the 2021 paper [N m].

        M = U I / wm with the voltage U, current I and motor speed wm. It is computed as
        C_e I + R I^2 wm / (wm^2 + w0^2), which is finite at standstill, with w0 = `REST`.

        Source: Belyaev, Brylev, Ivanov 2021.
        """
        wm = self.gear_ratio * wheel_speed
        return self.back_emf * current + self.resistance * current**2 * wm / (wm**2 + REST**2)


def sign_of_motion(wheel_speed: Float[Array, " *w"]) -> Float[Array, " *w"]:
    """Return the sign of a wheel speed, tanh(w / w0) with w0 = `FRICTION_SPEED`."""
    return jnp.tanh(wheel_speed / FRICTION_SPEED)


def signed(
    current: Float[Array, " *w"], wheel_speed: Float[Array, " *w"], gear_ratio: Array | float
) -> Float[Array, " *w"]:
    """Return currents that were logged as magnitudes, with the sign of the motor speed added.

    I = |I| wm / sqrt(wm^2 + w0^2) with the motor speed wm and w0 = `REST`, so that the sign changes
    smoothly. A current that brakes gets the wrong sign.
    """
    wm = gear_ratio * wheel_speed
    return jnp.abs(current) * wm / jnp.sqrt(wm**2 + REST**2)
