"""How wheels follow their commands and what sensors are like: what no fit tells."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.robot.closed_loop import PERIOD

RING = 6
"""Commands that are kept: a delay may be up to `RING` - 1 periods."""


@dataclass(frozen=True)
class ActuatorModel:
    """How wheels follow their commands and what sensors are like.

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

    @property
    def substep(self) -> float:
        """How long it takes [s]."""
        return PERIOD / self.substeps

    @property
    def follow(self) -> float:
        """Part of the gap to its set speed that a wheel makes up in a substep."""
        return 1 - float(np.exp(-self.substep / max(self.lag_s, 1e-6)))

    def held(self) -> Float[np.ndarray, "substep command"]:
        """Share of each of the last commands, the newest first, in the mean over every substep.

        Commands hold for a period and arrive so late; exact, and linear in the delay.
        """
        h = self.substep
        begin = np.arange(self.substeps)[:, None] * h - self.delay_s
        since = -np.arange(RING)[None, :] * PERIOD
        both = np.minimum(begin + h, since + PERIOD) - np.maximum(begin, since)
        share = np.clip(both, 0.0, None) / h
        share[:, -1] += 1.0 - share.sum(axis=1)  # what is older counts as the oldest
        return share
