"""Floor maps as polygons in a GeoJSON file, in metres of the floor instead of degrees.

Cells in no polygon are not known: read as a floor map they have the nearest surface.
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
"""Of coordinates after the point: a hundredth of a millimetre."""
Place = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]
Ring = Annotated[list[Place], Field(min_length=4)]


@dataclass(frozen=True, eq=False)
class Patch:
    """A connected patch of one surface.

    Attributes:
        rings: corners [m], the first around it, others around holes; the last corner is not the
            first again.
        area: less its holes [m^2].
        confidence: how much worse the next best surface explains its look, in spreads of the
            looks of one surface; None where there is no other.
    """

    surface: str
    rings: tuple[Float[np.ndarray, "_ 2"], ...]
    area: float
    confidence: float | None


@dataclass(frozen=True, eq=False)
class VectorMap:
    """Patches of surfaces on a part of the floor.

    Attributes:
        colours: of the surfaces, `#rrggbb`, in the order of the floor map.
        low_x, low_y, high_x, high_y: the part of the floor [m].
        cell: edge of the cells they were found in [m].
        base: the surface of most of the floor.
        picture_sha256: of the file that shows it.
        unknown: share of the part that no patch covers.
        notes: what a reader must know.
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
        """Write the map; DataError where nothing can be written."""
        write_json(path, self.to_json())

    def to_json(self) -> Content:
        """A FeatureCollection, with what is no feature under `slipid`."""
        about = {
            "schema": SCHEMA,
            "extent_m": [round(v, DIGITS) for v in self._corners()],
            "cell_m": self.cell,
            "base": self.base,
            "colours": self.colours,
            "picture_sha256": self.picture_sha256,
            "unknown_share": self.unknown,
            "notes": list(self.notes),
        }
        features = [self._feature(patch) for patch in self.patches]
        return {"type": "FeatureCollection", "slipid": about, "features": features}

    def _corners(self) -> tuple[float, float, float, float]:
        return self.low_x, self.low_y, self.high_x, self.high_y

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


class _File(Section):
    """The file as it stands."""

    type: Literal["FeatureCollection"]
    slipid: _About
    features: list[_Feature] = Field(min_length=1)


def read_vector_map(path: Path) -> VectorMap:
    """The polygons of a GeoJSON file.

    Raises:
        DataError: absent, no such map, or a map that is none.
    """
    given = checked(path, read_json(path, WHAT), _File)
    about = given.slipid
    low_x, low_y, high_x, high_y = about.extent_m
    if not (low_x < high_x and low_y < high_y):
        raise DataError(
            f"{path}: extent_m {about.extent_m}; expected lowest x, y, then highest x, y"
        )
    lost = {f.properties.surface for f in given.features} | {about.base}
    if strange := sorted(lost - set(about.colours)):
        raise DataError(f"{path}: no colour of {', '.join(strange)}; expected it in slipid.colours")
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


def in_cells(path: Path, found: VectorMap) -> FloorMap:
    """The map in cells, of the nearest surface where none is known.

    Raises:
        DataError: too many cells, or a map whose patches cover none.
    """
    from scipy.ndimage import distance_transform_edt

    rows = max(1, round((found.high_y - found.low_y) / found.cell))
    columns = max(1, round((found.high_x - found.low_x) / found.cell))
    if rows * columns > MOST_CELLS:
        raise DataError(f"{path}: {rows * columns} cells; expected at most {MOST_CELLS}")
    names = tuple(found.colours)
    corner = (found.low_x, found.low_y)
    cells = np.full((rows, columns), -1, np.intp)
    for patch in found.patches:
        rings = [(ring - corner) / found.cell for ring in patch.rings]
        cells[covered(rings, rows, columns)] = names.index(patch.surface)
    if (cells < 0).all():
        raise DataError(f"{path}: no polygon lies within extent_m; expected coordinates in metres")
    if (cells < 0).any():
        near = distance_transform_edt(cells < 0, return_distances=False, return_indices=True)
        cells = cells[near[0], near[1]]
    return FloorMap(names, cells, corner, found.cell)


def covered(
    rings: list[Float[np.ndarray, "_ 2"]], rows: int, columns: int
) -> Bool[np.ndarray, "row column"]:
    """Cells whose middle lies within an odd number of rings of columns and rows.

    In each row every edge turns the cells to its right from outside to inside or back.
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
    """Rows whose middle lies between two heights, the lower one included."""
    low, high = sorted((y, y2))
    first, last = np.clip([np.ceil(low - 0.5), np.ceil(high - 0.5)], 0, rows)
    return np.arange(int(first), int(last))
