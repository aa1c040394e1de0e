"""What a bench logs of one motor: time, voltage, current and speed, at the shaft."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False, kw_only=True)
class Record:
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
class Noise:
    """Std of what changes from row to row, quantisation included: [V] or None, [A], [rad/s]."""

    voltage: float | None
    current: float
    speed: float


def noise_of(records: Sequence[Record]) -> Noise:
    """Noise of the sensors over all records of a motor."""
    volts = [r.voltage for r in records if r.voltage is not None]
    return Noise(
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
