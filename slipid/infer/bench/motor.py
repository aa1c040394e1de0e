"""Model and records of a motor on a bench.

    U - U_0 = R (1 + h t) I + C_e w + D(I) + L_a dI/dt
    C_e I   = J dw/dt + b w + F(w)

with the voltage D of the contacts and the dry friction F. Speed, inertia and friction are those at
the motor shaft, and the torque constant equals the back-EMF constant by conservation of energy. The
ammeter shows I + I_0, or |I| + I_0 if it shows magnitudes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.model.motor import brush_voltage
from slipid.parameter import Numbers, known, parameter


class BenchMotor(eqx.Module):
    """A brushed DC motor with its load, and zeros and delays of its meters, with weak priors."""

    resistance: Array = parameter(
        "ohm", "R", "winding resistance", start=1.0, lower=0.0, spread=2.0
    )
    back_emf: Array = parameter(
        "V*s/rad", "C_e", "back-EMF, and torque per current", start=0.05, lower=0.0, spread=2.0
    )
    inductance: Array = parameter(
        "H", "L_a", "inductance", start=1e-3, lower=0.0, spread=2.0, closed=True
    )
    brush_drop: Array = parameter(
        "V", "U_b", "voltage drop of the brushes", start=0.1, lower=0.0, spread=2.0, closed=True
    )
    brush_current: Array = parameter(
        "A",
        "I_b",
        "current over which the brushes reach their drop",
        start=0.1,
        lower=0.0,
        spread=1.5,
    )
    brush_shape: Array = parameter(
        "1",
        "kappa",
        "shape of the brush drop over current, from exponential (0) to tanh (1)",
        start=0.5,
        lower=0.0,
        upper=1.0,
        spread=2.0,
    )
    brush_tail: Array = parameter(
        "1",
        "q",
        "part of the brush drop that grows with the logarithm of the current",
        start=0.1,
        lower=0.0,
        upper=1.0,
        spread=1.5,
    )
    resistance_fall: Array = known(
        "1", "k_R", "fall of the resistance from small to large currents", start=0.0, spread=0.3
    )
    fall_current: Array = known(
        "A", "I_f", "current over which the resistance falls", start=1.0, lower=0.0, spread=1.0
    )
    reference_current: Array = known(
        "A", "I_R", "current at which the resistance is given", start=1.0, lower=0.0
    )
    resistance_drift: Array = known(
        "1/s", "h_R", "relative change of the resistance with time", start=0.0, spread=1e-2
    )
    coulomb_friction: Array = parameter(
        "N*m", "tau_c", "friction at the shaft", start=0.005, lower=0.0, spread=3.0, closed=True
    )
    stribeck_friction: Array = parameter(
        "N*m",
        "tau_s",
        "friction at the shaft that ends at speed",
        start=1e-3,
        lower=0.0,
        spread=1.5,
        closed=True,
    )
    stribeck_speed: Array = parameter(
        "rad/s", "w_s", "speed at which that friction ends", start=5.0, lower=0.0, spread=1.0
    )
    viscous_friction: Array = parameter(
        "N*m*s/rad", "b", "friction per shaft speed", start=1e-5, lower=0.0, spread=3.0
    )
    rotor_inertia: Array = parameter(
        "kg*m^2", "J", "rotor and what turns with it", start=1e-5, lower=0.0, spread=3.0
    )
    current_offset: Array = parameter("A", "I_0", "zero of the ammeter", start=0.0, spread=0.2)
    voltage_offset: Array = parameter("V", "U_0", "zero of the voltmeter", start=0.0, spread=1.0)
    voltage_delay: Array = parameter(
        "s", "T_u", "time from a logged voltage to its current", start=0.0, spread=0.02
    )
    speed_delay: Array = parameter(
        "s", "T_w", "time from a logged current to its speed", start=0.0, spread=0.02
    )

    def dry_friction(self, speed: Array) -> Array:
        """Return the size of the dry friction at a shaft speed [N m]."""
        return self.coulomb_friction + self.stribeck_friction * jnp.exp(
            -((speed / self.stribeck_speed) ** 2)
        )

    def contact_voltage(self, size: Numbers, resistance: Numbers) -> tuple[Array, Array]:
        """Return the voltage D of the contacts at the size of a current, and its derivative.

        It is that of the brushes (`brush_voltage`) + R f(I) I with f = `relative_fall`.
        """
        scale, shape, tail = self.brush_current, self.brush_shape, self.brush_tail
        brushes, rise = brush_voltage(size, self.brush_drop, scale, shape, tail)
        fall = self.relative_fall(size)
        bend = self.resistance_fall * jnp.exp(-size / self.fall_current) * size / self.fall_current
        return brushes + resistance * fall * size, rise + resistance * (fall - bend)

    def mean_contact_voltage(self, start: Array, end: Array, resistance: Array) -> Array:
        """Return the mean of sign(I) D(|I|) for a current that changes at a constant rate.

        It is the difference of the antiderivative of D over that of the currents.
        """
        apart = jnp.abs(end - start) > 1e-3 * self.brush_current
        span = jnp.where(apart, end - start, 1.0)
        rise = self._integral(end, resistance) - self._integral(start, resistance)
        middle = (start + end) / 2
        close = jnp.sign(middle) * self.contact_voltage(jnp.abs(middle), resistance)[0]
        return jnp.where(apart, rise / span, close)

    def _integral(self, current: Array, resistance: Array) -> Array:
        """Return the integral of D from current 0 [V A], but for a constant."""
        size, kappa, scale = jnp.abs(current), self.brush_shape, self.brush_current
        quick = scale * (1 + kappa) / kappa * jnp.log1p(kappa * jnp.exp(-size / scale))
        tail = self.brush_tail
        slow = (scale + size) * jnp.log1p(size / scale) - size
        brushes = (1 - tail) * (size + quick) + tail * slow
        given = jnp.exp(-self.reference_current / self.fall_current)
        fall = self.fall_current
        film = -fall * (size + fall) * jnp.exp(-size / fall) - given * size**2 / 2
        return self.brush_drop * brushes + resistance * self.resistance_fall * film

    def relative_fall(self, size: Numbers) -> Array:
        """Return the resistance at the size of a current, relative to the given one, minus 1.

        It is k_R (exp(-I / I_f) - exp(-I_R / I_f)).
        """
        given = jnp.exp(-self.reference_current / self.fall_current)
        return self.resistance_fall * (jnp.exp(-size / self.fall_current) - given)


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

    def mapped(self, of: Callable[[Float[np.ndarray, " row"]], np.ndarray]) -> "BenchRecord":
        """Return the record with a function of the rows of each logged channel."""
        return replace(
            self,
            time=of(self.time),
            voltage=None if self.voltage is None else of(self.voltage),
            current=None if self.current is None else of(self.current),
            speed=of(self.speed),
        )

    def part(self, first: int, end: int) -> "BenchRecord":
        """Return the rows from `first` to before `end`."""
        return self.mapped(lambda x: x[first:end])

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
