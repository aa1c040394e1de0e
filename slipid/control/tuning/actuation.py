"""How wheels follow their commands and what sensors are like: what no fit tells."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

RING = 6
"""Commands that are kept: a delay may be up to `RING` - 1 periods."""


@dataclass(frozen=True)
class Habits:
    """What no fit tells: how wheels follow and what sensors are like.

    Attributes:
        delay_s: from a command to the wheels [s].
        slew: of the wheels [rad/s^2]; lag_s: of their speed control [s].
        ticks: of an encoder per turn of the wheel.
        ammeter_a: noise of a current [A]; drift_s: how long currents stay off the model's [s].
        voltmeter_v: noise of a voltage [V]; voltage: whether it is measured.
        gyro_noise, gyro_bias: of a yaw rate [rad/s]; gyro: whether it is measured.
        signed: whether currents have signs.
        substeps: of wheels and body in a control period.
        smooth: encoders without ticks.
    """

    delay_s: float = 0.12
    slew: float = 25.0
    lag_s: float = 0.03
    ticks: float = 32000.0
    ammeter_a: float = 0.05
    drift_s: float = 0.1
    voltmeter_v: float = 0.05
    voltage: bool = True
    gyro_noise: float = 0.004
    gyro_bias: float = 0.005
    gyro: bool = False
    signed: bool = False
    substeps: int = 2
    smooth: bool = False


def held(delay: float, period: float, substeps: int) -> Float[np.ndarray, "substep command"]:
    """Share of each of the last commands, the newest first, in the mean over every substep.

    Commands hold for a period and arrive so late; exact, and linear in the delay.
    """
    h = period / substeps
    begin = np.arange(substeps)[:, None] * h - delay
    since = -np.arange(RING)[None, :] * period
    share = np.clip(np.minimum(begin + h, since + period) - np.maximum(begin, since), 0.0, None) / h
    share[:, -1] += 1.0 - share.sum(axis=1)  # what is older counts as the oldest
    return share
