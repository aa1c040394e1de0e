"""Floor maps as arrays for use in jitted functions."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.ndimage import distance_transform_edt

from slipid.data.floor_map import FloorMap, read_map
from slipid.robot.deployed import DeployedRobot
from slipid.robot.filter.floor import Floor
from slipid.support.errors import DataError


def floor_of(floor: FloorMap, labels: tuple[str, ...]) -> Floor:
    """Convert a map to arrays, with surfaces numbered as in `labels` and -1 for other surfaces."""
    return Floor.of(floor.surfaces, floor.cells, floor.corner, floor.cell, labels)


def floor_map(path: Path | str, robot: DeployedRobot) -> Floor:
    """Return the floor map in a TOML file, in the form that a robot's `Estimator` uses.

    For a robot whose computer has only jax, equinox and numpy, write the map with `Floor.save` and
    read it there with `Floor.load`. Cells with surfaces that were not identified give the estimator
    no information.

    Raises:
        DataError: the file is not a map, or contains none of the robot's surfaces.
    """
    floor = read_map(Path(path))
    if not set(floor.surfaces) & set(robot.labels):
        raise DataError(
            f"{path}: the map has only surfaces that were not identified "
            f"({', '.join(floor.surfaces)}); expected a map with one or more of "
            f"{', '.join(robot.labels)}"
        )
    return floor_of(floor, robot.labels)


class WheelFloors(eqx.Module):
    """Floor under each wheel.

    Attributes:
        surface: index of the surface in the map's list of surfaces.
        border: distance from the middle of the wheel to the nearest other surface [m], accurate to
            half a cell of the map; infinite on a map with a single surface.
        inside: True if the wheel is on the map; outside the map, surface and border are those of
            the nearest cell.
    """

    surface: Int[Array, "*batch wheel"]
    border: Float[Array, "*batch wheel"]
    inside: Bool[Array, "*batch wheel"]


class FloorLookup(eqx.Module):
    """Floor map for jitted functions that look up the floor under each wheel and its border.

    Attributes:
        floor: map whose cells are indices into `surfaces`.
        border: distance from the middle of every cell to the nearest other surface [m].
        surfaces: names of the surfaces.
    """

    floor: Floor
    border: Float[Array, "row column"]
    surfaces: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, floor: FloorMap) -> "FloorLookup":
        """Return the lookup of a floor map."""
        border = np.full(floor.cells.shape, np.inf)
        for number in np.unique(floor.cells):
            on = floor.cells == number
            if not on.all():
                border[on] = (distance_transform_edt(on)[on] - 0.5) * floor.cell
        return cls(floor_of(floor, floor.surfaces), jnp.asarray(border), floor.surfaces)

    @classmethod
    def read(cls, path: Path | str) -> "FloorLookup":
        """Return the lookup of a map file; raise `DataError` if it is not a map."""
        return cls.of(read_map(Path(path)))

    @eqx.filter_jit
    def under(self, pose: Float[Array, "*batch 3"], wheels: Float[Array, "wheel 2"]) -> WheelFloors:
        """Return the floor under each wheel, and the wheel's distance to the border, at each pose.

        Args:
            pose: x, y [m], heading [rad] of the body on the map.
            wheels: positions of the wheels on the body, x ahead, y left [m].
        """
        flat = pose.reshape(-1, 3)
        row, column = jax.vmap(self.floor.steps_to, (0, None))(flat, wheels)
        rows, columns = self.floor.cells.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        row, column = row.clip(0, rows - 1), column.clip(0, columns - 1)
        shape = (*pose.shape[:-1], len(wheels))
        parts = self.floor.cells[row, column], self.border[row, column], inside
        return WheelFloors(*(part.reshape(shape) for part in parts))
