"""What a motor on a bench is made of, and its two equations for a short stretch of time.

With <x> for the mean and [x] for the mean slope of a signal over a stretch of time,

    <U> = R <I> + C_e <w> + U_b s(<I> - I_0) + L_a [I] + U_0 - R I_0      s(i) = tanh(i / 0.05 A)
    <I> = (J [w] + tau_c tanh(<w> / w0) + b <w>) / C_e + I_0              w0 = 2.5 rad/s

where everything is at the motor shaft, and the torque per current is the back-EMF constant, as
energy demands. Where the ammeter shows magnitudes its zero goes with the motion: sign(w) I_0.

Both are linear in their coefficients, which are what the numbers of a motor make of them. Column by
column the signals are those of `VOLTS` and `AMPS`.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.parameter import parameter

BRUSH_CURRENT = 0.05
"""Current over which the drop of the brushes turns, as in `model.motor` [A]."""
REST = 2.5
"""Shaft speed over which friction turns, as in `model.motor` [rad/s]."""
VOLTS = ("current", "speed", "sign of the current", "slope of the current", "one", "along")
"""Signals of the electrical equation; the last is the direction that a magnitude was given."""
AMPS = ("slope of the speed", "sign of the speed", "speed", "along")
"""Signals of the mechanical equation."""


class BenchMotor(eqx.Module):
    """A brushed DC motor with its load, and the zeros of both meters; priors are weak."""

    resistance: Array = parameter(
        "ohm", "R", "winding resistance", start=1.0, lower=0.0, spread=2.0
    )
    back_emf: Array = parameter(
        "V*s/rad", "C_e", "back-EMF, and torque per current", start=0.05, lower=0.0, spread=2.0
    )
    inductance: Array = parameter("H", "L_a", "inductance", start=0.0, spread=2e-3)
    brush_drop: Array = parameter("V", "U_b", "voltage drop of the brushes", start=0.0, spread=1.0)
    coulomb_friction: Array = parameter(
        "N*m", "tau_c", "friction at the shaft", start=0.005, lower=0.0, spread=3.0
    )
    viscous_friction: Array = parameter(
        "N*m*s/rad", "b", "friction per shaft speed", start=1e-5, lower=0.0, spread=3.0
    )
    rotor_inertia: Array = parameter(
        "kg*m^2", "J", "rotor and what turns with it", start=1e-5, lower=0.0, spread=3.0
    )
    current_offset: Array = parameter("A", "I_0", "zero of the ammeter", start=0.0, spread=0.2)
    voltage_offset: Array = parameter("V", "U_0", "zero of the voltmeter", start=0.0, spread=1.0)

    def volts(self) -> Float[Array, " 6"]:
        """Coefficients of `VOLTS`."""
        r, zero = self.resistance, -self.resistance * self.current_offset
        return jnp.stack(
            [r, self.back_emf, self.brush_drop, self.inductance, self.voltage_offset, zero]
        )

    def amps(self) -> Float[Array, " 4"]:
        """Coefficients of `AMPS`."""
        torque = jnp.stack([self.rotor_inertia, self.coulomb_friction, self.viscous_friction])
        return jnp.append(torque / self.back_emf, self.current_offset)


class Bench(eqx.Module):
    """Root of the tree, so that the names begin with `motor`."""

    motor: BenchMotor
