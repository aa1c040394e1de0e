"""Measured and simulated signals of a fitted motor over time, for figures."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.infer.bench.fit import MotorFit


@dataclass(frozen=True, eq=False)
class FittedSignal:
    """One channel of all records, one after the other.

    Attributes:
        channel: `current` or `speed`.
        unit: unit of the channel.
        time: time of each row, with records placed one after the other [s].
        measured, fitted: measured and simulated readings [unit].
        speed, current: simulated speed [rad/s] and current [A].
        weight: weight of each row's residual.
        scale: scale of the residuals [unit].
    """

    channel: str
    unit: str
    time: Float[np.ndarray, " row"]
    measured: Float[np.ndarray, " row"]
    fitted: Float[np.ndarray, " row"]
    speed: Float[np.ndarray, " row"]
    current: Float[np.ndarray, " row"]
    weight: Float[np.ndarray, " row"]
    scale: float

    @property
    def residual(self) -> Float[np.ndarray, " row"]:
        """Measured less simulated readings [unit]."""
        return self.measured - self.fitted


def fitted_signals(fit: MotorFit) -> tuple[FittedSignal, ...]:
    """Return the simulated channels of a motor that were logged."""
    rows, at = fit.rows, fit.fit.at
    used = rows.used
    ends = [float(rows.time[rows.record == k].max()) for k in range(int(rows.record.max()) + 1)]
    time = (rows.time + np.concatenate([[0.0], np.cumsum(ends)])[rows.record])[used]
    current, speed = at.states[..., 0][used], at.states[..., 1][used]
    channels = [("current", "A", rows.current), ("speed", "rad/s", rows.speed)]
    return tuple(
        FittedSignal(
            channel=channel,
            unit=unit,
            time=time,
            measured=measured[used],
            fitted=at.readings[k][used],
            speed=speed,
            current=current,
            weight=fit.fit.weights[k][used],
            scale=float(fit.fit.scales[k]),
        )
        for k, (channel, unit, measured) in enumerate(channels)
        if channel == "speed" or (rows.has_current and fit.has_voltage)
    )
