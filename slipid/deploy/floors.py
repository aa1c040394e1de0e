"""From a map of floors, as a file or as cells, to what an estimator looks up."""

from pathlib import Path

from slipid.control.deployed import DeployedRobot
from slipid.control.filter.floor import Floor
from slipid.data.floor_map import FloorMap, read_map
from slipid.support.errors import DataError


def floor_of(floor: FloorMap, labels: tuple[str, ...]) -> Floor:
    """A map as arrays, its surfaces counted as the fit counts them, -1 for one it does not know."""
    return Floor.of(floor.surfaces, floor.cells, floor.corner, floor.cell, labels)


def floor_map(path: Path | str, robot: DeployedRobot) -> Floor:
    """The floor map of a TOML file, as `Estimator` takes it for a robot.

    `Floor.save` writes it for a robot that has jax alone, whose `Floor.load` reads it. Cells of
    surfaces that the robot does not know tell it nothing.

    Raises:
        DataError: no map, or one that has none of the robot's surfaces.
    """
    read = read_map(Path(path))
    if not set(read.surfaces) & set(robot.labels):
        raise DataError(
            f"{path}: surfaces {', '.join(read.surfaces)}; expected some of those identified: "
            f"{', '.join(robot.labels)}"
        )
    return floor_of(read, robot.labels)
