"""Floor maps as polygons in a GeoJSON file, with coordinates in metres instead of degrees.

The surface outside all polygons is unknown; when the file is read, every cell there gets the
surface of the nearest polygon.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field

from slipid.data.floor_map import MOST_CELLS, Colour, Extent, FloorMap
from slipid.support.content import Content
from slipid.support.errors import bad_data
from slipid.support.files import read_json, write_json
from slipid.support.quantities import Bounds, CellLength, Coordinate, Label, Number
from slipid.support.toml_file import Section, checked

EXPECTED = "a floor map (slipid.map/2) that `slipid map` wrote"
DIGITS = 5
"""Decimal places of the written coordinates [m]: they are rounded to 0.01 mm."""
Place = Annotated[list[Coordinate], Field(min_length=2, max_length=2)]
Ring = Annotated[list[Place], Field(min_length=4)]


@dataclass(frozen=True, eq=False)
class Patch:
    """A connected patch of one surface.

    Attributes:
        surface: name of the patch's surface.
        rings: corners x, y of each ring [m]: the outer ring first, then the rings around holes; the
            last corner of a ring does not repeat its first corner.
        area: area of the patch without its holes [m^2].
        confidence: distance from the patch's appearance to that of the second-best surface, in
            multiples of the spread within one surface [1]; None where there is only one surface.
    """

    surface: str
    rings: tuple[Float[np.ndarray, "_ 2"], ...]
    area: float
    confidence: float | None


class MapRegion(Section):
    """Content of the object `slipid` of a map file: everything except the patches.

    Attributes:
        schema_: schema of the file.
        extent_m: lowest x, lowest y, highest x and highest y of the region [m].
        cell_m: edge length of the cells in which patches were detected [m].
        base: the surface that covers most of the floor.
        colours: colour `#rrggbb` of each surface, in the order of the floor map.
        picture_sha256: SHA-256 hash of the picture file in which the patches were detected.
        unknown_share: fraction of the region that no patch covers [1].
        notes: remarks for the reader of the file, one sentence each.
    """

    schema_: Literal["slipid.map/2"] = Field(default="slipid.map/2", alias="schema")
    extent_m: Extent
    cell_m: CellLength
    base: Label
    colours: dict[Label, Colour] = Field(min_length=1)
    picture_sha256: str
    unknown_share: Annotated[float, Bounds(0, 1)]
    notes: list[str]


@dataclass(frozen=True, eq=False)
class VectorMap:
    """Patches of surfaces on a region of the floor."""

    patches: tuple[Patch, ...]
    region: MapRegion

    def save(self, path: Path) -> None:
        """Write the map as a GeoJSON file; raise `DataError` if it cannot be written."""
        write_json(path, self.to_json())

    def to_json(self) -> Content:
        """Return a GeoJSON FeatureCollection of the patches, with the region under `slipid`."""
        region = self.region.model_dump(mode="json", by_alias=True)
        region["extent_m"] = [round(bound, DIGITS) for bound in self.region.extent_m]
        features = [self._feature(patch) for patch in self.patches]
        return {"type": "FeatureCollection", "slipid": region, "features": features}

    def _feature(self, patch: Patch) -> Content:
        closed = [np.concatenate([ring, ring[:1]]).round(DIGITS) for ring in patch.rings]
        return {
            "type": "Feature",
            "properties": {
                "surface": patch.surface,
                "area_m2": patch.area,
                "colour": self.region.colours[patch.surface],
                "confidence": patch.confidence,
            },
            "geometry": {"type": "Polygon", "coordinates": [ring.tolist() for ring in closed]},
        }


class _Geometry(Section):
    type: Literal["Polygon"]
    coordinates: list[Ring] = Field(min_length=1)


class _Properties(Section):
    surface: Label
    area_m2: Annotated[float, Bounds(0, 1e16, "m^2")]
    colour: Colour
    confidence: Number | None


class _Feature(Section):
    type: Literal["Feature"]
    properties: _Properties
    geometry: _Geometry


class _GeojsonFile(Section):
    """Schema of a GeoJSON map file, against which files are checked."""

    type: Literal["FeatureCollection"]
    slipid: MapRegion
    features: list[_Feature] = Field(min_length=1)


def read_polygons(path: Path) -> FloorMap:
    """Return the map in a GeoJSON file as cells; unknown cells get the nearest surface.

    Raises:
        DataError: the file is absent, is not a map that `slipid map` wrote, or has wrong values;
            the map has too many cells, or no patch covers any cell.
    """
    from scipy.ndimage import distance_transform_edt

    given = checked(path, read_json(path, EXPECTED), _GeojsonFile)
    region = given.slipid
    low_x, low_y, high_x, high_y = region.extent_m
    if not (low_x < high_x and low_y < high_y):
        expected = "lowest x, lowest y, highest x, highest y"
        raise bad_data(path, f"extent_m {region.extent_m}", expected)
    names = tuple(region.colours)
    surfaces = {feature.properties.surface for feature in given.features} | {region.base}
    if missing := sorted(surfaces - {*names}):
        where = "the key 'colours' of the object 'slipid'"
        raise bad_data(path, f"no colour of {', '.join(missing)}", f"every surface in {where}")
    rows = max(1, round((high_y - low_y) / region.cell_m))
    columns = max(1, round((high_x - low_x) / region.cell_m))
    if rows * columns > MOST_CELLS:
        raise bad_data(path, f"{rows * columns} cells", f"at most {MOST_CELLS}")
    cells = np.full((rows, columns), -1, np.intp)
    for k, feature in enumerate(given.features, start=1):
        if any(ring[0] != ring[-1] for ring in feature.geometry.coordinates):
            expected = "the first corner as the last, in every ring of GeoJSON"
            raise bad_data(path, f"features[{k}]: a ring that is not closed", expected)
        corners = (np.array(ring, float)[:-1] for ring in feature.geometry.coordinates)
        rings = [(ring - (low_x, low_y)) / region.cell_m for ring in corners]
        cells[covered(rings, rows, columns)] = names.index(feature.properties.surface)
    if (cells < 0).all():
        raise bad_data(path, "no polygon lies within extent_m", "coordinates in metres")
    if (cells < 0).any():
        near = distance_transform_edt(cells < 0, return_distances=False, return_indices=True)
        cells = cells[near[0], near[1]]
    return FloorMap(names, cells, (low_x, low_y), region.cell_m)


def covered(
    rings: list[Float[np.ndarray, "_ 2"]], rows: int, columns: int
) -> Bool[np.ndarray, "row column"]:
    """Return whether the centre of each cell lies within an odd number of rings.

    Coordinates of the rings are in cells: x in columns, y in rows. In each row, every edge of a
    ring switches all cells to its right between outside and inside.
    """
    turns = np.zeros((rows, columns + 1), np.intp)
    for ring in rings:
        for (x, y), (x2, y2) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            # The edge crosses the rows whose centres lie between its lower end (included) and its
            # upper end (excluded), so that a corner shared by two edges counts once.
            first, last = np.clip(np.ceil(np.sort([y, y2]) - 0.5), 0, rows).astype(int)
            if first < last:
                row = np.arange(first, last)
                cross = x + (row + 0.5 - y) * (x2 - x) / (y2 - y)
                turns[row, np.ceil(cross - 0.5).clip(0, columns).astype(np.intp)] += 1
    return np.asarray(np.cumsum(turns[:, :-1], axis=1) % 2 == 1)
