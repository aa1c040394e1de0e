"""Where a trial is driven: patches of the robot's floors, starts all over them."""

import jax.numpy as jnp
import numpy as np

from slipid.control.deployed import DeployedRobot
from slipid.control.tuning.twin import Floor
from slipid.data.floor_map import FloorMap, patchwork
from slipid.support.errors import DataError

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


def starts(
    count: int, floor: FloorMap, sides: tuple[float, float] = (0.9, 0.4)
) -> list[tuple[float, float, float]]:
    """Poses all over a site in evenly spread headings, the same ones for every controller.

    Args:
        count: how many.
        floor: the site; the rectangle's middle keeps 0.8 m from its edge where there is room.
        sides: of the rectangle [m].
    """
    rng = np.random.default_rng(STARTS_SEED)
    x0, y0, x1, y1 = floor.extent
    middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
    reach = np.maximum([0.5 * (x1 - x0) - 0.8, 0.5 * (y1 - y0) - 0.8], 0.0)
    out = []
    for k in range(count):
        heading = (k + rng.uniform()) * 2 * np.pi / count - np.pi
        c, s = np.cos(heading), np.sin(heading)
        x, y = middle + reach * rng.uniform(-1.0, 1.0, 2)
        a, b = 0.5 * sides[0], 0.5 * sides[1]
        out.append((float(x - (c * a + s * b)), float(y - (s * a - c * b)), float(heading)))
    return out


def known_to_site(floor: FloorMap, load: str, wheels: int) -> None:
    """Refuse a trial that the virtual test site cannot drive.

    Raises:
        DataError: another number of wheels, a load set-up or a surface that it does not have.
    """
    from slipid.testsite.ground import GROUNDS
    from slipid.testsite.site import Site

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


def floor_of(floor: FloorMap, labels: tuple[str, ...]) -> Floor:
    """A map as arrays, its surfaces counted as the fit counts them."""
    index = np.array([labels.index(name) for name in floor.surfaces])
    return Floor(
        cells=jnp.asarray(index[floor.cells]),
        corner=jnp.asarray(floor.corner),
        cell=jnp.asarray(floor.cell),
    )
