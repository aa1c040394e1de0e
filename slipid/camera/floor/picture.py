"""A map of the floor made from one image taken from above."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from slipid.camera.floor.grid import RobotShape
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
from slipid.camera.floor.result import PictureMap, map_from
from slipid.camera.floor.surfaces import (
    MARK_RADIUS,
    UNKNOWN,
    MarkedCells,
    Seeds,
    labelled,
    learnt,
    surroundings,
    without_small_patches,
)
from slipid.camera.opencv import Labels
from slipid.camera.overhead import OverheadCamera
from slipid.camera.video import still
from slipid.support.errors import DataError
from slipid.support.progress import Reporter

NARROWEST = 7
"""Width of the narrowest patch that is kept [cells]."""


@dataclass(frozen=True)
class MapOptions:
    """Options of a map.

    Attributes:
        config: file of a palette; None to propose surfaces from the image.
        surfaces: number of surfaces to propose; None to determine the number from the image.
        robot: shape of robots in the image, which are masked.
        cell: edge length of a cell [m]; None for the edge length of a pixel on the floor.
    """

    config: Path | None = None
    surfaces: int | None = None
    robot: RobotShape = field(default_factory=RobotShape)
    cell: float | None = None


def map_of(path: Path, camera: OverheadCamera, options: MapOptions, report: Reporter) -> PictureMap:
    """Return the map of an image.

    Raises:
        DataError: the file is not an image, its resolution is not the camera's, or the config is
            inconsistent with the image.
    """
    report.stage("projecting the image onto the floor")
    palette = Palette(schema=SCHEMA) if options.config is None else read_palette(options.config)
    taken = still(path)
    source = FloorPicture(path, taken.picture, camera, options.config or path, palette)
    if palette.names and options.surfaces is not None:
        raise DataError(
            f"{options.config}: the config already has {len(palette.names)} surfaces; omit "
            "--surfaces, or the surfaces in the config"
        )
    region = requested_region(source, options.robot, options.cell)
    report.stage("separating surfaces")
    if palette.names:
        points, names = None, palette.names
        seeds = _with_matches(seeds_of(region), region)
    else:
        points = proposed(region.features, region.visible, options.surfaces)
        seeds = _seeds_around(points, region)
        names = tuple(f"surface_{k + 1}" for k in range(len(seeds.colours)))
    surfaces = learnt(region.features, region.visible, seeds)
    costs = surfaces.costs(region.features.appearance)
    labels = without_small_patches(labelled(costs, region.visible), region.visible, NARROWEST)
    labels = np.where(labels == len(costs), UNKNOWN, labels)
    if points is None:
        check_all_present(source, names, labels)
    report.stage("drawing outlines")
    result = map_from(region, names, surfaces, costs, labels)
    result.vector.region.notes.extend(taken.notes)
    result = replace(result, warnings=(*taken.faults, *result.warnings))
    if points is None:
        return result
    return replace(result, proposal=_config_of(source, result, points))


def _with_matches(seeds: Seeds, region: FloorRegion) -> Seeds:
    """Return seeds with additional marked cells for surfaces that have at most one marked point.

    The additional cells are on patches whose colour matches the surface.
    """
    count = np.bincount(seeds.marked[:, 2], minlength=len(seeds.colours))
    # `surroundings` marks up to (MARK_RADIUS + 1)^2 cells around one point
    few = count <= (MARK_RADIUS + 1) ** 2
    if not few.any():
        return seeds
    match = matched(region.features, region.visible, seeds.colours)
    more = surroundings(match[few[match[:, 2]]], region.visible)
    return replace(seeds, marked=np.concatenate([seeds.marked, more]))


def _seeds_around(points: MarkedCells, region: FloorRegion) -> Seeds:
    """Return the cells around proposed points as marked cells, and their surfaces' colours."""
    cells = surroundings(points, region.visible)
    row, column, own = cells.T
    rgb = region.features.rgb[row, column]
    colours = [np.median(rgb[own == k], axis=0) for k in range(own.max() + 1)]
    return Seeds(np.array(colours, float), cells)


def check_all_present(source: FloorPicture, names: tuple[str, ...], labels: Labels) -> None:
    """Raise `DataError` if a surface of a config has no cell."""
    absent = [name for k, name in enumerate(names) if not (labels == k).any()]
    if absent:
        raise DataError(
            f"{source.config}: no part of the image is closest in colour to {', '.join(absent)}; "
            "expected the colour or points of a surface that the image shows and that differs from "
            "the other surfaces"
        )


def _config_of(source: FloorPicture, result: PictureMap, points: MarkedCells) -> str:
    """Return the text of a config that marks the proposed surfaces by points in the image."""
    row, column, surface = points.T
    pixels = result.floor.pixels[row, column]
    surfaces = []
    for k, (name, colour) in enumerate(result.vector.region.colours.items()):
        own = surface == int(name.removeprefix("surface_")) - 1
        surfaces.append(points_text(name, colour, result.share(k), pixels[own]))
    return palette_text(surfaces, source.path.name, source.palette)
