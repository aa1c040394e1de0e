"""Where a trial is driven, patches and starts, and by what: the test site or the model itself."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.control.actuation import Habits
from slipid.control.deployed import DeployedRobot, drawn
from slipid.control.interface import Measurement
from slipid.control.trajectory import Path
from slipid.control.twin import Twin, TwinPlant
from slipid.data.floor_map import FloorMap, patchwork
from slipid.deploy.floors import floor_of
from slipid.support.errors import DataError
from slipid.testsite.driving import PERIOD, Rims
from slipid.testsite.ground import GROUNDS
from slipid.testsite.plant import Plant
from slipid.testsite.site import Sensors, Site

SITE_SEED, STARTS_SEED = 7, 2021


def site(robot: DeployedRobot) -> FloorMap:
    """Patches of about the robot's size, half of them of the floor on which it slips least.

    On the test site's firm, medium and soft floors encoders then travel 80 to 90 % of the first
    side, as on the paper's site.
    """
    labels = robot.labels
    slip = [float(np.mean(f.seen.slip)) if f.seen is not None else 0.0 for f in robot.record.floors]
    order = [labels[k] for k in np.argsort(slip)]
    names = order if len(order) == 1 else [*order, "more of the first"]
    drawn = patchwork(names, seed=SITE_SEED, patch=0.35, half=2.0)
    cells = np.where(drawn.cells == len(order), 0, drawn.cells)
    return FloorMap(tuple(order), cells, drawn.corner, drawn.cell)


def starts(count: int, floor: FloorMap, path: Path) -> list[tuple[float, float, float]]:
    """Poses all over a site in evenly spread headings, the same ones for every controller.

    The middle of the path, which begins at the origin, keeps 0.8 m from the site's edge where there
    is room.
    """
    rng = np.random.default_rng(STARTS_SEED)
    x0, y0, x1, y1 = floor.extent
    middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
    reach = np.maximum([0.5 * (x1 - x0) - 0.8, 0.5 * (y1 - y0) - 0.8], 0.0)
    places = np.asarray(path.rows)[:, :2]
    a, b = (0.5 * (places.min(axis=0) + places.max(axis=0))).tolist()
    out = []
    for k in range(count):
        heading = (k + rng.uniform()) * 2 * np.pi / count - np.pi
        c, s = np.cos(heading), np.sin(heading)
        x, y = middle + reach * rng.uniform(-1.0, 1.0, 2)
        out.append((float(x - (c * a - s * b)), float(y - (s * a + c * b)), float(heading)))
    return out


def known_to_fit(floor: FloorMap, robot: DeployedRobot, path: str) -> None:
    """Refuse a map, from this file, with a surface that the twin of a robot does not have."""
    if absent := [name for name in floor.surfaces if name not in robot.labels]:
        known = ", ".join(robot.labels)
        raise DataError(f"{path}: no surface '{absent[0]}'; identified: {known}")


def known_to_site(floor: FloorMap, load: str, wheels: int) -> None:
    """Refuse wheels, a load set-up or a surface that the virtual test site does not have."""
    machine, other = Site().machine, "With --plant twin the identified model is driven itself"
    has = len(machine.wheel_azimuths_deg)
    if wheels != has:
        raise DataError(f"the test site's robot has {has} wheels, the fit's {wheels}. {other}")
    for what, name, there in (
        ("load set-up", load, machine.centres_m),
        *(("surface", name, GROUNDS) for name in floor.surfaces),
    ):
        if name not in there:
            raise DataError(
                f"the test site has no {what} '{name}'; it has {', '.join(there)}. {other}"
            )


class SitePlant:
    """The virtual test site as a `slipid.control.closed_loop.Plant`, with its delay and slew.

    Args:
        floor: which surface lies where; load: name of the load set-up.
        start: x, y [m], heading [rad].
        seed: of unevenness, the wheels' first angles and noise.
        gyro: whether the robot has one.
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


def one_of(robot: DeployedRobot, seed: int) -> DeployedRobot:
    """A robot that the posterior holds possible; the robot itself where nothing was drawn."""
    count = robot.record.drawn
    if count == 0:
        return robot
    picked = int(np.random.default_rng(seed).integers(count))
    return jax.tree.map(lambda x: x[0], drawn(robot, (picked,)))


def twin(
    robot: DeployedRobot,
    floor: FloorMap,
    start: tuple[float, float, float],
    seed: int,
    habits: Habits,
) -> TwinPlant:
    """The identified model itself as a plant, see `slipid.control.twin`."""
    made = Twin(robot, floor_of(floor, robot.labels), habits)
    return TwinPlant(made, jnp.asarray(start), jax.random.key(seed))
