"""Floor maps, which give the surface at every point of a floor.

A map is made from polygons, from a picture, from a map file or at random.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field

from slipid.support.errors import DataError, refused_as
from slipid.support.extras import require
from slipid.support.files import write_bytes
from slipid.support.quantities import CellLength, Coordinate, InsidePath, Label
from slipid.support.toml_file import Section, checked, mapping_of, text_of

SCHEMA = "slipid.map/1"
Point = tuple[Coordinate, Coordinate]
"""Coordinates x, y [m]."""
Extent = tuple[Coordinate, Coordinate, Coordinate, Coordinate]
"""Lowest x, lowest y, highest x and highest y [m]."""
Colour = Annotated[str, Field(pattern="^#[0-9a-fA-F]{6}$")]
MOST_CELLS = 16_000_000
"""Largest number of cells of one map."""


@dataclass(frozen=True, eq=False)
class FloorMap:
    """Map of a rectangular floor, made of square cells with one surface each.

    Attributes:
        surfaces: names of the surfaces.
        cells: index in `surfaces` of the surface of each cell; the first row of cells has the
            lowest y.
        corner: x, y of the corner with the lowest coordinates [m].
        cell: edge length of a cell [m].
    """

    surfaces: tuple[str, ...]
    cells: Int[np.ndarray, "row column"]
    corner: tuple[float, float]
    cell: float

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Lowest x, lowest y, highest x and highest y of the floor [m]."""
        rows, columns = self.cells.shape
        x, y = self.corner
        return x, y, x + columns * self.cell, y + rows * self.cell

    def at(self, xy: Float[np.ndarray, "*batch 2"]) -> Int[np.ndarray, "*batch"]:
        """Return the index in `surfaces` of the surface at each point x, y [m].

        A point outside the map has the surface of the nearest cell at the edge of the map.
        """
        steps = np.floor((np.asarray(xy) - self.corner) / self.cell).astype(np.intp)
        rows, columns = self.cells.shape
        row, column = steps[..., 1].clip(0, rows - 1), steps[..., 0].clip(0, columns - 1)
        return np.asarray(self.cells[row, column])


def uniform(surface: str, half: float = 2.0) -> FloorMap:
    """Return a square map of a single surface, whose edges are `2 * half` long [m]."""
    return FloorMap((surface,), np.zeros((1, 1), np.intp), (-half, -half), 2 * half)


def from_polygons(
    base: str,
    patches: Sequence[tuple[str, Sequence[Sequence[float]]]],
    extent: tuple[float, float, float, float],
    cell: float = 0.005,
) -> FloorMap:
    """Return the map of patches on a base surface, later patches on top of earlier ones.

    Args:
        base: surface where there is no patch.
        patches: name of the surface and corners (x, y) [m] of each patch.
        extent: lowest x, lowest y, highest x, highest y [m].
        cell: edge length of a cell [m].

    Raises:
        ValueError: more than `MOST_CELLS` cells.
    """
    _require_matplotlib()
    from matplotlib.path import Path as Outline

    surfaces = tuple(dict.fromkeys([base, *(name for name, _ in patches)]))
    columns, rows = (max(1, round((extent[2 + k] - extent[k]) / cell)) for k in range(2))
    _few(rows * columns)
    x = extent[0] + (np.arange(columns) + 0.5) * cell
    y = extent[1] + (np.arange(rows) + 0.5) * cell
    centres = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    cells = np.zeros(len(centres), np.intp)
    for name, corners in patches:
        cells[Outline(np.asarray(corners, float)).contains_points(centres)] = surfaces.index(name)
    return FloorMap(surfaces, cells.reshape(rows, columns), (extent[0], extent[1]), cell)


def patchwork(
    surfaces: Sequence[str], seed: int, patch: float = 0.25, half: float = 1.2, cell: float = 0.005
) -> FloorMap:
    """Return a random floor whose patches are the Voronoi cells of a jittered grid of points.

    By default the patches are smaller than a Robotino, so that its wheels stand on several patches
    at once.

    Args:
        surfaces: names of the surfaces, one of which is drawn at random for each patch.
        seed: seed of the jitter and of the choice of surfaces.
        patch: mean distance between neighbouring patches [m].
        half: half of the floor's edge length [m].
        cell: edge length of a cell [m].

    Raises:
        ValueError: too many cells or patches.
    """
    from scipy.spatial import KDTree

    _few(round(2 * half / cell) ** 2)
    count = int(np.ceil(2 * half / patch)) + 2
    if count > 500:
        raise ValueError(f"{count} x {count} patches; expected at most 500 x 500")
    rng = np.random.default_rng(seed)
    grid = (np.arange(count) - 0.5 * (count - 1)) * patch
    seeds = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
    seeds = seeds + rng.uniform(-0.35, 0.35, seeds.shape) * patch
    surface = rng.integers(len(surfaces), size=len(seeds))
    x = np.arange(-half + 0.5 * cell, half, cell)
    centres = np.stack(np.meshgrid(x, x), -1)
    cells = surface[KDTree(seeds).query(centres)[1]]
    return FloorMap(tuple(surfaces), cells, (-half, -half), cell)


def four_zones(surfaces: Sequence[str], middle: tuple[float, float] = (0.45, -0.2)) -> FloorMap:
    """Return the map of four surfaces that meet in a point.

    By default this point is the centre of the rectangle that the robot drives in the 2021 paper
    (see docs/theory.md).

    Args:
        surfaces: surfaces of the quarters with low x and high y, high x and high y, high x and low
            y, and low x and low y.
        middle: x, y of the point where the surfaces meet [m]; every zone is a square with edges of
            1.2 m.
    """
    reach, cell = 1.2, 0.005
    names = tuple(dict.fromkeys(surfaces))
    a, b, c, d = (names.index(surface) for surface in surfaces)
    zone = np.ones((round(reach / cell), round(reach / cell)), np.intp)
    cells = np.kron([[d, c], [a, b]], zone)
    return FloorMap(names, cells, (middle[0] - reach, middle[1] - reach), cell)


def _require_matplotlib() -> None:
    require("matplotlib", "report", "a floor map")


def _few(cells: int) -> None:
    """Raise `ValueError` if a map would have more than `MOST_CELLS` cells."""
    if cells > MOST_CELLS:
        raise ValueError(
            f"{cells} cells; expected at most {MOST_CELLS}; use larger cells or a smaller floor"
        )


class PatchTable(Section):
    """One `[[patch]]` table of a map file: a polygon of one surface on top of the base."""

    surface: Label
    polygon: list[Point] = Field(min_length=3)


class PatchedFile(Section):
    """Map file of patches on a base surface, later patches on top of earlier ones.

    `extent_m` is the lowest x, lowest y, highest x and highest y [m].
    """

    schema_: Literal["slipid.map/1"] = Field(alias="schema")
    base: Label
    extent_m: Extent
    cell_m: CellLength = 0.005
    patch: list[PatchTable] = Field(default_factory=list)


class PicturedFile(Section):
    """Map file with a picture of the floor from above, whose lower left corner is at `corner_m`."""

    schema_: Literal["slipid.map/1"] = Field(alias="schema")
    picture: InsidePath
    colours: dict[Label, Colour] = Field(min_length=1)
    metres_per_pixel: CellLength
    corner_m: Point = (0.0, 0.0)


def read_map(path: Path) -> FloorMap:
    """Return the map in a TOML file, or in a `.geojson` file that `slipid map` wrote.

    A TOML file has either `base`, `extent_m` and `[[patch]]`, or `picture` and `[colours]`.

    Raises:
        DataError: the file is unreadable, has unknown or missing keys, or wrong values.
    """
    if path.suffix.lower() == ".geojson":
        from slipid.data.geojson_map import read_polygons

        return read_polygons(path)
    mapping = mapping_of(path, text_of(path, "a floor map"))
    try:
        if "picture" in mapping:
            return _pictured(path, checked(path, mapping, PicturedFile))
        given = checked(path, mapping, PatchedFile)
        x0, y0, x1, y1 = given.extent_m
        if not (x0 < x1 and y0 < y1):
            raise DataError(
                f"{path}: extent_m {given.extent_m}; expected lowest x, lowest y, highest x, "
                "highest y"
            )
        patches = [(patch.surface, patch.polygon) for patch in given.patch]
        return from_polygons(given.base, patches, given.extent_m, given.cell_m)
    except DataError:
        raise
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error


def picture_of(path: Path) -> Path | None:
    """Return the path of the picture that a map file refers to, None if there is no such file."""
    if path.suffix.lower() == ".geojson":
        return None
    named = mapping_of(path, text_of(path, "a floor map")).get("picture")
    found = _beside(path, named) if isinstance(named, str) else path.parent
    return found if os.path.isfile(found) else None


def _beside(path: Path, picture: str) -> Path:
    """Return the path of a map's picture; a copied map has a copy of its picture beside it."""
    named = path.parent / picture
    return named if os.path.isfile(named) else path.parent / named.name


def write_map(path: Path, floor: FloorMap, colours: Mapping[str, str]) -> None:
    """Write a map as a TOML file, and its picture as a PNG file of the same name beside it.

    `colours` has a different colour `#rrggbb` for each surface.
    """
    _require_matplotlib()
    from matplotlib.colors import to_rgb
    from matplotlib.image import imsave

    table = np.array([to_rgb(colours[name]) for name in floor.surfaces])
    if len(np.unique(table, axis=0)) < len(table):
        raise ValueError(
            f"surfaces with the same colour: {dict(colours)}; expected a different colour for "
            "each surface"
        )
    picture = BytesIO()
    imsave(picture, table[floor.cells[::-1]], format="png")
    write_bytes(path.with_suffix(".png"), picture.getvalue())
    lines = [
        f'schema = "{SCHEMA}"',
        f'picture = "{path.with_suffix(".png").name}"',
        f"metres_per_pixel = {floor.cell}",
        f"corner_m = [{floor.corner[0]}, {floor.corner[1]}]",
        "",
        "[colours]",
        *(f'"{name}" = "{colours[name]}"' for name in floor.surfaces),
    ]
    write_bytes(path, ("\n".join(lines) + "\n").encode())


def _pictured(path: Path, given: PicturedFile) -> FloorMap:
    """Return the map in a picture: each pixel is a cell with the surface of the nearest colour."""
    _require_matplotlib()
    from matplotlib.colors import to_rgb
    from matplotlib.image import imread
    from PIL import Image

    source = _beside(path, given.picture)
    with refused_as(f"{path}: picture {source}", "a PNG or JPEG"):
        with Image.open(source) as opened:  # which reads the size, and no pixels yet
            width, height = opened.size
        if width * height > MOST_CELLS:
            raise DataError(
                f"{path}: picture {source}: {width} x {height} pixels; expected at most "
                f"{MOST_CELLS} pixels"
            )
        picture = np.asarray(imread(source), float)
    if picture.ndim == 2:  # a grey picture has no axis of colours
        picture = np.repeat(picture[..., None], 3, axis=2)
    picture = picture[..., :3] if picture.max() <= 1 else picture[..., :3] / 255
    cells, least = np.zeros((height, width), np.intp), np.full((height, width), np.inf)
    for k, colour in enumerate(given.colours.values()):
        distance = np.linalg.norm(picture - to_rgb(colour), axis=-1)
        cells[distance < least] = k
        least = np.minimum(distance, least)
    cells = cells[::-1].copy()
    return FloorMap(tuple(given.colours), cells, given.corner_m, given.metres_per_pixel)
