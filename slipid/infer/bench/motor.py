"""What a motor on a bench is made of, and its two equations for a short stretch of time.

With <x> for the mean and [x] for the mean slope of a signal over a stretch of time,

    <U> = R <I> + C_e <w> + U_b s(<I> - I_0) + L_a [I] + U_0 - R I_0      s(i) = tanh(i / 0.05 A)
    <I> = (J [w] + tau_c tanh(<w> / w0) + b <w>) / C_e + I_0              w0 = 2.5 rad/s

where everything is at the motor shaft, and the torque per current is the back-EMF constant, as
energy demands. Where the ammeter shows magnitudes its zero goes with the motion: sign(w) I_0.

Both are linear in their coefficients, which are what the numbers of a motor make of them. Column by
column the signals are those of `VOLTS` and `AMPS`.

What a bench logs of one motor: time, voltage, current and speed, at the shaft.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
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


class BenchRoot(eqx.Module):
    """Root of the tree, so that the names begin with `motor`."""

    motor: BenchMotor


@dataclass(frozen=True, eq=False, kw_only=True)
class BenchRecord:
    """One run of one motor.

    Attributes:
        name: of the log; `sha256`: of its file.
        time: [s], increasing.
        voltage: across the motor, or its mean over the PWM [V]; None where it was not logged.
        current: [A]; with the sign of the speed where the ammeter shows magnitudes.
        speed: of the motor shaft [rad/s].
        signed: False where the ammeter shows magnitudes.
    """

    name: str
    sha256: str
    time: Float[np.ndarray, " row"]
    voltage: Float[np.ndarray, " row"] | None
    current: Float[np.ndarray, " row"]
    speed: Float[np.ndarray, " row"]
    signed: bool = True

    @property
    def period(self) -> float:
        """Usual time between rows [s]."""
        return float(np.median(np.diff(self.time)))


@dataclass(frozen=True)
class SensorNoise:
    """Std of what changes from row to row, quantisation included: [V] or None, [A], [rad/s]."""

    voltage: float | None
    current: float
    speed: float


def noise_of(records: Sequence[BenchRecord]) -> SensorNoise:
    """Noise of the sensors over all records of a motor."""
    volts = [r.voltage for r in records if r.voltage is not None]
    return SensorNoise(
        noise(volts) if volts else None,
        noise([r.current for r in records]),
        noise([r.speed for r in records]),
    )


def noise(signals: Sequence[Float[np.ndarray, " row"]]) -> float:
    """Std of white noise, from second differences, at least that of rounding to the smallest step.

    For white noise (x_k-1 - 2 x_k + x_k+1) / sqrt(6) has its std; a median lets go of jumps.
    """
    bent = np.concatenate([np.diff(x, 2) for x in signals]) / np.sqrt(6)
    steps = np.abs(np.concatenate([np.diff(x) for x in signals]))
    smallest = float(np.min(steps[steps > 0], initial=np.inf))
    rounding = smallest / np.sqrt(12) if np.isfinite(smallest) else 0.0
    return max(1.4826 * float(np.median(np.abs(bent), axis=0)) if len(bent) else 0.0, rounding)
