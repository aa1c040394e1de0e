"""A map of the floor made from one picture taken from above."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from slipid.camera.floor.grid import RobotShape
from slipid.camera.floor.light import Features, features_of
from slipid.camera.floor.proposal import matched, proposed
from slipid.camera.floor.region import (
    SCHEMA,
    FloorPicture,
    FloorRegion,
    Palette,
    palette_text,
    points_text,
    read_palette,
    requested_region,
    seeds_of,
)
from slipid.camera.floor.result import PictureMap, Segmentation, map_from
from slipid.camera.floor.surfaces import (
    AROUND,
    UNKNOWN,
    MarkedCells,
    Seeds,
    labelled,
    learnt,
    without_small_patches,
)
from slipid.camera.frame_source import still
from slipid.camera.opencv import Labels
from slipid.camera.overhead import OverheadCamera
from slipid.support.errors import DataError
from slipid.support.progress import Reporter

NARROW = 7
"""Width of the narrowest patch that is kept [cells]."""


@dataclass(frozen=True)
class MapOptions:
    """Options of a map.

    Attributes:
        config: file of a palette; None to propose surfaces from the picture.
        surfaces: number of surfaces to propose; None to choose it from the picture.
        robot: shape of robots in the picture, which are masked.
        cell: edge length of a cell [m]; None for that of a pixel on the floor.
    """

    config: Path | None = None
    surfaces: int | None = None
    robot: RobotShape = field(default_factory=RobotShape)
    cell: float | None = None


def map_of(path: Path, camera: OverheadCamera, options: MapOptions, report: Reporter) -> PictureMap:
    """Return the map of a picture.

    Raises:
        DataError: the file is not a picture, its resolution is not the camera's, or the config does
            not fit the picture.
    """
    report.stage("laying the picture onto the floor")
    picture = still(path)
    palette = Palette(schema=SCHEMA) if options.config is None else read_palette(options.config)
    source = FloorPicture(path, options.config or path, picture, camera)
    if palette.names and options.surfaces is not None:
        raise DataError(
            f"{options.config}: it names {len(palette.names)} surfaces; expected no --surfaces "
            "with it"
        )
    region = requested_region(source, palette, options.robot, options.cell)
    features = features_of(region.floor.colour)
    report.stage("separating surfaces")
    if palette.names:
        points, names = None, palette.names
        seeds = _with_matches(seeds_of(source, features, region, palette), features, region)
    else:
        points = proposed(features, region.visible, options.surfaces)
        seeds = _seeds_around(points, features, region)
        names = tuple(f"surface_{k + 1}" for k in range(len(seeds.colours)))
    segmentation = _segmented(features, region, seeds)
    if points is None:
        check_all_present(source, names, segmentation.labels)
    report.stage("drawing outlines")
    result = map_from(source, region, features, names, palette, segmentation)
    if points is None:
        return result
    return replace(result, proposal=_config_of(path, palette, result, points))


def _segmented(features: Features, region: FloorRegion, seeds: Seeds) -> Segmentation:
    """Return the surface of each cell; cells that resemble none of them are unknown."""
    surfaces = learnt(features, region.visible, seeds)
    costs = surfaces.costs(features.appearance)
    labels = labelled(costs, region.visible)
    labels = without_small_patches(labels, region.visible, NARROW)
    return Segmentation(np.where(labels == len(costs), UNKNOWN, labels), costs, surfaces)


def _with_matches(seeds: Seeds, features: Features, region: FloorRegion) -> Seeds:
    """Return seeds with more marked cells for surfaces that have at most one marked point.

    These cells are on patches whose colour matches the surface.
    """
    count = np.bincount(seeds.marked.surface, minlength=len(seeds.colours))
    few = count <= (AROUND + 1) ** 2  # number of cells around one point
    if not few.any():
        return seeds
    match = matched(features, region.visible, seeds.colours)
    more = match.only(few[match.surface]).surroundings(region.visible)
    return replace(seeds, marked=seeds.marked.joined(more))


def _seeds_around(points: MarkedCells, features: Features, region: FloorRegion) -> Seeds:
    """Return the cells around proposed points as marked cells, and their surfaces' colours."""
    cells = points.surroundings(region.visible)
    rgb, own = features.rgb[cells.row, cells.column], cells.surface
    colours = [np.median(rgb[own == k], axis=0) for k in range(own.max() + 1)]
    return Seeds(np.array(colours, float), cells)


def check_all_present(source: FloorPicture, names: tuple[str, ...], labels: Labels) -> None:
    """Raise `DataError` if a surface of a config has no cell."""
    absent = [name for k, name in enumerate(names) if not (labels == k).any()]
    if absent:
        raise DataError(
            f"{source.config}: nothing in the picture looks most like {', '.join(absent)}; "
            "expected a colour or points of a surface that is there and differs from the others"
        )


def _config_of(path: Path, palette: Palette, result: PictureMap, points: MarkedCells) -> str:
    """Return the text of a config that marks the proposed surfaces by points in pixels."""
    pixels = result.floor.pixels[points.row, points.column]
    surfaces = []
    for k, (name, colour) in enumerate(result.vector.region.colours.items()):
        own = points.surface == int(name.removeprefix("surface_")) - 1
        surfaces.append(points_text(name, colour, result.share(k), pixels[own]))
    return palette_text(surfaces, path.name, palette)
