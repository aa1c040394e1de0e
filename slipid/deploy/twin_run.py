"""Sites, start poses and paths for runs on a robot's twin."""

import jax
import jax.numpy as jnp
import numpy as np

from slipid.data.floor_map import FloorMap, patchwork
from slipid.deploy.floors import floor_of
from slipid.robot import trajectory
from slipid.robot.deployed import DeployedRobot
from slipid.robot.limits import Limits
from slipid.robot.trajectory import Path
from slipid.robot.twin import ActuatorModel, Twin, TwinPlant
from slipid.support.errors import DataError

SITE_SEED, STARTS_SEED = 7, 2021
"""Seeds of the site's patches, and of the start poses."""
REST_S = 5.0
"""Rest before the robot drives, during which the estimator finds the gyro's bias [s]."""


def twin_floor(robot: DeployedRobot) -> FloorMap:
    """Return a map of patches about as large as the robot, on the robot's floors.

    Lengths are multiplied by `path_scale`.

    The floor with the least slip in the fitted runs is drawn twice as often as each other floor.
    With the firm, medium and soft floors of the test site, a robot controlled by encoder odometry
    then travels 80 to 90 % of the path's first side, as on the 2021 paper's site.
    """
    labels, scale = robot.labels, path_scale(robot)
    slip = [float(np.mean(f.seen.slip)) if f.seen is not None else 0.0 for f in robot.record.floors]
    order = [labels[k] for k in np.argsort(slip)]
    names = order if len(order) == 1 else [*order, "more of the first"]
    patches = patchwork(
        names, seed=SITE_SEED, patch=0.35 * scale, half=2.0 * scale, cell=0.005 * scale
    )
    cells = np.where(patches.cells == len(order), 0, patches.cells)
    return FloorMap(tuple(order), cells, patches.corner, patches.cell)


def starts(count: int, floor: FloorMap, path: Path) -> list[tuple[float, float, float]]:
    """Return start poses [m, m, rad] spread over a site, the same poses at every call.

    Headings are evenly spread. The path begins at the start pose, and its middle stays at least
    0.8 m, and half the diagonal of a larger path, inside the site if the site is large enough.
    """
    rng = np.random.default_rng(STARTS_SEED)
    x0, y0, x1, y1 = floor.extent
    middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
    places = np.asarray(path.rows)[:, :2]
    inside = max(0.8, 0.5 * float(np.hypot(*np.ptp(places, axis=0))))
    reach = np.maximum([0.5 * (x1 - x0) - inside, 0.5 * (y1 - y0) - inside], 0.0)
    a, b = (0.5 * (places.min(axis=0) + places.max(axis=0))).tolist()
    out = []
    for k in range(count):
        heading = (k + rng.uniform()) * 2 * np.pi / count - np.pi
        c, s = np.cos(heading), np.sin(heading)
        x, y = middle + reach * rng.uniform(-1.0, 1.0, 2)
        out.append((float(x - (c * a - s * b)), float(y - (s * a + c * b)), float(heading)))
    return out


def require_known_surfaces(floor: FloorMap, robot: DeployedRobot, path: str) -> None:
    """Raise `DataError` if a map, read from `path`, has a surface that was not identified.

    The twin needs the parameters of every surface.
    """
    if absent := [name for name in floor.surfaces if name not in robot.labels]:
        known = ", ".join(robot.labels)
        raise DataError(
            f"{path}: surface '{absent[0]}' was not identified; expected only these surfaces: "
            f"{known}"
        )


def path_scale(robot: DeployedRobot) -> float:
    """Return the factor of the lengths of a robot's paths and site [1].

    It is the base radius over that of the Robotino, for which the paths were chosen, in steps of a
    half, so that a fit's small corrections of the radius leave them as they are; and at least 1.
    """
    return max(1.0, round(2 * float(robot.frame.base) / trajectory.BASE_M) / 2)


def path_of(name: str, speed: float, robot: DeployedRobot, centre: float = 0.0) -> trajectory.Path:
    """Return the path called `name`, which begins at the origin, for a speed [m/s].

    A robot that does not drive sideways gets a path that it can follow: the heading is tangent to
    the path of the point about which it turns, which lies `centre` [m] ahead of its middle, see
    `slipid.deploy.controllers.centre_of`. The rims of its wheels move at about `speed` in turns on
    the spot. Its yaw rate stays within the robot's limit, and its acceleration within half of the
    limit, so that the controller has the other half for corrections. Lengths are multiplied by
    `path_scale`.

    Raises:
        DataError: there is no such path for this robot, or the speed exceeds the robot's limit or
            the highest rim speed of the fitted runs.
    """
    paths = trajectory.PATHS if robot.holonomic else trajectory.SHAPES
    if name not in paths:
        raise DataError(f"no path '{name}' for this robot; expected one of {', '.join(paths)}")
    limits, scale = Limits.of(robot), path_scale(robot)
    most, reason = min(
        (float(robot.highest[0] * robot.frame.radius), "highest rim speed of the fitted runs"),
        (float(limits.speed), "robot's limit"),
    )
    if not 0 < speed <= most:
        raise DataError(
            f"speed {speed:g} m/s; expected a speed above 0 and at most {most:.2g} m/s, the "
            f"{reason}"
        )
    if robot.holonomic:
        return trajectory.PATHS[name](speed, scale)
    yaw_rate = min(speed / (scale * trajectory.BASE_M), float(limits.yaw_rate))
    acceleration = min(0.5, 0.5 * float(limits.acceleration))
    return trajectory.tangent(
        trajectory.SHAPES[name](scale),
        speed,
        acceleration,
        yaw_rate=yaw_rate,
        centre=centre,
    )


def twin_plant(
    robot: DeployedRobot,
    floor: FloorMap,
    start: tuple[float, float, float],
    seed: int,
    actuators: ActuatorModel,
) -> TwinPlant:
    """Return the robot's own identified model as a plant, see `slipid.robot.twin`."""
    model = Twin(robot, floor_of(floor, robot.labels), actuators)
    return TwinPlant(model, jnp.asarray(start), jax.random.key(seed))
