"""Plants for the closed loop: the virtual test site, and the identified model itself."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.control.deployed import DeployedRobot
from slipid.control.interface import Measurement
from slipid.control.tuning.actuation import Habits
from slipid.control.tuning.twin import Twin, TwinPlant
from slipid.data.floor_map import FloorMap
from slipid.deploy.trial_site import floor_of
from slipid.testsite.driving import PERIOD, Rims
from slipid.testsite.plant import Plant
from slipid.testsite.site import Sensors, Site


class SitePlant:
    """The virtual test site as a `slipid.control.closed_loop.Plant`, with its delay and slew.

    Args:
        floor: which surface lies where; load: name of the load set-up.
        start: x, y [m], heading [rad].
        seed: of unevenness, the wheels' first angles and noise.
        gyro: whether the robot has one.

    Raises:
        DataError: MuJoCo is missing.
    """

    def __init__(
        self, floor: FloorMap, load: str, start: tuple[float, float, float], seed: int, gyro: bool
    ):
        self._site = Site(sensors=Sensors(gyro=gyro))
        self._new, self._seed = partial(Plant, self._site, floor, load, start, seed), seed
        self.reset()

    @property
    def pose(self) -> tuple[float, float, float]:
        """True pose [m, m, rad]."""
        return self.plant.pose

    @property
    def power(self) -> float:
        """Electric power of the motors [W]."""
        drive = self.plant.drive
        return float(np.dot(drive.voltage, drive.current))

    def reset(self) -> Measurement:
        """First readings, of the robot at rest at its start."""
        self.plant = self._new()
        self._rims = Rims(self._site, self.plant)
        self._rng = np.random.default_rng([self._seed, 1])
        self._bias = self._site.sensors.gyro_bias * float(self._rng.normal())
        return self._read(np.zeros((1, 2 * len(self.plant.wheel_dof))))

    def step(self, wheel_speed: Float[np.ndarray, " wheel"]) -> Measurement:
        """Readings one period later."""
        plant, drive, rows = self.plant, self.plant.drive, []
        self._rims.send(np.asarray(wheel_speed, float))
        for _ in range(round(PERIOD / plant.dt)):
            plant.step(self._rims.follow().tolist())
            rows.append([*drive.current, *drive.voltage])
        width = max(1, round(self._site.sensors.average_s / plant.dt))
        return self._read(np.array(rows[-width:]))

    def _read(self, recent: Float[np.ndarray, "step channel"]) -> Measurement:
        """What the sensors make of the last currents and voltages, and of this moment."""
        s, rng, tick = self._site.sensors, self._rng, self._site.tick
        amps, volts = np.split(recent.mean(axis=0), 2)
        amps, volts = s.amperes(amps, rng), s.volts(volts, rng)
        turn = float(self.plant.data.qvel[5]) + self._bias + s.gyro_noise * float(rng.normal())
        return Measurement(
            wheel_angle=np.floor(self.plant.wheel_angle / tick) * tick,
            current=amps,
            voltage=volts if s.voltage else np.full_like(volts, np.nan),
            gyro=turn if s.gyro else float("nan"),
        )


def twin(
    robot: DeployedRobot,
    floor: FloorMap,
    start: tuple[float, float, float],
    seed: int,
    habits: Habits,
) -> TwinPlant:
    """The identified model itself as a plant, see `slipid.control.tuning.twin`."""
    made = Twin(robot, floor_of(floor, robot.labels), habits)
    return TwinPlant(made, jnp.asarray(start), jax.random.key(seed))
