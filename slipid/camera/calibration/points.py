"""Measured points on the floor, read from a CSV file of their pixels and world coordinates."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.camera.csv_rows import csv_rows
from slipid.support.errors import DataError, bad_data, did_you_mean
from slipid.support.quantities import Bounds, Coordinate, limits_of

COLUMNS = ("u", "v", "x", "y")
EXPECTED = "u, v (pixels), x, y (metres) and perhaps z"
"""Columns of a file of points, for messages."""
PIXEL = Bounds(-1e5, 1e5, "pixels")
"""Bounds of a coordinate in an image."""
LEAST_POINTS = 4
"""Smallest number of points that determine the pose of a camera."""
LINE_WIDTH = 0.02
"""Ratio of the points' spread across their main direction to the spread along it, up to which the
points count as lying on one line [1]."""


@dataclass(frozen=True, eq=False)
class FloorPoints:
    """Points in the world, and the pixels at which they appear.

    The world is right-handed with z up: seen from above, y lies to the left of x.

    Attributes:
        names: name of each point.
        pixels: u, v of the points in the image [pixel].
        places: x, y, z of the points in the world [m].
    """

    names: tuple[str, ...]
    pixels: Float[np.ndarray, "point 2"]
    places: Float[np.ndarray, "point 3"]

    def without(self, index: int) -> "FloorPoints":
        """Return all points except the one with this index."""
        return self.only([k for k in range(len(self.names)) if k != index])

    def only(self, kept: list[int]) -> "FloorPoints":
        """Return only the points with these indices."""
        return FloorPoints(tuple(self.names[k] for k in kept), self.pixels[kept], self.places[kept])


def read_points(path: Path, image_px: tuple[int, int]) -> FloorPoints:
    """Return the points in a CSV file with columns u, v [pixel], x, y and optionally z [m].

    Raises:
        DataError: the file is absent, lacks a column, or has a cell that is not a number or a pixel
            outside the image; or the points do not determine the camera's pose.
    """
    rows = [row for row in csv_rows(path, f"a CSV file with columns {EXPECTED}") if any(row[1])]
    if not rows:
        raise DataError(f"{path}: the file is empty; expected columns {EXPECTED}")
    header = [name.lower() for name in rows.pop(0)[1]]
    if missing := [name for name in COLUMNS if name not in header]:
        hint = did_you_mean(missing[0], header)
        raise DataError(
            f"{path}: no column {', '.join(missing)}{hint}; the first line has {', '.join(header)}"
            f"; expected {EXPECTED}"
        )
    names = (*COLUMNS, "z") if "z" in header else COLUMNS
    numbers = [[_number(path, line, row, name, header) for name in names] for line, row in rows]
    values = np.zeros((len(rows), 5))
    values[:, : len(names)] = np.reshape(numbers, (-1, len(names)))
    points = FloorPoints(tuple(f"row {k}" for k, _ in rows), values[:, :2], values[:, 2:])
    for k in np.flatnonzero(((points.pixels < -1) | (points.pixels > image_px)).any(axis=1)):
        u, v = points.pixels[k]
        raise bad_data(
            path,
            f"u = {u:g}, v = {v:g}",
            f"pixels inside the camera's image of {image_px[0]} x {image_px[1]}; if the points "
            "were read off an image of another size, take one at this resolution",
            row=rows[k][0],
        )
    check_spread(path, points)
    return points


def check_spread(source: Path, points: FloorPoints) -> None:
    """Raise `DataError` unless points determine a camera's pose.

    Raises:
        DataError: the points are too few, or lie on one line.
    """
    if len(points.names) < LEAST_POINTS:
        raise DataError(
            f"{source}: {len(points.names)} points; expected {LEAST_POINTS} or more, preferably 8, "
            "all over the floor"
        )
    for where, at in (("on the floor", points.places), ("in the image", points.pixels)):
        spread = np.linalg.svd(at - at.mean(0), compute_uv=False)
        if spread[1] <= LINE_WIDTH * spread[0]:
            raise DataError(
                f"{source}: all {len(points.names)} points lie on one line {where}; expected some "
                "points far from that line"
            )


def _number(path: Path, line: int, row: list[str], name: str, header: list[str]) -> float:
    """Return the number in one cell; raise `DataError` if it is not a finite number."""
    index = header.index(name)
    text = row[index] if index < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    bounds = PIXEL if name in ("u", "v") else limits_of(Coordinate)
    if not bounds.holds(value):
        shown = f"'{text}'" if text else "nothing"
        raise bad_data(path, shown, f"a number {bounds}", row=line, column=name)
    return value
