"""Measured points on the floor, read from a CSV file of their places in world and picture."""

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.support.errors import DataError, bad_data, did_you_mean

COLUMNS = ("u", "v", "x", "y")
LEAST_POINTS = 4
LINE = 0.02
"""Ratio of the points' spread across their main direction to that along it, below which they count
as lying on one line [1]."""


@dataclass(frozen=True, eq=False)
class FloorPoints:
    """Places in the world, and the pixels at which they appear.

    The world is right-handed with z up: seen from above, y lies to the left of x.

    Attributes:
        names: name of each point.
        pixels: places of the points in the picture [pixel].
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
        DataError: the file is absent, lacks a column, has a cell that is not a number or a pixel
            outside the picture; or the points do not determine the camera's place.
    """
    header, rows = _table(path)
    names = (*COLUMNS, "z") if "z" in header else COLUMNS
    if missing := [name for name in COLUMNS if name not in header]:
        hint = did_you_mean(missing[0], header)
        raise DataError(
            f"{path}: no column {', '.join(missing)}{hint}; the first line has {', '.join(header)}"
            "; expected u, v (pixels), x, y (metres) and perhaps z"
        )
    values = np.array(
        [[_number(path, line, row, name, header) for name in names] for line, row in rows]
    ).reshape(-1, len(names))
    _inside(path, [line for line, _ in rows], values[:, :2], image_px)
    height = values[:, 4:] if "z" in names else np.zeros((len(values), 1))
    places = np.concatenate([values[:, 2:4], height], axis=1)
    points = FloorPoints(tuple(f"row {line}" for line, _ in rows), values[:, :2], places)
    check_spread(path, points)
    return points


def check_spread(source: Path, points: FloorPoints) -> None:
    """Raise `DataError` unless points determine a camera's place.

    Raises:
        DataError: the points are too few, or lie on one line.
    """
    if len(points.names) < LEAST_POINTS:
        raise DataError(
            f"{source}: {len(points.names)} points; expected {LEAST_POINTS} or more, better 8, all "
            "over the floor"
        )
    for where, at in (("on the floor", points.places), ("in the picture", points.pixels)):
        spread = np.linalg.svd(at - at.mean(0), compute_uv=False)
        if spread[1] <= LINE * spread[0]:
            raise DataError(
                f"{source}: all {len(points.names)} points lie on one line {where}; expected some "
                "well beside it"
            )


def _table(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the names of the columns, and the rows, each with its line number in the file."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; expected a CSV file of points") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: no UTF-8 text; expected a CSV file of points") from error
    if not text.strip():
        raise DataError(f"{path}: the file is empty; expected columns u, v, x, y")
    first = next((t for t in text.splitlines() if t.strip() and t[0] != "#"), "")
    delimiter = max(",;\t", key=first.count)
    lines = enumerate(csv.reader(io.StringIO(text), delimiter=delimiter), 1)
    rows = [(n, [cell.strip() for cell in row]) for n, row in lines]
    rows = [(n, row) for n, row in rows if any(row) and not row[0].startswith("#")]
    return [name.lower() for name in rows[0][1]] if rows else [], rows[1:]


def _number(path: Path, line: int, row: list[str], name: str, header: list[str]) -> float:
    """Return the number in one cell; raise `DataError` if it is not a finite number."""
    index = header.index(name)
    text = row[index] if index < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        shown = f"'{text}'" if text else "nothing"
        raise bad_data(path, shown, "a number", row=line, column=name)
    return value


def _inside(
    path: Path, lines: list[int], pixels: Float[np.ndarray, "point 2"], image_px: tuple[int, int]
) -> None:
    """Raise `DataError` unless all pixels lie inside the picture."""
    for line, (u, v) in zip(lines, pixels, strict=True):
        if not (-1 <= u <= image_px[0] and -1 <= v <= image_px[1]):
            raise bad_data(
                path,
                f"u = {u:g}, v = {v:g}",
                f"pixels inside the camera's picture of {image_px[0]} x {image_px[1]}; if the "
                "points were read off another picture, take one at the same resolution",
                row=line,
            )
