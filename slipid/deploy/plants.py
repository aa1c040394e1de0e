"""Plants for the closed loop: the virtual test site, and the identified model itself."""

from dataclasses import replace
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
from slipid.testsite.live import Live, Reading
from slipid.testsite.site import Site


class SitePlant:
    """The virtual test site as a `slipid.control.closed_loop.Plant`.

    Args:
        floor: which surface lies where; load: name of the load set-up.
        start: x, y [m], heading [rad].
        seed: of unevenness and noise.
        gyro: whether the robot has one.
    """

    def __init__(
        self, floor: FloorMap, load: str, start: tuple[float, float, float], seed: int, gyro: bool
    ):
        site = Site()
        site = replace(site, sensors=replace(site.sensors, gyro=gyro))
        self._new = partial(Live, site, floor, load, start, seed)
        self._live = self._new()

    @property
    def pose(self) -> tuple[float, float, float]:
        """True pose [m, m, rad]."""
        return self._live.pose

    @property
    def power(self) -> float:
        """Electric power of the motors [W]."""
        return self._live.power

    def reset(self) -> Measurement:
        """First readings, of the robot at rest at its start."""
        self._live = self._new()
        return _measured(self._live.read())

    def step(self, wheel_speed: Float[np.ndarray, " wheel"]) -> Measurement:
        """Readings one period later."""
        return _measured(self._live.step(wheel_speed))


def _measured(reading: Reading) -> Measurement:
    r = reading
    return Measurement(wheel_angle=r.wheel_angle, current=r.current, voltage=r.voltage, gyro=r.gyro)


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
