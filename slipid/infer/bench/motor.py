"""Model and records of a motor on a bench: its two equations for a short window of time.

With <x> for the mean and [x] for the mean slope of a signal over a window,

    <U> = R <I> + C_e <w> + U_b s(<I> - I_0) + L_a [I] + U_0 - R I_0      s(i) = tanh(i / 0.05 A)
    <I> = (J [w] + tau_c tanh(<w> / w0) + b <w>) / C_e + I_0              w0 = 2.5 rad/s

where speed, inertia and friction are those at the motor shaft, and the torque constant equals the
back-EMF constant by conservation of energy. If the ammeter shows magnitudes, the zero I_0 is
multiplied by the sign of the speed w.

Both equations are linear in coefficients, which are functions of the motor's parameters. `VOLTS`
and `AMPS` list the signals that these coefficients multiply.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.parameter import parameter
from slipid.support.errors import DataError

BRUSH_CURRENT = 0.05
"""Current over which the voltage drop of the brushes changes its sign, as in `model.motor` [A]."""
REST = 2.5
"""Shaft speed w0 over which friction changes its sign [rad/s]."""
VOLTS = ("current", "speed", "sign of the current", "slope of the current", "one", "along")
"""Signals of the electrical equation; `along` is the sign given to unsigned currents, 1 for signed
ones."""
AMPS = ("slope of the speed", "sign of the speed", "speed", "along")
"""Signals of the mechanical equation; `along` as in `VOLTS`."""


class BenchMotor(eqx.Module):
    """A brushed DC motor with its load and the zeros of both meters, with weak priors."""

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
        """Return the coefficients of `VOLTS`."""
        r, zero = self.resistance, -self.resistance * self.current_offset
        return jnp.stack(
            [r, self.back_emf, self.brush_drop, self.inductance, self.voltage_offset, zero]
        )

    def amps(self) -> Float[Array, " 4"]:
        """Return the coefficients of `AMPS`."""
        torque = jnp.stack([self.rotor_inertia, self.coulomb_friction, self.viscous_friction])
        return jnp.append(torque / self.back_emf, self.current_offset)


class BenchRoot(eqx.Module):
    """Root of the parameter tree, so that names begin with `motor`."""

    motor: BenchMotor


@dataclass(frozen=True, eq=False, kw_only=True)
class BenchRecord:
    """One run of one motor.

    Attributes:
        name: name of the log.
        sha256: hash of its file.
        time: time of each row, increasing [s].
        voltage: voltage across the motor, or its mean over the PWM; None if not logged [V].
        current: current, with the sign of the speed if the ammeter shows magnitudes; None if not
            logged [A].
        speed: speed of the motor shaft [rad/s].
        signed: False if the ammeter shows magnitudes.
    """

    name: str
    sha256: str
    time: Float[np.ndarray, " row"]
    voltage: Float[np.ndarray, " row"] | None
    current: Float[np.ndarray, " row"] | None
    speed: Float[np.ndarray, " row"]
    signed: bool = True

    @property
    def amps(self) -> Float[np.ndarray, " row"]:
        """Current [A]; raises `DataError` if it was not logged."""
        if self.current is None:
            raise DataError(
                f"{self.name}: no column for the current: voltage and speed alone tell kS, kV and "
                "kA (the voltages for friction, speed and acceleration), which slipid does not fit "
                "yet; expected --current with the column of the motor's current"
            )
        return self.current

    @property
    def period(self) -> float:
        """Median time between rows [s]."""
        return float(np.median(np.diff(self.time)))


def noise(signals: Sequence[Float[np.ndarray, "_"]]) -> float:
    """Return the std of white noise from second differences, at least that of rounding.

    For white noise, (x_k-1 - 2 x_k + x_k+1) / sqrt(6) has the same std as x; its median is not
    affected by jumps. The resolution of the signal is the smallest step between rows.
    """
    bent = np.concatenate([np.diff(x, 2) for x in signals]) / np.sqrt(6)
    steps = np.abs(np.concatenate([np.diff(x) for x in signals]))
    smallest = float(np.min(steps[steps > 0], initial=np.inf))
    rounding = smallest / np.sqrt(12) if np.isfinite(smallest) else 0.0
    return max(1.4826 * float(np.median(np.abs(bent), axis=0)) if len(bent) else 0.0, rounding)
