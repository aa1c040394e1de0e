"""What a config asks for, as cells: the region, what hides the floor, and the marked points."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from slipid.camera.floor.colour import Features, lab_of, light_of_code
from slipid.camera.floor.grid import (
    Extent,
    Grid,
    Rectified,
    Robot,
    Seen,
    filled,
    grid_over,
    hidden,
    pixel_size,
    rectified,
    robots,
    view_of,
)
from slipid.camera.floor.palette import Palette, Places, Polygon
from slipid.camera.floor.surfaces import Seeds
from slipid.camera.overhead import OverheadCamera
from slipid.support.errors import DataError

LEAST_CELLS = 400
"""Of floor that is looked at."""
AROUND = 4
"""How far around a marked point the surface is taken to reach [cells]."""
FAR = 30.0
"""A colour that differs by more from every cell is not in the picture [L, a, b]."""


@dataclass(frozen=True, eq=False)
class Asked:
    """The floor that is to be mapped.

    Attributes:
        floor: the picture laid onto it.
        wanted: cells of the region that the camera would see, were nothing in the way.
        known: those of them that show the floor.
        robots: that were found.
    """

    floor: Rectified
    wanted: Bool[np.ndarray, "row column"]
    known: Bool[np.ndarray, "row column"]
    robots: tuple[Seen, ...]


@dataclass(frozen=True, eq=False)
class Source:
    """A picture, and the camera that took it.

    Attributes:
        path: of the picture, for messages.
        config: of the palette, for messages.
    """

    path: Path
    config: Path
    picture: UInt8[np.ndarray, "y x 3"]
    camera: OverheadCamera


def asked(source: Source, palette: Palette, robot: Robot, cell: float | None) -> Asked:
    """Which cells show what is asked for.

    Raises:
        DataError: another resolution than the camera's, or a region without floor that is seen.
    """
    picture, camera = source.picture, source.camera
    camera.of_size((picture.shape[1], picture.shape[0]), source.path)
    grid = grid_over(_extent(source, palette.region), cell or pixel_size(camera), source.path)
    floor = rectified(picture, camera, grid)
    wanted = floor.seen.copy()
    if palette.region is not None:
        wanted &= _cells(source, floor, palette.region)
    if wanted.sum() < LEAST_CELLS:
        raise DataError(
            f"{source.config if palette.region else source.path}: region: {wanted.sum()} cells of "
            f"{1e3 * grid.cell:.3g} mm that the camera sees; expected {LEAST_CELLS} or more"
        )
    known = wanted.copy()
    for polygon in palette.mask:
        known &= ~_cells(source, floor, polygon)
    found = robots(picture, camera, robot)
    for one in found:
        known &= ~floor.of_picture(hidden(camera, robot, one))
    if known.sum() < LEAST_CELLS:
        raise DataError(
            f"{source.path}: masks and robots hide all but {known.sum()} cells; expected "
            f"{LEAST_CELLS} or more of floor"
        )
    return Asked(floor, wanted, known, found)


def _extent(source: Source, region: Polygon | None) -> Extent:
    """The part of the floor that a region covers, or that is seen."""
    view = view_of(source.camera)
    if region is None:
        return view
    if region.at_m is not None:
        corners = np.array(region.at_m)
    else:
        pixels = np.array(region.at_px)
        part = np.linspace(0, 1, 33)[:, None, None]
        corners = source.camera.on_plane(pixels + part * (np.roll(pixels, -1, 0) - pixels), 0.0)
        corners = corners[np.isfinite(corners).all(axis=-1)]
    low = np.maximum(corners.min(axis=0, initial=np.inf), [view.low_x, view.low_y])
    high = np.minimum(corners.max(axis=0, initial=-np.inf), [view.high_x, view.high_y])
    if not (low < high).all():
        raise DataError(
            f"{source.config}: region: no floor that the camera sees; expected a polygon within "
            f"x {view.low_x:.2f} to {view.high_x:.2f} m, y {view.low_y:.2f} to {view.high_y:.2f} m"
        )
    return Extent(*(float(v) for v in (*low, *high)))


def _cells(source: Source, floor: Rectified, polygon: Polygon) -> Bool[np.ndarray, "row column"]:
    """Cells in a polygon."""
    if polygon.at_m is not None:
        return floor.grid.inside(np.array(polygon.at_m))
    height, width = source.picture.shape[:2]
    return floor.of_picture(filled(np.array(polygon.at_px), height, width))


def seeds(source: Source, found: Features, ask: Asked, palette: Palette) -> Seeds:
    """Colours and marked cells of the surfaces of a config.

    Raises:
        DataError: a point that shows no floor, or a colour that nothing has.
    """
    names = palette.names
    rows, columns, own = [], [], []
    for k, marked in enumerate(palette.points):
        cells = around(_marked(source, ask, marked, k), ask.known)
        rows.append(cells[:, 0])
        columns.append(cells[:, 1])
        own.append(np.full(len(cells), names.index(marked.surface)))
    empty = [np.zeros(0, int)]
    row, column, surface = (np.concatenate([*empty, *part]) for part in (rows, columns, own))
    colours = np.zeros((len(names), 3))
    for k, name in enumerate(names):
        if (surface == k).any():
            colours[k] = np.median(found.light[row[surface == k], column[surface == k]], axis=0)
        else:
            colours[k] = light_of_code(palette.palette[name])
            _present(source, name, palette.palette[name], found.look[ask.known][:, :3])
    return Seeds(colours, row, column, surface)


def around(
    cells: Int[np.ndarray, "point 2"], known: Bool[np.ndarray, "row column"]
) -> Int[np.ndarray, "cell 2"]:
    """Row and column of the known cells around points."""
    steps = np.arange(-AROUND, AROUND + 1, 2)
    square = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(1, -1, 2)
    near = (cells[:, None] + square).reshape(-1, 2)
    near = near[((near >= 0) & (near < known.shape)).all(axis=1)]
    return near[known[near[:, 0], near[:, 1]]]


def _marked(source: Source, ask: Asked, marked: Places, k: int) -> Int[np.ndarray, "point 2"]:
    """Row and column of marked points."""
    grid: Grid = ask.floor.grid
    given = np.array(marked.at_px or marked.at_m, float)
    height, width = source.picture.shape[:2]
    if marked.at_px is not None:
        out = ~((given >= -0.5) & (given < [width - 0.5, height - 0.5])).all(axis=1)
        _refuse(source, given[out], k, f"outside the picture of {width} x {height} pixels")
        xy = source.camera.on_plane(given, 0.0)
    else:
        xy = given
    with np.errstate(invalid="ignore"):
        cells = np.rint(np.nan_to_num(grid.steps(xy), nan=-9.0)).astype(int)[:, ::-1]
    off = ~((cells >= 0) & (cells < [grid.rows, grid.columns])).all(axis=1)
    inside = cells.clip(0, [grid.rows - 1, grid.columns - 1])
    off |= ~ask.known[inside[:, 0], inside[:, 1]]
    _refuse(source, given[off], k, "not seen, outside the region, on a mask or on a robot")
    return inside


def _refuse(source: Source, points: Float[np.ndarray, "point 2"], k: int, what: str) -> None:
    if len(points):
        x, y = points[0]
        raise DataError(
            f"{source.config}: points[{k + 1}]: [{x:g}, {y:g}] is {what}; expected a point on the "
            "surface"
        )


def _present(source: Source, name: str, colour: str, look: Float[np.ndarray, "cell 3"]) -> None:
    """Refuse a colour that nothing in the picture has."""
    off = np.linalg.norm(look - lab_of(light_of_code(colour)[None])[0], axis=1)
    if (nearest := float(np.percentile(off, 0.5))) > FAR:
        raise DataError(
            f"{source.config}: palette.{name}: '{colour}' is nowhere in the picture (the nearest "
            f"is {nearest:.0f} off in CIELAB); expected a colour as the picture shows it, or "
            "points on the surface"
        )
