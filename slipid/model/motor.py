"""Brushed DC motor: U = R I + C_e wm + L_a dI/dt + D(I), wm the motor speed [rad/s].

D is the voltage drop of the brushes, with the sign of the current (`brush_voltage`).
"""

from functools import partial

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.parameter import Numbers, as_numbers, parameter

electric = partial(parameter, electric=True)

REST = 2.5
"""Motor speed w0 below which the sign of the speed is unreliable [rad/s].

It is about the resolution of the speed signal."""

FRICTION_SPEED = 0.2
"""Wheel speed over which friction changes its sign [rad/s]."""

NEWTON_STEPS = 8
"""Number of Newton steps from a voltage to its current.

The equation is concave and the start too small, so that the steps approach the solution from one
side."""

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
    brush_current: Array = held(
        "A",
        "I_b",
        "current over which the brushes reach their drop",
        start=0.025,
        lower=0.0,
        spread=1.5,
    )
    brush_shape: Array = held(
        "1",
        "kappa",
        "shape of the brush drop over current, from exponential (0) to tanh (1)",
        start=1.0,
        lower=0.0,
        upper=1.001,
        spread=2.0,
    )
    brush_tail: Array = held(
        "1",
        "q",
        "part of the brush drop that grows with the logarithm of the current",
        start=0.0,
        lower=-0.001,
        upper=1.0,
        spread=1.5,
    )
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
        self,
        current: Float[Array, " *w"],
        wheel_speed: Float[Array, " *w"],
        direction: Float[Array, " *w"] | None = None,
    ) -> Float[Array, " *w"]:
        """Return the steady terminal voltage [V] at a signed current and wheel speed [rad/s].

        If current and speed are means over some time, `direction` is as in `friction`, and the
        result is the mean voltage: the drop of the brushes reverses with the motion.
        """
        share, (forward, size) = _share_of_motion(wheel_speed, direction), _sign_and_size(current)
        drop = forward * share * self._drop(size / share)[0]
        wm = self.gear_ratio * wheel_speed
        return self.resistance * current + self.back_emf * wm + drop

    def current_at(
        self,
        voltage: Float[Array, " *w"],
        wheel_speed: Float[Array, " *w"],
        direction: Float[Array, " *w"] | None = None,
    ) -> Float[Array, " *w"]:
        """Return the signed steady current [A] at a terminal voltage, the inverse of `voltage`."""
        share = _share_of_motion(wheel_speed, direction)
        wm = self.gear_ratio * wheel_speed
        forward, size = _sign_and_size((voltage - self.back_emf * wm) / share)
        # A drop is at most that of the current without a drop, and steepest at rest.
        steepest = jnp.maximum(self._drop(jnp.zeros_like(size))[1], 0.0)
        least = size / (self.resistance + steepest)
        x = jnp.maximum((size - self._drop(size / self.resistance)[0]) / self.resistance, least)
        for _ in range(NEWTON_STEPS):
            drop, slope = self._drop(x)
            slope = jnp.maximum(slope, 0.0)
            x = jnp.maximum((size - drop + slope * x) / (self.resistance + slope), least)
        return forward * share * x

    def _drop(self, size: Float[Array, " *w"]) -> tuple[Array, Array]:
        """Return the drop of the brushes at the size of a current, and its derivative."""
        shape = self.brush_shape, self.brush_tail
        return brush_voltage(size, self.brush_drop, self.brush_current, *shape)

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


def sign_of_motion(wheel_speed: Float[Numbers, " *w"]) -> Float[Array, " *w"]:
    """Return the sign of a wheel speed, tanh(w / w0) with w0 = `FRICTION_SPEED`."""
    return jnp.tanh(wheel_speed / FRICTION_SPEED)


def _share_of_motion(
    wheel_speed: Float[Array, " *w"], direction: Float[Array, " *w"] | None
) -> Array | float:
    """Return the mean sign of the motion over the sign of its mean speed [1], at most 1.

    It is 1 at steady speeds, and otherwise about the share of the time in which a wheel moves, less
    that in which it moves backwards. `direction` is as in `Motor.friction`.
    """
    if direction is None:
        return 1.0
    mean, of_mean = (jnp.sqrt(x**2 + 1e-12) for x in (direction, sign_of_motion(wheel_speed)))
    return jnp.minimum(mean / of_mean, 1.0)


def _sign_and_size(x: Array) -> tuple[Array, Array]:
    """Return the sign, 1 at 0, and the size of numbers; at 0 the size has the slope 1."""
    forward = jnp.where(x < 0, -1.0, 1.0)
    return forward, forward * x


def brush_voltage(
    size: Numbers, drop: Array, scale: Array, shape: Array, tail: Array
) -> tuple[Array, Array]:
    """Return the voltage drop of brushes [V] at the size of a current, and its derivative.

    D(I) = U_b [(1 - q) (1 - e) / (1 + kappa e) + q log(1 + I / I_b)] with e = exp(-I / I_b). It is
    concave.

    Args:
        size: size of the current I [A].
        drop: U_b [V].
        scale: I_b [A].
        shape: kappa, 0 for an exponential and 1 for tanh(I / (2 I_b)) [1].
        tail: q [1].
    """
    e, ratio = jnp.exp(-size / scale), size / scale
    below = 1 + shape * e
    voltage = drop * ((1 - tail) * (1 - e) / below + tail * jnp.log(1 + ratio))
    rise = drop / scale * ((1 - tail) * e * (1 + shape) / below**2 + tail / (1 + ratio))
    return voltage, rise


def signed(
    current: Float[Array, " *w"], wheel_speed: Float[Array, " *w"], gear_ratio: Array | float
) -> Float[Array, " *w"]:
    """Return currents that were logged as magnitudes, with the sign of the motor speed added.

    I = |I| wm / sqrt(wm^2 + w0^2) with the motor speed wm and w0 = `REST`, so that the sign changes
    smoothly. A current that brakes gets the wrong sign.
    """
    wm = gear_ratio * wheel_speed
    return jnp.abs(current) * wm / jnp.sqrt(wm**2 + REST**2)
