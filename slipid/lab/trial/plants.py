"""Plants of a trial: the virtual test site, and robots drawn from a posterior."""

from functools import partial

import jax
import numpy as np
from jaxtyping import Float

from slipid.data.floor_map import FloorMap
from slipid.lab.testsite.driving import PERIOD, RimSpeeds
from slipid.lab.testsite.plant import SimulatedRobot
from slipid.lab.testsite.site import Site, SiteSensors
from slipid.lab.testsite.surfaces import SURFACES
from slipid.robot.deployed import DeployedRobot, posterior_robots
from slipid.robot.interface import Measurement
from slipid.support.errors import DataError


def refuse_unknown_to_site(floor: FloorMap, load: str, wheels: int) -> None:
    """Raise `DataError` if the test site lacks a surface or load set-up, or `wheels` differs."""
    robot, other = Site().robot, "Use --plant twin, which simulates the identified model itself"
    has = len(robot.wheel_azimuths_deg)
    if wheels != has:
        raise DataError(f"the test site's robot has {has} wheels, the fit's {wheels}. {other}")
    for what, name, there in (
        ("load set-up", load, robot.centres_m),
        *(("surface", name, SURFACES) for name in floor.surfaces),
    ):
        if name not in there:
            raise DataError(
                f"the test site has no {what} '{name}'; it has {', '.join(there)}. {other}"
            )


class SitePlant:
    """The virtual test site as a plant of `slipid.robot.closed_loop`.

    Commands take effect after the site's delay, and with limited acceleration.

    Args:
        floor: map of the surfaces.
        load: name of the load set-up.
        start: start pose: x, y [m], heading [rad].
        seed: seed of the floor's unevenness, the initial wheel angles and sensor noise.
        gyro: True if the robot has a gyro.
    """

    def __init__(
        self, floor: FloorMap, load: str, start: tuple[float, float, float], seed: int, gyro: bool
    ):
        self._site = Site(sensors=SiteSensors(gyro=gyro))
        self._new, self._seed = partial(SimulatedRobot, self._site, floor, load, start, seed), seed
        self.reset()

    @property
    def pose(self) -> tuple[float, float, float]:
        """True pose [m, m, rad]."""
        return self.plant.pose

    @property
    def power(self) -> float:
        """Total electric power of the motors [W]."""
        drive = self.plant.drive
        return float(np.dot(drive.voltage, drive.current))

    def reset(self) -> Measurement:
        """Put the robot at its start and return its first measurement, at rest."""
        self.plant = self._new()
        self._rims = RimSpeeds(self._site, self.plant)
        self._rng = np.random.default_rng([self._seed, 1])
        self._bias = self._site.sensors.gyro_bias * float(self._rng.normal())
        return self._read(np.zeros((1, 2 * len(self.plant.wheel_dof))))

    def step(self, wheel_speed: Float[np.ndarray, " wheel"]) -> Measurement:
        """Command wheel speeds [rad/s], advance by one period, and return the new measurement."""
        plant, drive, rows = self.plant, self.plant.drive, []
        self._rims.send(np.asarray(wheel_speed, float))
        for _ in range(round(PERIOD / plant.dt)):
            plant.step(self._rims.follow().tolist())
            rows.append([*drive.current, *drive.voltage])
        width = max(1, round(self._site.sensors.average_s / plant.dt))
        return self._read(np.array(rows[-width:]))

    def _read(self, recent: Float[np.ndarray, "step channel"]) -> Measurement:
        """Return a measurement, with currents and voltages averaged over `recent` time steps."""
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


def drawn_robot(robot: DeployedRobot, seed: int) -> DeployedRobot:
    """Return a robot with parameters drawn from the posterior, or unchanged without draws."""
    count = robot.record.drawn
    if count == 0:
        return robot
    picked = int(np.random.default_rng(seed).integers(count))
    return jax.tree.map(lambda x: x[0], posterior_robots(robot, (picked,)))
