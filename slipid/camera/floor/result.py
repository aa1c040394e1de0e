"""The map made from an image: outlines in metres, colours, and warnings about its quality."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from slipid.camera.floor.grid import DetectedRobot, Rectified
from slipid.camera.floor.light import code_of_linear
from slipid.camera.floor.outline import PatchOutline, outlines_of, signed_area
from slipid.camera.floor.region import FloorRegion
from slipid.camera.floor.surfaces import UNKNOWN, Costs, Surfaces
from slipid.camera.opencv import Labels
from slipid.camera.picture_file import is_picture
from slipid.data.geojson_map import MapRegion, Patch, VectorMap
from slipid.support.content import Content
from slipid.support.errors import DataError

SCHEMA = "slipid.map_result/1"
HARDLY_DISTINCT, NOT_DISTINCT = 5.0, 3.5
"""Differences of appearance below which two surfaces are reported as hard to distinguish, and as
indistinguishable [spreads within a surface].

If one surface is given two names, the two named surfaces differ by about 3.2, since each gets one
half of the surface's spread of colours.
"""
MOST_UNKNOWN = 1 / 3
"""Largest fraction of the requested floor that may be unknown in a good map [1]."""
MOST_NAMED = 3
"""Number of patches with low confidence that are reported one by one, the largest first; smaller
ones are only counted."""
WEAK_CONFIDENCE = 1.0
"""Confidence below which a patch is reported [spreads within a surface], see `_patch`."""
OUTLINE_TOLERANCE = 0.6
"""Largest distance of a patch's outline from the cell edges that it replaces [cells]."""


@dataclass(frozen=True, eq=False)
class PictureMap:
    """A map of the floor made from an image.

    Attributes:
        vector: the map as polygons.
        floor: the image projected onto the floor.
        labels: surface of each cell, as an index into the colours of `vector`; -1 is unknown.
        robots: robots that hid a part of the floor.
        warnings: sentences about reasons for which the map is less certain.
        poor: sentences about reasons for which the map is bad.
        proposal: text of a config that specifies the same surfaces; None if a config was given.
    """

    vector: VectorMap
    floor: Rectified
    labels: Labels
    robots: tuple[DetectedRobot, ...]
    warnings: tuple[str, ...]
    poor: tuple[str, ...]
    proposal: str | None

    def share(self, k: int) -> float:
        """Return the fraction of the known floor that the surface with index `k` covers [1]."""
        return float((self.labels == k).sum() / max(1, int((self.labels >= 0).sum())))

    def to_json(self) -> Content:
        """Return the results for programs, without the polygons."""
        surfaces = []
        for k, (name, colour) in enumerate(self.vector.region.colours.items()):
            own = [patch for patch in self.vector.patches if patch.surface == name]
            confidence = [patch.confidence for patch in own if patch.confidence is not None]
            surfaces.append(
                {
                    "surface": name,
                    "colour": colour,
                    "share": self.share(k),
                    "area_m2": sum(patch.area for patch in own),
                    "patches": len(own),
                    "confidence": min(confidence, default=None),
                }
            )
        return {
            "schema": SCHEMA,
            "surfaces": surfaces,
            "filled_share": self.vector.region.unknown_share,
            "robots": [{"marker": r.marker, "place_m": [r.x, r.y]} for r in self.robots],
            "notes": self.vector.region.notes,
            "warnings": list(self.warnings),
            "poor": list(self.poor),
        }


def map_from(
    region: FloorRegion, names: tuple[str, ...], surfaces: Surfaces, costs: Costs, labels: Labels
) -> PictureMap:
    """Return the map of segmented cells, with outlines, colours and warnings.

    Args:
        region: the part of the floor that is mapped; colours in its config are kept in the map.
        names: names of the surfaces by number.
        surfaces: appearance of the surfaces.
        costs: cost of every surface in each cell.
        labels: surface of each cell.

    Raises:
        DataError: no cell resembles any surface.
    """
    source, features = region.source, region.features
    present = [k for k in range(len(names)) if (labels == k).any()]
    if not present:
        raise DataError(
            f"{source.path}: no cell resembles any surface; expected an image of a floor with the "
            "surfaces of the config"
        )
    number = np.full(len(names) + 1, UNKNOWN)
    number[present] = np.arange(len(present))
    labels = number[labels]  # UNKNOWN is -1 and so picks the last element of `number`, UNKNOWN
    seen = [np.median(features.rgb[labels == k], axis=0) for k in range(len(present))]
    colours = {names[k]: code_of_linear(rgb) for k, rgb in zip(present, seen, strict=True)}
    colours |= {name: source.palette.palette.get(name, seen) for name, seen in colours.items()}
    outlines = outlines_of(labels, OUTLINE_TOLERANCE)
    patches = tuple(_patch(one, region, list(colours), costs[present]) for one in outlines)
    vector = _vector(region, labels, patches, colours)
    poor, warnings = _similar(surfaces, names, present)
    unknown = float((labels[region.requested] < 0).mean())
    if unknown > MOST_UNKNOWN:
        poor.append(
            f"{100 * unknown:.0f} % of the requested floor is unknown; expected at most "
            f"{100 * MOST_UNKNOWN:.0f} %: limit the region to floor, and mark points on every "
            "surface"
        )
    # warn only for single images, since the median of a video shows no moving robot
    if not region.robots and is_picture(source.path):
        warnings.append(
            "no robot's marker was detected, so no robot is masked; if the image shows a robot, "
            "mask it in the config, or give the --dictionary of its marker"
        )
    warnings += _weak_patches(vector)
    return PictureMap(
        vector, region.floor, labels, region.robots, tuple(warnings), tuple(poor), None
    )


def _similar(
    surfaces: Surfaces, names: tuple[str, ...], present: list[int]
) -> tuple[list[str], list[str]]:
    """Return sentences about pairs of surfaces that are hard or impossible to distinguish.

    The difference of appearances is the median over the image, relative to the spread within a
    surface.
    """
    appearances = surfaces.appearances((24, 24)).reshape(len(names), -1, 4)
    cannot, hardly = [], []
    for one, other in combinations(present, 2):
        spread = np.maximum(surfaces.spread[one], surfaces.spread[other])
        away = np.linalg.norm((appearances[one] - appearances[other]) / spread, axis=1)
        difference = float(np.median(away))
        about = (
            f"be distinguished: they differ by {difference:.1f} times the spread within a surface; "
            "mark more points on them, or give them the same name"
        )
        if difference < NOT_DISTINCT:
            cannot.append(f"{names[one]} and {names[other]} cannot {about}")
        elif difference < HARDLY_DISTINCT:
            hardly.append(f"{names[one]} and {names[other]} cannot easily {about}")
    return cannot, hardly


def _patch(one: PatchOutline, region: FloorRegion, names: Sequence[str], costs: Costs) -> Patch:
    """Return a patch in metres, the outer ring anticlockwise and holes clockwise.

    A cell's appearance has a distance to each surface, in spreads within that surface. The patch's
    confidence is the distance to the nearest other surface less the distance to the patch's own
    surface, as a median over the patch's cells; it is None if there is no other surface.
    """
    rings = []
    for k, ring in enumerate(one.rings):
        oriented = ring if (signed_area(ring) > 0) == (k == 0) else ring[::-1]
        rings.append(region.floor.grid.places(oriented))
    confidence = None
    if len(costs) > 1:
        distance = np.sqrt(np.maximum(costs[:, one.cells], 0))
        others = np.delete(distance, one.label, axis=0).min(axis=0)
        confidence = float(np.median(others - distance[one.label]))
    return Patch(names[one.label], tuple(rings), sum(map(signed_area, rings)), confidence)


def _vector(
    region: FloorRegion, labels: Labels, patches: tuple[Patch, ...], colours: dict[str, str]
) -> VectorMap:
    """Return the map as polygons with their region, as the map's file stores it."""
    most = int(np.argmax(np.bincount(labels[labels >= 0])))
    unknown, notes = float((labels < 0).mean()), []
    if unknown > 0:
        requested = (labels[region.requested] < 0).mean()
        notes.append(
            f"{100 * unknown:.1f} % of the map's rectangle is unknown ({100 * requested:.1f} % of "
            "the requested floor); when this file is used as a floor map, unknown floor gets the "
            "nearest surface"
        )
    # hash the file piece by piece, since a video may exceed memory
    with region.source.path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    map_region = MapRegion(
        extent_m=region.floor.grid.extent,
        cell_m=region.floor.grid.cell,
        base=list(colours)[most],
        colours=colours,
        picture_sha256=sha256,
        unknown_share=unknown,
        notes=notes,
    )
    return VectorMap(patches, map_region)


def _weak_patches(vector: VectorMap) -> list[str]:
    """Return sentences about patches that resemble another surface almost as well as their own."""
    weak = [
        p for p in vector.patches if p.confidence is not None and p.confidence < WEAK_CONFIDENCE
    ]
    sentences = []
    for patch in weak[:MOST_NAMED]:
        x, y = patch.rings[0].mean(axis=0)
        sentences.append(
            f"the patch of {patch.surface} around x {x:.2f} m, y {y:.2f} m ({patch.area:.3g} m^2) "
            "looks almost as much like another surface (difference of "
            f"{patch.confidence:.1f} spreads within a surface)"
        )
    if rest := weak[MOST_NAMED:]:
        area = sum(patch.area for patch in rest)
        sentences.append(
            f"{len(rest)} smaller patches ({area:.3g} m^2) also look almost as much like another "
            "surface"
        )
    return sentences
