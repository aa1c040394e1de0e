"""The map made from a picture: outlines in metres, colours, and warnings about its quality."""

import hashlib
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from slipid.camera.floor.grid import DetectedRobot, Rectified
from slipid.camera.floor.light import Features, code_of_linear
from slipid.camera.floor.outline import PatchOutline, outlines_of, signed_area
from slipid.camera.floor.region import FloorPicture, FloorRegion, Palette
from slipid.camera.floor.surfaces import UNKNOWN, Costs, Surfaces
from slipid.camera.frame_source import is_picture
from slipid.camera.opencv import Labels, Mask
from slipid.data.geojson_map import MapRegion, Patch, VectorMap
from slipid.support.content import Content
from slipid.support.errors import DataError

HARDLY, NOT = 5.0, 3.5
"""Differences of appearance below which two surfaces are hardly distinguishable, and below which
they are indistinguishable [spreads within a surface].

If one surface is given two names, the two differ by about 3.2: each takes one half of the noise.
"""
MOST_UNKNOWN = 1 / 3
"""Largest share of the requested floor that may be unknown in a good map [1]."""
MOST_NAMED = 3
"""Number of patches of low confidence that are reported one by one, the largest first."""
WEAK = 1.0
"""Confidence below which a patch is reported [spreads within a surface], see `_patch`."""
TOLERANCE = 0.6
"""Largest distance of an outline from the cell edges that it replaces [cells]."""


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Surface of each cell, cost of every surface in each cell, and appearance of the surfaces."""

    labels: Labels
    costs: Costs
    surfaces: Surfaces


@dataclass(frozen=True, eq=False)
class PictureMap:
    """A map of the floor made from a picture.

    Attributes:
        vector: the map as polygons.
        floor: the picture projected onto the floor.
        labels: surface of each cell, in the order of its colours; -1 is unknown.
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
        """Return the share of the known floor that surface number `k` covers [1]."""
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
            "surfaces": surfaces,
            "filled_share": self.vector.region.unknown_share,
            "robots": [{"marker": r.marker, "place_m": [r.x, r.y]} for r in self.robots],
            "notes": self.vector.region.notes,
            "warnings": list(self.warnings),
            "poor": list(self.poor),
        }


def map_from(
    source: FloorPicture,
    region: FloorRegion,
    features: Features,
    names: tuple[str, ...],
    palette: Palette,
    segmentation: Segmentation,
) -> PictureMap:
    """Return the map of segmented cells, with outlines, colours and warnings.

    Args:
        source: the picture and its camera.
        region: the part of the floor that is mapped.
        features: features of every cell.
        names: names of the surfaces by number.
        palette: the config, whose colours the map keeps.
        segmentation: surface of each cell.

    Raises:
        DataError: no cell resembles any surface.
    """
    present = [k for k in range(len(names)) if (segmentation.labels == k).any()]
    if not present:
        raise DataError(f"{source.path}: no cell looks like a surface; expected a floor")
    number = np.full(len(names) + 1, UNKNOWN)
    number[present] = np.arange(len(present))
    labels = number[segmentation.labels]  # label UNKNOWN, -1, picks the last entry
    kept = tuple(names[k] for k in present)
    colours = {
        name: palette.palette.get(
            name, code_of_linear(np.median(features.rgb[labels == k], axis=0))
        )
        for k, name in enumerate(kept)
    }
    costs = segmentation.costs[present]
    patches = tuple(_patch(one, region, kept, costs) for one in outlines_of(labels, TOLERANCE))
    vector = _vector(source, region, labels, patches, colours)
    poor = _similar(segmentation.surfaces, names, present, 0.0, NOT)
    warnings = _similar(segmentation.surfaces, names, present, NOT, HARDLY)
    unknown = _unknown_share(labels, region.requested)
    if unknown > MOST_UNKNOWN:
        poor.append(
            f"{100 * unknown:.0f} % of the requested floor is unknown; expected at most "
            f"{100 * MOST_UNKNOWN:.0f} %: a region that holds nothing but floor, and points on "
            "every surface"
        )
    if not region.robots and is_picture(source.path):  # the median of a video shows no moving robot
        warnings.append(
            "no marker of a robot was detected, so none is masked; where one stands, mask it in "
            "the config, or name the --dictionary of its marker"
        )
    warnings += _weak_patches(vector)
    return PictureMap(
        vector, region.floor, labels, region.robots, tuple(warnings), tuple(poor), None
    )


def _similar(
    surfaces: Surfaces, names: tuple[str, ...], present: list[int], low: float, high: float
) -> list[str]:
    """Return sentences about pairs of surfaces whose appearances differ by `low` to `high` spreads.

    The difference is the median over the picture, relative to the spread within a surface.
    """
    appearances = surfaces.appearances((24, 24)).reshape(len(names), -1, 4)
    sentences = []
    for one, other in combinations(present, 2):
        spread = np.maximum(surfaces.spread[one], surfaces.spread[other])
        difference = float(
            np.median(np.linalg.norm((appearances[one] - appearances[other]) / spread, axis=1))
        )
        if low <= difference < high:
            sentences.append(
                f"{names[one]} and {names[other]} {'cannot' if high <= NOT else 'can hardly'} be "
                f"distinguished: they differ by {difference:.1f} spreads of one surface; mark more "
                "points on them, or give them one name"
            )
    return sentences


def _unknown_share(labels: Labels, requested: Mask) -> float:
    """Return the share of the requested cells whose surface is unknown [1]."""
    return float((labels[requested] < 0).mean())


def _patch(one: PatchOutline, region: FloorRegion, names: tuple[str, ...], costs: Costs) -> Patch:
    """Return a patch in metres, the outer ring anticlockwise and holes clockwise.

    A cell's appearance has a distance to each surface [spreads within the surface]. The patch's
    confidence is the median over its cells of the distance to the next best surface less that to
    its own surface; it is None if there is no other surface.
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
    source: FloorPicture,
    region: FloorRegion,
    labels: Labels,
    patches: tuple[Patch, ...],
    colours: dict[str, str],
) -> VectorMap:
    """Return the map in the form of its file."""
    extent = region.floor.grid.extent
    most = int(np.argmax(np.bincount(labels[labels >= 0])))
    unknown, notes = float((labels < 0).mean()), []
    if unknown > 0:
        requested = _unknown_share(labels, region.requested)
        notes.append(
            f"{100 * unknown:.1f} % of the map's rectangle is unknown ({100 * requested:.1f} % of "
            "the requested floor): read as a floor map it has the nearest surface there"
        )
    with source.path.open("rb") as file:  # not read at once: a video may exceed memory
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    map_region = MapRegion(
        extent_m=(extent.low_x, extent.low_y, extent.high_x, extent.high_y),
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
    weak = [p for p in vector.patches if p.confidence is not None and p.confidence < WEAK]
    sentences = []
    for patch in weak[:MOST_NAMED]:
        x, y = patch.rings[0].mean(axis=0)
        sentences.append(
            f"the patch of {patch.surface} around x {x:.2f} m, y {y:.2f} m ({patch.area:.3g} m^2) "
            f"looks almost as much like another surface ({patch.confidence:.1f} spreads)"
        )
    if rest := weak[MOST_NAMED:]:
        area = sum(patch.area for patch in rest)
        sentences.append(f"so do {len(rest)} smaller patches ({area:.3g} m^2)")
    return sentences
