"""The robot under a controller's hand: wheel speeds in, sensor readings out, a period at a time."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.data.floor_map import FloorMap
from slipid.testsite.driving import PERIOD, Site
from slipid.testsite.plant import Plant


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
        site: robot, floors and sensors.
        floor: which surface lies where.
        load: name of the load set-up.
        start: x, y [m], heading [rad].
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
        start: tuple[float, float, float],
        seed: int,
        period: float = PERIOD,
    ):
        self.site, self.period = site, period
        self.plant = Plant(
            site.machine, site.motor, site.loop, floor, site.grounds, load, start, seed
        )
        self._rng = np.random.default_rng([seed, 1])
        self._bias = site.sensors.gyro_bias * float(self._rng.normal())
        wheels = len(site.machine.wheel_azimuths_deg)
        self._wheels = self._wanted = np.zeros(wheels)
        self._waiting: list[tuple[float, np.ndarray]] = []
        self._recent = np.zeros((1, 2 * wheels))

    @property
    def pose(self) -> tuple[float, float, float]:
        """True pose [m, m, rad]."""
        return self.plant.pose

    @property
    def power(self) -> float:
        """Electric power of all motors at this moment [W]."""
        drive = self.plant.drive
        return float(np.dot(drive.voltage, drive.current))

    def step(self, command: Float[np.ndarray, " wheel"]) -> Reading:
        """Readings one period later."""
        plant, site = self.plant, self.site
        self._waiting.append((plant.time + site.command_delay_s, np.asarray(command, float)))
        slew = site.acceleration * plant.dt / site.machine.wheel_radius_m
        width = max(1, round(site.sensors.average_s / plant.dt))
        rows = []
        for _ in range(round(self.period / plant.dt)):
            while self._waiting and self._waiting[0][0] <= plant.time + 1e-9:
                self._wanted = self._waiting.pop(0)[1]
            self._wheels = self._wheels + np.clip(self._wanted - self._wheels, -slew, slew)
            plant.step(self._wheels.tolist())
            rows.append([*plant.drive.current, *plant.drive.voltage])
        self._recent = np.array(rows[-width:])
        return self.read()

    def read(self) -> Reading:
        """Readings at this moment."""
        s, rng, motor = self.site.sensors, self._rng, self.site.motor
        tick = 2 * np.pi / (motor.ticks_per_revolution * self.site.machine.gear_ratio)
        amps, volts = np.split(self._recent.mean(axis=0), 2)
        amps = amps + s.current_noise_a * rng.normal(size=amps.shape)
        amps = amps if s.current_is_signed else np.abs(amps)
        volts = volts + s.voltage_noise_v * rng.normal(size=volts.shape)
        turn = float(self.plant.data.qvel[5]) + self._bias + s.gyro_noise * float(rng.normal())
        return Reading(
            wheel_angle=np.floor(self.plant.wheel_angle / tick) * tick,
            current=np.round(amps / s.current_step_a) * s.current_step_a,
            voltage=np.round(volts / s.voltage_step_v) * s.voltage_step_v
            if s.voltage
            else np.full_like(volts, np.nan),
            gyro=turn if s.gyro else float("nan"),
        )
