"""The floor as square cells, the image projected onto them, and robots that hide the floor."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from slipid.camera.opencv import Mask, cv2, marker_dictionary
from slipid.camera.overhead import OverheadCamera
from slipid.support.errors import DataError

LEAST_CELLS, MOST_CELLS = 400, 4_000_000
"""Smallest and largest number of cells of a map."""
FARTHEST_IN_HEIGHTS = 3.0
"""Largest distance of mapped floor from the lens, horizontally, in multiples of the lens's height
above the floor [1]."""


class Extent(NamedTuple):
    """A rectangle of the floor with edges along the world's x and y axes [m]."""

    low_x: float
    low_y: float
    high_x: float
    high_y: float


@dataclass(frozen=True)
class Grid:
    """Square cells on the floor, the first row at the lowest y.

    Attributes:
        low_x, low_y: the corner with the lowest coordinates [m].
        cell: edge length of a cell [m].
        rows, columns: number of cells along y and along x.
    """

    low_x: float
    low_y: float
    cell: float
    rows: int
    columns: int

    @property
    def extent(self) -> Extent:
        """Rectangle that the cells cover."""
        x, y = self.low_x + self.columns * self.cell, self.low_y + self.rows * self.cell
        return Extent(self.low_x, self.low_y, x, y)

    def centres(self) -> Float[np.ndarray, "row column 2"]:
        """Return x and y of the middle of every cell [m]."""
        x = self.low_x + (np.arange(self.columns) + 0.5) * self.cell
        y = self.low_y + (np.arange(self.rows) + 0.5) * self.cell
        return np.stack(np.meshgrid(x, y), axis=-1)

    def steps(self, xy: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Return column and row of floor points [m], unrounded; 0, 0 is the first cell's middle."""
        return (xy - np.array([self.low_x, self.low_y])) / self.cell - 0.5

    def places(self, corners: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Return x and y [m] of cell corners, given by column and row; 0, 0 is at low_x, low_y."""
        return np.array([self.low_x, self.low_y]) + corners * self.cell


@dataclass(frozen=True, eq=False)
class Rectified:
    """An image projected onto the floor.

    Attributes:
        grid: cells of the floor.
        colour: blue, green, red of each cell, 0 to 255; 0 where the camera does not see the cell.
        in_view: mask of the cells that the camera sees.
        pixels: pixel at which the middle of each cell appears [pixel]; NaN for a cell outside the
            lens's view.
    """

    grid: Grid
    colour: UInt8[np.ndarray, "row column 3"]
    in_view: Mask
    pixels: Float[np.ndarray, "row column 2"]

    def of_picture(self, mask: Bool[np.ndarray, "y x"]) -> Mask:
        """Return a mask of the cells in view whose pixel is set in a mask of the image."""
        across, down = (np.nan_to_num(np.rint(self.pixels[..., k])).astype(int) for k in (0, 1))
        height, width = mask.shape
        return mask[down.clip(0, height - 1), across.clip(0, width - 1)] & self.in_view


def filled(polygon: Float[np.ndarray, "corner 2"], rows: int, columns: int) -> Mask:
    """Return a mask of the grid points in a polygon, whose corners are given as column and row."""
    mask = np.zeros((rows, columns), np.uint8)
    # OpenCV takes corners as integers: give sixteenths, and 4 fractional bits as the last argument
    parts = 16
    corners = np.rint(np.clip(polygon, -1e6, 1e6) * parts).astype(np.int32)
    cv2.fillPoly(mask, [corners.reshape(-1, 1, 2)], 1, cv2.LINE_8, 4)
    return mask.astype(bool)


def view_of(camera: OverheadCamera) -> Extent:
    """Return the rectangle around the part of the floor that a camera sees.

    Raises:
        DataError: the camera sees no floor nearby.
    """
    floor = camera.on_plane(_pixel_grid(camera, -0.5), 0.0).reshape(-1, 2)
    floor = floor[
        np.linalg.norm(floor - camera.place[:2], axis=1) <= FARTHEST_IN_HEIGHTS * camera.height
    ]
    if not len(floor):
        raise DataError(
            "the camera sees no floor nearby; expected a camera file of a camera that looks down"
        )
    return Extent(*map(float, (*floor.min(axis=0), *floor.max(axis=0))))


def _pixel_grid(camera: OverheadCamera, edge: float) -> Float[np.ndarray, "65 65 2"]:
    """Return a grid of pixels that covers an image evenly.

    The grid's border is `edge` [pixel] inside the middles of the outermost pixels; with -0.5 it is
    the outer edge of the image.
    """
    width, height = camera.lens.image_px
    across = np.linspace(edge, width - 1 - edge, 65)
    down = np.linspace(edge, height - 1 - edge, 65)
    return np.stack(np.meshgrid(across, down), axis=-1)


def pixel_size(camera: OverheadCamera) -> float:
    """Return the edge length of a pixel on the floor in the middle of the view [m]."""
    view = view_of(camera)
    middle = np.array([(view.low_x + view.high_x) / 2, (view.low_y + view.high_y) / 2, 0.0])
    at = camera.pixels(middle + 1e-3 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    return float(1e-3 / np.sqrt(abs(np.linalg.det(at[1:] - at[0]))))


def grid_over(extent: Extent, cell: float, picture: Path) -> Grid:
    """Return cells that cover a rectangle.

    Args:
        extent: the rectangle.
        cell: edge length of a cell [m].
        picture: file of the image, for messages.

    Raises:
        DataError: there would be too many cells or too few.
    """
    columns = max(1, round((extent.high_x - extent.low_x) / cell))
    rows = max(1, round((extent.high_y - extent.low_y) / cell))
    if LEAST_CELLS <= rows * columns <= MOST_CELLS:
        return Grid(extent.low_x, extent.low_y, cell, rows, columns)
    expected = f"at most {MOST_CELLS} in all: a larger --cell, or a region"
    if rows * columns < LEAST_CELLS:
        expected = f"{LEAST_CELLS} or more: a smaller --cell"
    raise DataError(
        f"{picture}: {rows} x {columns} cells of {1e3 * cell:.3g} mm; expected {expected}"
    )


def rectified(picture: UInt8[np.ndarray, "y x 3"], camera: OverheadCamera, grid: Grid) -> Rectified:
    """Return the image projected onto the floor; cells out of view are black."""
    centres = grid.centres()
    points = np.concatenate([centres, np.zeros((*centres.shape[:2], 1))], axis=-1)
    ahead = _before_lens(camera, points)
    pixels = np.full(centres.shape, np.nan)
    pixels[ahead] = camera.pixels(points[ahead])
    height, width = picture.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = (pixels > -0.5).all(axis=-1) & (pixels < [width - 0.5, height - 0.5]).all(axis=-1)
    in_view = inside & ahead
    ratio = grid.cell / pixel_size(camera)
    if ratio > 1.5:
        # blur first, so that a cell gets the mean colour of its many pixels instead of one of them
        picture = cv2.GaussianBlur(picture, (0, 0), 0.4 * ratio)
    maps = [np.nan_to_num(pixels[..., k], nan=-9.0).astype(np.float32) for k in (0, 1)]
    colour = cv2.remap(picture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    colour[~in_view] = 0
    return Rectified(grid, colour, in_view, pixels)


def _before_lens(camera: OverheadCamera, points: Float[np.ndarray, "row column 3"]) -> Mask:
    """Return a mask of the points near the camera, in front of it and within its angle of view.

    All other points must be excluded, since the distortion of a lens is a polynomial that would map
    points far outside the image back into it.
    """
    ideal = camera.lens.ideal(_pixel_grid(camera, 0.0))
    widest = 1.02 * np.linalg.norm(ideal, axis=-1).max()
    rays = (points - camera.place) @ camera.rotation.T
    near = (
        np.linalg.norm(points[..., :2] - camera.place[:2], axis=-1)
        <= FARTHEST_IN_HEIGHTS * camera.height
    )
    depth = rays[..., 2]
    return near & (depth > 0) & (np.linalg.norm(rays[..., :2], axis=-1) <= widest * depth)


@dataclass(frozen=True)
class RobotShape:
    """Shape of a robot: an upright cylinder with a marker in the middle of its top.

    Attributes:
        dictionary: dictionary of its marker, such as `4X4_50`.
        radius, height: size of the cylinder [m].
    """

    dictionary: str = "4X4_50"
    radius: float = 0.2
    height: float = 0.25


@dataclass(frozen=True)
class DetectedRobot:
    """A robot in the image.

    Attributes:
        marker: number of its marker in the dictionary.
        x, y: position of the robot's middle on the floor [m].
    """

    marker: int
    x: float
    y: float


def detected_robots(
    picture: UInt8[np.ndarray, "y x 3"], camera: OverheadCamera, shape: RobotShape
) -> tuple[DetectedRobot, ...]:
    """Return all robots whose markers are detected in an image."""
    detector = cv2.aruco.ArucoDetector(marker_dictionary(shape.dictionary))
    corners, numbers, _ = detector.detectMarkers(picture)
    robots = []
    for outline, number in zip(corners, [] if numbers is None else numbers.ravel(), strict=True):
        place = camera.on_plane(np.asarray(outline, float).reshape(4, 2), shape.height)
        if np.isfinite(place).all():
            x, y = place.mean(axis=0)
            robots.append(DetectedRobot(int(number), float(x), float(y)))
    return tuple(robots)


def hidden_by(
    robot: DetectedRobot, shape: RobotShape, camera: OverheadCamera
) -> Bool[np.ndarray, "y x"]:
    """Return a mask of the pixels that show a robot's top or side instead of the floor."""
    around = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    ring = shape.radius * np.stack([np.cos(around), np.sin(around)], axis=-1) + [robot.x, robot.y]
    levels = np.linspace(0, shape.height, 5)
    points = np.concatenate([np.column_stack([ring, np.full(len(ring), z)]) for z in levels])
    # a cylinder is convex, so it hides the convex hull of its rings
    outline = cv2.convexHull(camera.pixels(points).astype(np.float32))
    width, height = camera.lens.image_px
    hull: Float[np.ndarray, "corner 2"] = np.asarray(outline, float).reshape(-1, 2)
    return filled(hull, height, width)
