"""The robot under a controller's hand: wheel speeds in, sensor readings out, a period at a time."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.data.floor_map import FloorMap
from slipid.testsite.driving import PERIOD, Rims
from slipid.testsite.ground import Pose
from slipid.testsite.plant import Plant
from slipid.testsite.site import Site


@dataclass(frozen=True, eq=False)
class Reading:
    """What the sensors say at one instant.

    Attributes:
        wheel_angle: whole ticks [rad]; current: as the ammeters give it [A]; voltage: [V], NaN
            where it is not measured; gyro: yaw rate [rad/s], NaN where there is none.
    """

    wheel_angle: Float[np.ndarray, " wheel"]
    current: Float[np.ndarray, " wheel"]
    voltage: Float[np.ndarray, " wheel"]
    gyro: float


class Live:
    """A robot on a floor, driven by wheel speed commands with the site's delay and slew.

    Args:
        load: name of the load set-up.
        seed: seed of the floor's unevenness, the wheels' first angles and the sensors' noise.
        period: between commands [s].

    Raises:
        DataError: MuJoCo is missing, or a surface has no physics.
    """

    def __init__(
        self,
        site: Site,
        floor: FloorMap,
        load: str,
        start: Pose,
        seed: int,
        period: float = PERIOD,
    ):
        self.site, self.period = site, period
        self.plant = Plant(site, floor, load, start, seed)
        self._rims = Rims(site, self.plant)
        self._rng = np.random.default_rng([seed, 1])
        self._bias = site.sensors.gyro_bias * float(self._rng.normal())
        self._recent = np.zeros((1, 2 * len(site.machine.wheel_azimuths_deg)))

    @property
    def pose(self) -> Pose:
        """True pose [m, m, rad]."""
        return self.plant.pose

    @property
    def power(self) -> float:
        """Electric power of all motors at this moment [W]."""
        drive = self.plant.drive
        return float(np.dot(drive.voltage, drive.current))

    def step(self, command: Float[np.ndarray, " wheel"]) -> Reading:
        """Readings one period later."""
        plant = self.plant
        self._rims.send(np.asarray(command, float))
        width = max(1, round(self.site.sensors.average_s / plant.dt))
        rows = []
        for _ in range(round(self.period / plant.dt)):
            plant.step(self._rims.follow().tolist())
            rows.append([*plant.drive.current, *plant.drive.voltage])
        self._recent = np.array(rows[-width:])
        return self.read()

    def read(self) -> Reading:
        """Readings at this moment."""
        s, rng, tick = self.site.sensors, self._rng, self.site.tick
        amps, volts = np.split(self._recent.mean(axis=0), 2)
        amps, volts = s.amperes(amps, rng), s.volts(volts, rng)
        turn = float(self.plant.data.qvel[5]) + self._bias + s.gyro_noise * float(rng.normal())
        return Reading(
            wheel_angle=np.floor(self.plant.wheel_angle / tick) * tick,
            current=amps,
            voltage=volts if s.voltage else np.full_like(volts, np.nan),
            gyro=turn if s.gyro else float("nan"),
        )
