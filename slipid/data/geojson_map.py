"""Floor maps as polygons in a GeoJSON file, with coordinates in metres instead of degrees.

Parts of the floor in no polygon are unknown; read as a floor map they get the nearest surface.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import Field, FiniteFloat

from slipid.data.floor_map import MOST_CELLS, Colour, FloorMap
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.files import read_json, write_json
from slipid.support.toml_file import Section, checked

SCHEMA = "slipid.map/2"
WHAT = "a floor map (slipid.map/2) that `slipid map` wrote"
DIGITS = 5
"""Decimal places of the written coordinates [m]: they are rounded to 0.01 mm."""
Place = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]
Ring = Annotated[list[Place], Field(min_length=4)]


@dataclass(frozen=True, eq=False)
class Patch:
    """A connected patch of one surface.

    Attributes:
        surface: name of the patch's surface.
        rings: corners x, y [m], the outer ring first, then rings around holes; the last corner does
            not repeat the first.
        area: area of the patch without its holes [m^2].
        confidence: distance from the patch's appearance to that of the second-best surface, in
            multiples of the spread within one surface [1]; None where there is only one surface.
    """

    surface: str
    rings: tuple[Float[np.ndarray, "_ 2"], ...]
    area: float
    confidence: float | None


@dataclass(frozen=True, eq=False)
class VectorMap:
    """Patches of surfaces on a region of the floor.

    Attributes:
        patches: the patches.
        colours: colour `#rrggbb` of each surface, in the order of the floor map.
        low_x, low_y, high_x, high_y: bounds of the region [m].
        cell: edge length of the cells in which patches were detected [m].
        base: the surface that covers most of the floor.
        picture_sha256: SHA-256 hash of the picture file in which the patches were detected.
        unknown: share of the region that no patch covers [1].
        notes: remarks for the reader of the file, one sentence each.
    """

    patches: tuple[Patch, ...]
    colours: dict[str, str]
    low_x: float
    low_y: float
    high_x: float
    high_y: float
    cell: float
    base: str
    picture_sha256: str
    unknown: float
    notes: tuple[str, ...]

    def save(self, path: Path) -> None:
        """Write the map as a GeoJSON file; raise `DataError` where it cannot be written."""
        write_json(path, self.to_json())

    def to_json(self) -> Content:
        """Return a GeoJSON FeatureCollection of the patches, all else under the key `slipid`."""
        about = {
            "schema": SCHEMA,
            "extent_m": [
                round(v, DIGITS) for v in (self.low_x, self.low_y, self.high_x, self.high_y)
            ],
            "cell_m": self.cell,
            "base": self.base,
            "colours": self.colours,
            "picture_sha256": self.picture_sha256,
            "unknown_share": self.unknown,
            "notes": list(self.notes),
        }
        features = [self._feature(patch) for patch in self.patches]
        return {"type": "FeatureCollection", "slipid": about, "features": features}

    def _feature(self, patch: Patch) -> Content:
        closed = [np.concatenate([ring, ring[:1]]).round(DIGITS) for ring in patch.rings]
        return {
            "type": "Feature",
            "properties": {
                "surface": patch.surface,
                "area_m2": patch.area,
                "colour": self.colours[patch.surface],
                "confidence": patch.confidence,
            },
            "geometry": {"type": "Polygon", "coordinates": [ring.tolist() for ring in closed]},
        }


class _Geometry(Section):
    type: Literal["Polygon"]
    coordinates: list[Ring] = Field(min_length=1)


class _Properties(Section):
    surface: str
    area_m2: float = Field(ge=0, allow_inf_nan=False)
    colour: Colour
    confidence: FiniteFloat | None


class _Feature(Section):
    type: Literal["Feature"]
    properties: _Properties
    geometry: _Geometry


class _About(Section):
    schema_: Literal["slipid.map/2"] = Field(alias="schema")
    extent_m: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
    cell_m: float = Field(gt=0, le=1)
    base: str
    colours: dict[str, Colour] = Field(min_length=1)
    picture_sha256: str
    unknown_share: float = Field(ge=0, le=1)
    notes: list[str]


class _GeojsonFile(Section):
    """Content of a GeoJSON map file, as it is checked when read."""

    type: Literal["FeatureCollection"]
    slipid: _About
    features: list[_Feature] = Field(min_length=1)


def read_vector_map(path: Path) -> VectorMap:
    """Return the map of polygons in a GeoJSON file.

    Raises:
        DataError: the file is absent, is not a map that `slipid map` wrote, or has wrong values.
    """
    given = checked(path, read_json(path, WHAT), _GeojsonFile)
    about = given.slipid
    low_x, low_y, high_x, high_y = about.extent_m
    if not (low_x < high_x and low_y < high_y):
        raise DataError(
            f"{path}: extent_m {about.extent_m}; expected lowest x, y, then highest x, y"
        )
    surfaces = {f.properties.surface for f in given.features} | {about.base}
    if missing := sorted(surfaces - set(about.colours)):
        where = "the key 'colours' of its object 'slipid'"
        raise DataError(f"{path}: no colour of {', '.join(missing)}; expected it in {where}")
    patches = tuple(
        Patch(
            feature.properties.surface,
            tuple(np.array(ring, float)[:-1] for ring in feature.geometry.coordinates),
            feature.properties.area_m2,
            feature.properties.confidence,
        )
        for feature in given.features
    )
    return VectorMap(
        patches,
        about.colours,
        *about.extent_m,
        about.cell_m,
        about.base,
        about.picture_sha256,
        about.unknown_share,
        tuple(about.notes),
    )


def in_cells(path: Path, vector_map: VectorMap) -> FloorMap:
    """Return a map of polygons as a map of cells; unknown cells get the nearest surface.

    Args:
        path: file of the map, which errors name.

    Raises:
        DataError: the map has too many cells, or no patch covers any cell.
    """
    from scipy.ndimage import distance_transform_edt

    rows = max(1, round((vector_map.high_y - vector_map.low_y) / vector_map.cell))
    columns = max(1, round((vector_map.high_x - vector_map.low_x) / vector_map.cell))
    if rows * columns > MOST_CELLS:
        raise DataError(f"{path}: {rows * columns} cells; expected at most {MOST_CELLS}")
    names = tuple(vector_map.colours)
    corner = (vector_map.low_x, vector_map.low_y)
    cells = np.full((rows, columns), -1, np.intp)
    for patch in vector_map.patches:
        rings = [(ring - corner) / vector_map.cell for ring in patch.rings]
        cells[covered(rings, rows, columns)] = names.index(patch.surface)
    if (cells < 0).all():
        raise DataError(f"{path}: no polygon lies within extent_m; expected coordinates in metres")
    if (cells < 0).any():
        near = distance_transform_edt(cells < 0, return_distances=False, return_indices=True)
        cells = cells[near[0], near[1]]
    return FloorMap(names, cells, corner, vector_map.cell)


def covered(
    rings: list[Float[np.ndarray, "_ 2"]], rows: int, columns: int
) -> Bool[np.ndarray, "row column"]:
    """Return whether the centre of each cell lies within an odd number of rings.

    Coordinates of the rings count cells: x in columns, y in rows. In each row, every edge of a ring
    flips all cells to its right between outside and inside.
    """
    turns = np.zeros((rows, columns + 1), np.intp)
    for ring in rings:
        for (x, y), (x2, y2) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            row = _rows_between(float(y), float(y2), rows)
            if len(row):
                cross = x + (row + 0.5 - y) * (x2 - x) / (y2 - y)
                turns[row, np.ceil(cross - 0.5).clip(0, columns).astype(np.intp)] += 1
    return np.asarray(np.cumsum(turns[:, :-1], axis=1) % 2 == 1)


def _rows_between(y: float, y2: float, rows: int) -> Int[np.ndarray, " row"]:
    """Return the rows whose centre lies at or above the lower and below the higher of two y."""
    low, high = sorted((y, y2))
    first, last = np.clip([np.ceil(low - 0.5), np.ceil(high - 0.5)], 0, rows)
    return np.arange(int(first), int(last))
