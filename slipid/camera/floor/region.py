"""The config of a floor map, and the cells of the part of the floor that the config requests.

A config specifies surfaces by colour or by marked points, and may limit the map by a region and
masks.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, Int, UInt8
from pydantic import Field, model_validator

from slipid.camera.floor.grid import (
    LEAST_CELLS,
    DetectedRobot,
    Extent,
    Rectified,
    RobotShape,
    detected_robots,
    filled,
    grid_over,
    hidden_by,
    pixel_size,
    rectified,
    view_of,
)
from slipid.camera.floor.light import Features, features_of, lab_of, linear_of_code
from slipid.camera.floor.surfaces import Seeds, surroundings
from slipid.camera.opencv import Mask, size_of
from slipid.camera.overhead import OverheadCamera
from slipid.camera.search import MIRRORED, mirror_image
from slipid.data.floor_map import Colour, Point
from slipid.support.errors import DataError
from slipid.support.toml_file import Section, checked, mapping_of, text_of

ABSENT_FROM = 30.0
"""Colour distance for recognising absent colours [CIELAB units]: a colour of the config is absent
from the image if at least 99.5 % of the visible cells differ from it by more."""
SCHEMA: Literal["slipid.palette/1"] = "slipid.palette/1"
Points = Annotated[list[Point], Field(min_length=1)]
Name = Annotated[str, Field(min_length=1, max_length=60)]


class Places(Section):
    """Points given either in the image [pixel] or on the floor [m]."""

    at_px: Points | None = None
    at_m: Points | None = None

    @model_validator(mode="after")
    def _one(self) -> "Places":
        if (self.at_px is None) == (self.at_m is None):
            raise ValueError(
                "both or neither of at_px and at_m are given; expected exactly one of them: "
                "[[x, y], ...]"
            )
        return self


class Polygon(Places):
    """A polygon, given by its corners."""

    @model_validator(mode="after")
    def _corners(self) -> "Polygon":
        if (count := len(self.at_px or self.at_m or [])) < 3:
            raise ValueError(f"{count} corners; expected a polygon of 3 or more")
        return self


class Marked(Places):
    """Points that mark a surface."""

    surface: Name


class Palette(Section):
    """Config of a map: colours or points of the floor's surfaces, a region and masks."""

    schema_: Literal["slipid.palette/1"] = Field(alias="schema")
    palette: dict[Name, Colour] = Field(default_factory=dict)
    points: list[Marked] = Field(default_factory=list)
    region: Polygon | None = None
    mask: list[Polygon] = Field(default_factory=list)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the surfaces, in the order of the config."""
        return tuple(dict.fromkeys([*self.palette, *(one.surface for one in self.points)]))


def read_palette(path: Path) -> Palette:
    """Return the checked config in a TOML file.

    Raises:
        DataError: the file is unreadable, keys are unknown or missing, values are wrong, or two
            surfaces have the same colour.
    """
    palette = checked(path, mapping_of(path, text_of(path, "a palette of surfaces")), Palette)
    first: dict[str, str] = {}
    for name, colour in palette.palette.items():
        same = first.setdefault(colour.lower(), name)
        if same != name:
            raise DataError(
                f"{path}: palette.{name}: '{colour}' is also the colour of {same}; expected a "
                "different colour for each surface"
            )
    return palette


def palette_text(surfaces: Sequence[str], image: str, before: Palette) -> str:
    """Return the text of a config that specifies the proposed surfaces and that users can edit.

    Args:
        surfaces: TOML tables of the proposed surfaces, see `points_text`.
        image: name of the image.
        before: config without surfaces, whose region and masks are kept.
    """
    lines = [
        f"# Surfaces that `slipid map` proposed for {image}.",
        "# Rename them. Give the same name to surfaces that are one: where the light differs much,",
        "# one surface is often proposed as two. If a surface is missing, add points on it.",
        "# Then run `slipid map IMAGE --config THIS_FILE`, with the other options as before.",
        f'schema = "{SCHEMA}"',
        "",
    ]
    lines += _polygon("[region]", before.region) if before.region else _EXAMPLE
    for one in before.mask:
        lines += _polygon("[[mask]]", one)
    return "\n".join([*lines, *surfaces])


def points_text(name: str, colour: str, share: float, pixels: Float[np.ndarray, "point 2"]) -> str:
    """Return the TOML table of a surface that is marked by points.

    Args:
        name: name of the surface.
        colour: its colour `#rrggbb`, for a comment.
        share: fraction of the mapped floor that it covers [1], for a comment.
        pixels: points on the surface in the image [pixel].
    """
    points = ", ".join(f"[{x:.0f}, {y:.0f}]" for x, y in pixels.tolist())
    return (
        f"[[points]]  # {colour}, {100 * share:.1f} % of the mapped floor\n"
        f'surface = "{name}"\nat_px = [{points}]\n'
    )


_EXAMPLE = [
    "# Only the floor in a region is mapped; objects on the floor can be masked:",
    "# [region]",
    "# at_px = [[100, 100], [900, 100], [900, 700], [100, 700]]",
    "# [[mask]]",
    "# at_px = [[10, 10], [60, 10], [60, 80]]",
    "",
]


def _polygon(head: str, polygon: Polygon) -> list[str]:
    key, corners = ("at_px", polygon.at_px) if polygon.at_px else ("at_m", polygon.at_m)
    return [head, f"{key} = {[list(corner) for corner in corners or []]}", ""]


@dataclass(frozen=True, eq=False)
class FloorPicture:
    """An image of the floor, and the camera that took it.

    Attributes:
        path: file of the image, for messages.
        picture: blue, green, red of every pixel.
        camera: the calibrated camera.
        config: file of the palette, for messages.
        palette: surfaces, region and masks.
    """

    path: Path
    picture: UInt8[np.ndarray, "y x 3"]
    camera: OverheadCamera
    config: Path
    palette: Palette

    def cells(self, floor: Rectified, polygon: Polygon) -> Mask:
        """Return a mask of the floor cells that lie in a polygon."""
        if polygon.at_m is not None:
            corners = floor.grid.steps(np.array(polygon.at_m))
            return filled(corners, floor.grid.rows, floor.grid.columns)
        width, height = size_of(self.picture)
        return floor.of_picture(filled(np.array(polygon.at_px), height, width))


@dataclass(frozen=True, eq=False)
class FloorRegion:
    """The part of the floor to be mapped.

    Attributes:
        source: the image and its camera.
        floor: the image projected onto the floor.
        requested: mask of the region's cells that lie in the camera's view.
        visible: mask of the requested cells that neither a mask of the config nor a robot hides.
        robots: robots detected in the image.
    """

    source: FloorPicture
    floor: Rectified
    requested: Mask
    visible: Mask
    robots: tuple[DetectedRobot, ...]

    @cached_property
    def features(self) -> Features:
        """Features of every cell."""
        return features_of(self.floor.colour)


def requested_region(source: FloorPicture, robot: RobotShape, cell: float | None) -> FloorRegion:
    """Return the cells that a config requests, and which of them show the floor.

    Args:
        source: the image, its camera, and the config with its region and masks.
        robot: shape of robots that may hide the floor.
        cell: edge length of a cell [m]; None for the edge length of a pixel on the floor.

    Raises:
        DataError: the image's resolution is not the camera's, the image is mirrored, or the region
            has no visible floor.
    """
    picture, camera, palette = source.picture, source.camera, source.palette
    camera.lens.check_size(size_of(picture), source.path)
    grid = grid_over(_extent(source), cell or pixel_size(camera), source.path)
    floor = rectified(picture, camera, grid)
    requested = floor.in_view.copy()
    if palette.region is not None:
        requested &= source.cells(floor, palette.region)
    if requested.sum() < LEAST_CELLS:
        raise DataError(
            f"{source.config if palette.region else source.path}: region: the camera sees "
            f"{requested.sum()} cells of {1e3 * grid.cell:.3g} mm; expected {LEAST_CELLS} or more: "
            "a larger region, or a smaller --cell"
        )
    visible = requested.copy()
    for polygon in palette.mask:
        visible &= ~source.cells(floor, polygon)
    robots = detected_robots(picture, camera, robot)
    if not robots and detected_robots(mirror_image(picture), camera, robot):
        raise DataError(f"{source.path}: a robot's marker {MIRRORED}")
    for one in robots:
        visible &= ~floor.of_picture(hidden_by(one, robot, camera))
    if visible.sum() < LEAST_CELLS:
        raise DataError(
            f"{source.path}: masks and robots leave {visible.sum()} cells of visible floor; "
            f"expected {LEAST_CELLS} or more"
        )
    return FloorRegion(source, floor, requested, visible, robots)


def _extent(source: FloorPicture) -> Extent:
    """Return the rectangle around the visible part of a region, or around the whole view."""
    view, region = view_of(source.camera), source.palette.region
    if region is None:
        return view
    if region.at_m is not None:
        corners = np.array(region.at_m)
    else:
        pixels = np.array(region.at_px)
        part = np.linspace(0, 1, 33)[:, None, None]
        corners = source.camera.on_plane(pixels + part * (np.roll(pixels, -1, 0) - pixels), 0.0)
        corners = corners[np.isfinite(corners).all(axis=-1)]
    low = np.maximum(corners.min(axis=0, initial=np.inf), view[:2])
    high = np.minimum(corners.max(axis=0, initial=-np.inf), view[2:])
    if not (low < high).all():
        raise DataError(
            f"{source.config}: region: the camera sees no floor in it; expected a polygon within "
            f"x {view.low_x:.2f} to {view.high_x:.2f} m, y {view.low_y:.2f} to {view.high_y:.2f} m"
        )
    return Extent(*map(float, (*low, *high)))


def seeds_of(region: FloorRegion) -> Seeds:
    """Return colours and marked cells of the surfaces that a config specifies.

    Raises:
        DataError: a marked point does not show the floor, or a colour is absent from the image.
    """
    names, points = region.source.palette.names, [np.zeros((0, 3), int)]
    for k, one in enumerate(region.source.palette.points):
        points.append(np.insert(_marked(region, one, k), 2, names.index(one.surface), axis=1))
    marked = surroundings(np.concatenate(points), region.visible)
    colours = np.zeros((len(names), 3))
    for k, name in enumerate(names):
        row, column, _ = marked[marked[:, 2] == k].T
        if len(row):
            colours[k] = np.median(region.features.rgb[row, column], axis=0)
        else:
            colours[k] = _given_colour(region, name)
    return Seeds(colours, marked)


def _marked(region: FloorRegion, marked: Places, k: int) -> Int[np.ndarray, "point 2"]:
    """Return row and column of the marked points in the config's entry `points[k]`."""
    source, grid = region.source, region.floor.grid
    given = np.array(marked.at_px or marked.at_m, float)
    width, height = size_of(source.picture)
    if marked.at_px is not None:
        out = ~((given >= -0.5) & (given < [width - 0.5, height - 0.5])).all(axis=1)
        _refuse(source, given[out], k, f"outside the image of {width} x {height} pixels")
        xy = source.camera.on_plane(given, 0.0)
    else:
        xy = given
    with np.errstate(invalid="ignore"):
        cells = np.rint(np.nan_to_num(grid.steps(xy), nan=-9.0)).astype(int)[:, ::-1]
    off = ~((cells >= 0) & (cells < [grid.rows, grid.columns])).all(axis=1)
    inside = cells.clip(0, [grid.rows - 1, grid.columns - 1])
    off |= ~region.visible[inside[:, 0], inside[:, 1]]
    _refuse(source, given[off], k, "not visible, outside the region, on a mask or on a robot")
    return inside


def _refuse(
    source: FloorPicture, points: Float[np.ndarray, "point 2"], k: int, problem: str
) -> None:
    if len(points):
        x, y = points[0]
        raise DataError(
            f"{source.config}: points[{k + 1}]: [{x:g}, {y:g}] is {problem}; expected a point on "
            "the surface"
        )


def _given_colour(region: FloorRegion, name: str) -> Float[np.ndarray, "3"]:
    """Return the linear RGB that the config gives for a surface.

    Raises:
        DataError: the colour is absent from the image, see `ABSENT_FROM`.
    """
    code = region.source.palette.palette[name]
    colour, lab = linear_of_code(code), region.features.appearance[region.visible][:, :3]
    off = np.linalg.norm(lab - lab_of(colour[None])[0], axis=1)
    if (nearest := float(np.percentile(off, 0.5))) > ABSENT_FROM:
        raise DataError(
            f"{region.source.config}: palette.{name}: '{code}' is nowhere in the image (the "
            f"nearest colour differs by {nearest:.0f} CIELAB units); expected a colour as the "
            "image shows it, or points on the surface"
        )
    return colour
