"""How far a map can be trusted: what is told apart, and how well.

The map that was found: outlines in metres, colours, and how far it can be trusted.
"""

import hashlib
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int

from slipid.camera.floor.asked import Asked, Source
from slipid.camera.floor.colour import UNKNOWN, Features, code_of_light
from slipid.camera.floor.grid import Rectified, Seen
from slipid.camera.floor.outline import Outlined, area, outlined
from slipid.camera.floor.palette import Palette, ProposedSurface, palette_text
from slipid.camera.floor.proposal import Proposal
from slipid.camera.floor.surfaces import Surfaces
from slipid.camera.frames.still import is_picture
from slipid.data.geojson_map import Patch, VectorMap
from slipid.support.content import Content
from slipid.support.errors import DataError

HARDLY, NOT = 5.0, 3.5
"""Surfaces whose looks differ by less are hardly told apart, or not at all [spreads].

One surface under two names comes out at about 3.2: each name takes one side of its noise.
"""
MOST_UNKNOWN = 1 / 3
"""Of the floor that was asked for."""


@dataclass(frozen=True)
class Pair:
    """Two surfaces that look much alike.

    Attributes:
        apart: how far their looks differ, in the middle of the picture's places [spreads].
    """

    one: str
    other: str
    apart: float

    @property
    def separable(self) -> bool:
        return self.apart >= NOT

    def said(self) -> str:
        how = "are hardly told apart" if self.separable else "are not told apart"
        return (
            f"{self.one} and {self.other} {how}: their looks differ by {self.apart:.1f} spreads "
            "of one surface; mark more points on them, or give them one name"
        )


def alike(surfaces: Surfaces, names: tuple[str, ...]) -> tuple[Pair, ...]:
    """Pairs of surfaces that are hardly told apart."""
    looks = surfaces.looks((24, 24)).reshape(len(names), -1, 4)
    found = []
    for k, other in combinations(range(len(names)), 2):
        spread = np.maximum(surfaces.spread[k], surfaces.spread[other])
        apart = np.linalg.norm((looks[k] - looks[other]) / spread, axis=1)
        pair = Pair(names[k], names[other], float(np.median(apart)))
        if pair.apart < HARDLY:
            found.append(pair)
    return tuple(found)


def margin(
    costs: Float32[np.ndarray, "surface row column"],
    cells: Bool[np.ndarray, "row column"],
    own: int,
) -> float | None:
    """How much worse the next best surface explains a patch than its own [spreads].

    The median over its cells of the difference of distances; None where there is no other.
    """
    if len(costs) < 2:
        return None
    off = np.sqrt(np.maximum(costs[:, cells], 0))
    others = np.delete(off, own, axis=0).min(axis=0)
    return float(np.median(others - off[own]))


def verdict(
    pairs: tuple[Pair, ...],
    labels: Int[np.ndarray, "row column"],
    wanted: Bool[np.ndarray, "row column"],
) -> tuple[str, ...]:
    """Why a map is poor; nothing where it is good."""
    poor = [pair.said() for pair in pairs if not pair.separable]
    unknown = unknown_share(labels, wanted)
    if unknown > MOST_UNKNOWN:
        poor.append(
            f"{100 * unknown:.0f} % of the floor that was asked for is unknown; expected at most "
            f"{100 * MOST_UNKNOWN:.0f} %: a region without what is no floor, points on every "
            "surface"
        )
    return tuple(poor)


def unknown_share(
    labels: Int[np.ndarray, "row column"], wanted: Bool[np.ndarray, "row column"]
) -> float:
    """Of the cells that were asked for."""
    return float((labels[wanted] < 0).mean())


MOST_NAMED = 3
"""Of weak patches, the largest."""
WEAK = 1.0
"""Confidence below which a patch is named [spreads]."""
TOLERANCE = 0.6
"""How far an outline may be from the edges of cells [cells]."""


@dataclass(frozen=True, eq=False)
class Told:
    """Which surface each cell has, and how well each explains it."""

    labels: Int[np.ndarray, "row column"]
    costs: Float32[np.ndarray, "surface row column"]
    surfaces: Surfaces


@dataclass(frozen=True, eq=False)
class FoundMap:
    """A map, and what it was made of.

    Attributes:
        vector: polygons.
        floor: the picture laid onto the floor.
        labels: surface of each cell, in the order of the colours of `vector`; -1 is unknown.
        robots: that hid a part of it.
        warnings: what makes it less certain; poor: what makes it bad.
        proposal: a config that finds the same surfaces; None where one was given.
    """

    vector: VectorMap
    floor: Rectified
    labels: Int[np.ndarray, "row column"]
    robots: tuple[Seen, ...]
    warnings: tuple[str, ...]
    poor: tuple[str, ...]
    proposal: str | None

    def to_json(self) -> Content:
        """What programs want to know, without the polygons."""
        total = max(1, int((self.labels >= 0).sum()))
        return {
            "surfaces": [
                {
                    "surface": name,
                    "colour": colour,
                    "share": float((self.labels == k).sum() / total),
                    "area_m2": sum(p.area for p in self.vector.patches if p.surface == name),
                    "patches": sum(p.surface == name for p in self.vector.patches),
                    "confidence": _least(self.vector, name),
                }
                for k, (name, colour) in enumerate(self.vector.colours.items())
            ],
            "filled_share": self.vector.unknown,
            "robots": [{"marker": r.marker, "place_m": [r.x, r.y]} for r in self.robots],
            "notes": list(self.vector.notes),
            "warnings": list(self.warnings),
            "poor": list(self.poor),
        }


def _least(vector: VectorMap, name: str) -> float | None:
    """Confidence of the least certain patch of a surface."""
    given = [p.confidence for p in vector.patches if p.surface == name and p.confidence is not None]
    return min(given, default=None)


def made(
    source: Source,
    ask: Asked,
    found: Features,
    names: tuple[str, ...],
    palette: Palette,
    told: Told,
) -> FoundMap:
    """Outlines, colours and how far they can be trusted."""
    there = [k for k in range(len(names)) if (told.labels == k).any()]
    number = np.full(len(names) + 1, UNKNOWN)
    number[there] = np.arange(len(there))
    labels = number[told.labels]  # UNKNOWN is the last
    kept = tuple(names[k] for k in there)
    if not kept:
        raise DataError(f"{source.path}: no cell looks like a surface; expected a floor")
    colours = {
        name: palette.palette.get(name, code_of_light(np.median(found.light[labels == k], axis=0)))
        for k, name in enumerate(kept)
    }
    patches = tuple(
        _patch(one, ask, kept, told.costs[there]) for one in outlined(labels, TOLERANCE)
    )
    pairs = tuple(
        pair for pair in alike(told.surfaces, names) if {pair.one, pair.other} <= set(kept)
    )
    poor = verdict(pairs, labels, ask.wanted)
    vector = _vector(source, ask, labels, patches, colours)
    warnings = _warnings(ask, source.path, pairs, vector)
    return FoundMap(vector, ask.floor, labels, ask.robots, warnings, poor, None)


def _patch(
    one: Outlined,
    ask: Asked,
    names: tuple[str, ...],
    costs: Float32[np.ndarray, "surface row column"],
) -> Patch:
    """A patch in metres, the outer ring anticlockwise and holes clockwise."""
    rings = []
    for k, ring in enumerate(one.rings):
        way = ring if (area(ring) > 0) == (k == 0) else ring[::-1]
        rings.append(ask.floor.grid.places(way))
    size = sum(area(ring) for ring in rings)
    return Patch(names[one.label], tuple(rings), size, margin(costs, one.cells, one.label))


def _vector(
    source: Source,
    ask: Asked,
    labels: Int[np.ndarray, "row column"],
    patches: tuple[Patch, ...],
    colours: dict[str, str],
) -> VectorMap:
    """The map as a file has it."""
    grid = ask.floor.grid
    extent = grid.extent
    most = int(np.argmax(np.bincount(labels[labels >= 0])))
    unknown = float((labels < 0).mean())
    wanted = unknown_share(labels, ask.wanted)
    notes = []
    if unknown > 0:
        notes.append(
            f"{100 * unknown:.1f} % of the map's rectangle is unknown ({100 * wanted:.1f} % of the "
            "floor that was asked for): read as a floor map it has the nearest surface there"
        )
    return VectorMap(
        patches,
        colours,
        *(extent.low_x, extent.low_y, extent.high_x, extent.high_y),
        grid.cell,
        list(colours)[most],
        _sha256(source.path),
        unknown,
        tuple(notes),
    )


def _sha256(path: Path) -> str:
    with path.open("rb") as file:  # a video may be larger than memory
        return hashlib.file_digest(file, "sha256").hexdigest()


def _warnings(
    ask: Asked, path: Path, pairs: tuple[Pair, ...], vector: VectorMap
) -> tuple[str, ...]:
    """What a reader must know of a map that is not poor for it."""
    said = [pair.said() for pair in pairs if pair.separable]
    if not ask.robots and is_picture(path):  # in a video's median it is gone
        said.append(
            "no marker of a robot was found, so none is masked; where one stands, mask it in the "
            "config, or name the --dictionary of its marker"
        )
    weak = [p for p in vector.patches if p.confidence is not None and p.confidence < WEAK]
    for patch in weak[:MOST_NAMED]:
        x, y = patch.rings[0].mean(axis=0)
        said.append(
            f"the patch of {patch.surface} around x {x:.2f} m, y {y:.2f} m ({patch.area:.3g} m^2) "
            f"looks almost as much like another surface ({patch.confidence:.1f} spreads)"
        )
    if len(weak) > MOST_NAMED:
        area = sum(patch.area for patch in weak[MOST_NAMED:])
        said.append(f"so do {len(weak) - MOST_NAMED} smaller patches ({area:.3g} m^2)")
    return tuple(said)


def text_of_proposal(path: Path, palette: Palette, made: FoundMap, points: Proposal) -> str:
    """The config of a proposal, by points in pixels."""
    shares = {one["surface"]: one["share"] for one in made.to_json()["surfaces"]}
    pixels = made.floor.pixels[points.row, points.column]
    surfaces = []
    for name, colour in made.vector.colours.items():
        mine = points.surface == int(name.removeprefix("surface_")) - 1
        places = tuple((float(x), float(y)) for x, y in pixels[mine])
        surfaces.append(ProposedSurface(name, colour, shares[name], places))
    return palette_text(surfaces, path.name, palette)
