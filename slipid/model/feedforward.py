"""Feed-forward gains of a motor: the voltage for a wanted speed and acceleration.

    V = kS sgn(w) + kV w + kA dw/dt + kG

At the output of the gear, where w is the speed, the motor has to overcome dry friction tau_c,
friction per speed b and the inertia J of what turns. With its current I = torque / (n eta C_e),

    kS = R I_c + V_b (1 - exp(-|I_c| / I_b))     I_c = tau_c / (n eta C_e)
    kV = n C_e + R b / (n eta C_e)
    kA = R J / (n eta C_e)                       J = J_load + eta n^2 J_m

where the rotor J_m turns n times as fast and its torque does not pass the gear. Intervals are those
of the delta method: the covariance of the numbers, times the derivatives of the gains.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import exp, isfinite, pi
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.model.motor import brush_voltage

Z95 = 1.6448536269514722
"""The 95 % quantile of a standard Gaussian."""
MATTERS = 0.05
"""Smallest share of a number in the variance of a gain at which its verdict counts [1]."""
NEGLIGIBLE = 0.05
"""Part of the std of a gain, relative to the value, up to which it is negligible [1]."""
ELECTRIC = ("resistance", "back_emf")
"""Names of the numbers whose verdicts count however small their parts are."""
ORDER = ("fixed", "identified", "weak", "disputed", "at_bound", "not_identified")
"""Verdicts, the strongest first; a gain has the weakest of the numbers that matter."""
USEFUL = 0.3
"""Largest std of resistance and back-EMF, relative to the value, at which gains are of use [1]."""
LARGEST_EXPONENT = 300.0
"""Largest exponent of the ratio of an interval's end to the value [1]."""


@dataclass(frozen=True)
class Gain:
    """One gain with its uncertainty.

    Attributes:
        value: value [unit].
        unit: unit of the value.
        std: std [unit]; None if it is not known.
        interval90: equal-tailed 90 % interval [unit]; None if it is not known.
        verdict: verdict on its identification, one of `ORDER`.
    """

    value: float
    unit: str
    std: float | None = None
    interval90: tuple[float, float] | None = None
    verdict: str = "fixed"

    @classmethod
    def of(cls, value: float, std: float, unit: str, verdict: str) -> "Gain":
        """Return a gain with the interval of its std, that of a log-normal for a value above 0."""
        if value > 0:
            factor = exp(min(Z95 * std / value, LARGEST_EXPONENT))
            return cls(value, unit, std, (value / factor, value * factor), verdict)
        return cls(value, unit, std, (value - Z95 * std, value + Z95 * std), verdict)

    def per(self, length: float, unit: str) -> "Gain":
        """Return the same gain in another unit, of which one has `length` of the present ones."""
        ends = self.interval90
        return replace(
            self,
            value=length * self.value,
            unit=unit,
            std=None if self.std is None else length * self.std,
            interval90=None if ends is None else (length * ends[0], length * ends[1]),
        )


@dataclass(frozen=True)
class Feedforward:
    """Feed-forward gains of one motor, or of the motors of a robot that moves along one axis.

    Attributes:
        name: motor or axis that the gains belong to, for tables and names in code.
        kS: voltage against dry friction [V].
        kV: voltage per speed.
        kA: voltage per acceleration.
        kG: voltage against gravity; None if the motor does not lift anything [V].
        radius: radius of the wheel on the motor; None without a wheel [m].
    """

    name: str
    kS: Gain
    kV: Gain
    kA: Gain
    kG: Gain | None = None
    radius: float | None = None

    @property
    def gains(self) -> dict[str, Gain]:
        """The gains that there are, keyed by name."""
        found = {"kS": self.kS, "kV": self.kV, "kA": self.kA}
        return found if self.kG is None else {**found, "kG": self.kG}

    def voltage(self, speed: float, acceleration: float) -> float:
        """Return the voltage [V] for a wanted speed [rad/s] and acceleration [rad/s^2].

        At standstill dry friction acts against the acceleration.
        """
        lift = 0.0 if self.kG is None else self.kG.value
        dry = self.kS.value * float(np.sign(speed or acceleration))
        return dry + self.kV.value * speed + self.kA.value * acceleration + lift

    def per_rotation(self) -> "Feedforward":
        """Return the gains per rotation instead of per radian."""
        return self._per(2 * pi, "rot")

    def per_metre(self) -> "Feedforward | None":
        """Return the gains per metre that the rim of the wheel rolls; None without a wheel."""
        return None if self.radius is None else self._per(1 / self.radius, "m")

    def _per(self, length: float, unit: str) -> "Feedforward":
        kV = self.kV.per(length, f"V*s/{unit}")
        return replace(self, kV=kV, kA=self.kA.per(length, f"V*s^2/{unit}"))


class DriveNumbers(NamedTuple):
    """Numbers of a motor and of its load, from which feed-forward gains follow.

    Attributes:
        resistance: R [ohm].
        back_emf: C_e at the shaft [V s/rad].
        coulomb_friction: tau_c at the output of the gear [N m].
        viscous_friction: b at the output of the gear [N m s/rad].
        rotor_inertia: J_m at the shaft [kg m^2].
        load_inertia: J_load at the output of the gear [kg m^2].
        brush_drop: V_b [V].
        brush_current: I_b, over which the drop of the brushes builds up [A].
        brush_shape: kappa, from 0 for an exponential to 1 for a hyperbolic tangent [1].
        brush_tail: q, part of the drop that grows with the logarithm of the current [1].
        efficiency: eta of the gear [1].
        gear_ratio: n, motor speed over the speed at the output of the gear [1].
    """

    resistance: float | Array
    back_emf: float | Array
    coulomb_friction: float | Array
    viscous_friction: float | Array
    rotor_inertia: float | Array
    load_inertia: float | Array = 0.0
    brush_drop: float | Array = 0.0
    brush_current: float | Array = 0.05
    brush_shape: float | Array = 0.0
    brush_tail: float | Array = 0.0
    efficiency: float | Array = 1.0
    gear_ratio: float | Array = 1.0

    def gains(self) -> Float[Array, "3 *draw"]:
        """Return kS [V], kV [V s/rad] and kA [V s^2/rad]."""
        constant = self.gear_ratio * self.efficiency * self.back_emf
        dry = self.coulomb_friction / constant
        brushes = self.brush_drop, self.brush_current, self.brush_shape, self.brush_tail
        drop = brush_voltage(*map(jnp.asarray, (abs(dry), *brushes)))[0]
        rotor = self.efficiency * self.gear_ratio**2 * self.rotor_inertia
        return jnp.stack(
            [
                jnp.asarray(self.resistance * dry + drop),
                jnp.asarray(
                    self.gear_ratio * self.back_emf
                    + self.resistance * self.viscous_friction / constant
                ),
                jnp.asarray(self.resistance * (self.load_inertia + rotor) / constant),
            ]
        )


@dataclass(frozen=True)
class Known:
    """A number that gains are computed from: value and std [its unit], and its verdict."""

    value: float
    std: float = 0.0
    verdict: str = "fixed"

    def times(self, factor: "float | Known") -> "Known":
        """Return the number multiplied by an exact factor, or by an independent number.

        The verdict of a product is that of the number with the larger relative std.
        """
        if not isinstance(factor, Known):
            return replace(self, value=factor * self.value, std=factor * self.std)
        std = float(np.hypot(self.std * factor.value, factor.std * self.value))
        worse = max((self, factor), key=lambda n: n.std / max(abs(n.value), 1e-300))
        return Known(self.value * factor.value, std, worse.verdict)


def useful(resistance: Known, back_emf: Known) -> bool:
    """Return whether a motor is known so well that its feed-forward gains are of use."""
    return all(n.std <= USEFUL * n.value for n in (resistance, back_emf))


def feedforward(
    name: str,
    numbers: Mapping[str, Known],
    correlation: Float[np.ndarray, "number number"] | None = None,
    radius: float | None = None,
) -> Feedforward:
    """Return the gains that follow from the numbers of a motor and its load.

    Args:
        name: name of the gains.
        numbers: numbers keyed by their name in `DriveNumbers`.
        correlation: correlations of the numbers, in their order; None if they are independent.
        radius: radius of the wheel on the motor [m].
    """
    given = list(numbers.values())
    values, slopes = _linearised(tuple(numbers), jnp.asarray([n.value for n in given], float))
    scaled = np.asarray(slopes) * [n.std for n in given]
    r = np.eye(len(given)) if correlation is None else correlation
    stds = np.sqrt(np.maximum(np.einsum("gi,ij,gj->g", scaled, r, scaled), 0.0))
    kS, kV, kA = (
        Gain.of(float(value), float(std), unit, _verdict(float(value), row.tolist(), numbers))
        for value, std, unit, row in zip(
            np.asarray(values), stds, ("V", "V*s/rad", "V*s^2/rad"), scaled, strict=True
        )
    )
    return Feedforward(name, kS, kV, kA, radius=radius)


@partial(jax.jit, static_argnums=0)
def _linearised(names: tuple[str, ...], values: Array) -> tuple[Array, Array]:
    """Return the gains, and their derivatives with respect to the numbers (gain, number)."""

    def of(x: Array) -> Array:
        return DriveNumbers(**dict(zip(names, x, strict=True))).gains()

    return of(values), jax.jacfwd(of)(values)


def _verdict(value: float, parts: Sequence[float], numbers: Mapping[str, Known]) -> str:
    """Return the weakest verdict of the numbers that matter for a gain.

    A number matters if its share in the variance is more than `MATTERS`, unless its part is
    negligible beside the gain; parts of resistance and back-EMF never are, so that a motor of which
    priors alone tell has gains with that verdict.

    Args:
        value: value of the gain.
        parts: std of the gain due to each of the numbers.
        numbers: the numbers.
    """
    squares = np.square(parts)
    whole = float(squares.sum())
    if not isfinite(whole):
        return ORDER[-1]
    mattering = [
        number.verdict
        for (name, number), square in zip(numbers.items(), squares, strict=True)
        if square > MATTERS * whole and (name in ELECTRIC or square > (NEGLIGIBLE * value) ** 2)
    ]
    return max(mattering, key=ORDER.index, default="identified" if whole > 0 else "fixed")
