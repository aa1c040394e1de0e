"""The floor in square cells, and the picture laid onto it by the camera.

Robots in the picture, by the markers on them: what they hide of the floor.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from slipid.camera.opencv import marker_dictionary, opencv
from slipid.camera.overhead import OverheadCamera
from slipid.support.errors import DataError

MOST_CELLS = 4_000_000
"""Largest number of cells of one map."""
FARTHEST = 3.0
"""How far from the point below the lens the floor is mapped [heights of the lens]."""


@dataclass(frozen=True)
class Extent:
    """A rectangle of the floor along the axes [m]."""

    low_x: float
    low_y: float
    high_x: float
    high_y: float


@dataclass(frozen=True)
class Grid:
    """Square cells on the floor, the first row at the lowest y.

    Attributes:
        low_x, low_y: the corner with the lowest coordinates [m].
        cell: edge of a cell [m].
    """

    low_x: float
    low_y: float
    cell: float
    rows: int
    columns: int

    @property
    def extent(self) -> Extent:
        """All of it."""
        x, y = self.low_x + self.columns * self.cell, self.low_y + self.rows * self.cell
        return Extent(self.low_x, self.low_y, x, y)

    def centres(self) -> Float[np.ndarray, "row column 2"]:
        """x, y of the middle of every cell [m]."""
        x = self.low_x + (np.arange(self.columns) + 0.5) * self.cell
        y = self.low_y + (np.arange(self.rows) + 0.5) * self.cell
        return np.stack(np.meshgrid(x, y), axis=-1)

    def steps(self, xy: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Column and row of places [m], as numbers: 0, 0 is the middle of the first cell."""
        return (xy - np.array([self.low_x, self.low_y])) / self.cell - 0.5

    def places(self, corners: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """x, y [m] of corners of cells: 0, 0 is the lowest corner of the first cell."""
        return np.array([self.low_x, self.low_y]) + corners * self.cell

    def inside(self, polygon: Float[np.ndarray, "corner 2"]) -> Bool[np.ndarray, "row column"]:
        """Cells whose middle lies in a polygon [m]."""
        return filled(self.steps(polygon), self.rows, self.columns)


@dataclass(frozen=True, eq=False)
class Rectified:
    """A picture as the floor shows it.

    Attributes:
        grid: its cells.
        colour: blue, green, red of each cell, 0 to 255; 0 where it is not seen.
        seen: cells that the camera sees.
        pixels: where in the picture the middle of each cell is seen [pixel].
    """

    grid: Grid
    colour: UInt8[np.ndarray, "row column 3"]
    seen: Bool[np.ndarray, "row column"]
    pixels: Float[np.ndarray, "row column 2"]

    def of_picture(self, mask: Bool[np.ndarray, "y x"]) -> Bool[np.ndarray, "row column"]:
        """A mask of the picture's pixels as one of cells."""
        across, down = (np.nan_to_num(np.rint(self.pixels[..., k])).astype(int) for k in (0, 1))
        height, width = mask.shape
        return mask[down.clip(0, height - 1), across.clip(0, width - 1)] & self.seen


def filled(
    polygon: Float[np.ndarray, "corner 2"], rows: int, columns: int
) -> Bool[np.ndarray, "row column"]:
    """Points of a grid that lie in a polygon of columns and rows."""
    cv2 = opencv()
    mask = np.zeros((rows, columns), np.uint8)
    parts = 16  # a sixteenth of a step is as fine as OpenCV draws
    corners = np.rint(np.clip(polygon, -1e6, 1e6) * parts).astype(np.int32)
    cv2.fillPoly(mask, [corners.reshape(-1, 1, 2)], 1, cv2.LINE_8, 4)
    return mask.astype(bool)


def view_of(camera: OverheadCamera) -> Extent:
    """The rectangle around what a camera sees of the floor.

    Raises:
        DataError: it sees none of it.
    """
    width, height = camera.lens.image_px
    across, down = np.linspace(-0.5, width - 0.5, 65), np.linspace(-0.5, height - 0.5, 65)
    seen = camera.on_plane(np.stack(np.meshgrid(across, down), axis=-1), 0.0).reshape(-1, 2)
    seen = seen[np.linalg.norm(seen - camera.place[:2], axis=1) <= FARTHEST * camera.height]
    if not len(seen):
        raise DataError("the camera sees no floor nearby; expected one that looks down")
    (low_x, low_y), (high_x, high_y) = seen.min(axis=0), seen.max(axis=0)
    return Extent(float(low_x), float(low_y), float(high_x), float(high_y))


def pixel_size(camera: OverheadCamera) -> float:
    """Edge of a pixel on the floor, where the middle of the view is [m]."""
    view = view_of(camera)
    middle = np.array([(view.low_x + view.high_x) / 2, (view.low_y + view.high_y) / 2, 0.0])
    aside = middle + 1e-3 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    at = camera.pixels(aside)
    area = abs(np.linalg.det(at[1:] - at[0]))
    return float(1e-3 / np.sqrt(area))


def grid_over(extent: Extent, cell: float, source: Path) -> Grid:
    """Cells that cover a rectangle.

    Args:
        source: of the picture, for messages.

    Raises:
        DataError: there would be too many or none.
    """
    columns = max(1, round((extent.high_x - extent.low_x) / cell))
    rows = max(1, round((extent.high_y - extent.low_y) / cell))
    if rows * columns > MOST_CELLS:
        raise DataError(
            f"{source}: {rows} x {columns} cells of {1e3 * cell:.3g} mm; expected at most "
            f"{MOST_CELLS} in all: a larger --cell, or a region"
        )
    if rows * columns < 400:
        raise DataError(
            f"{source}: {rows} x {columns} cells of {1e3 * cell:.3g} mm; expected 400 or more: "
            "a smaller --cell"
        )
    return Grid(extent.low_x, extent.low_y, cell, rows, columns)


def rectified(picture: UInt8[np.ndarray, "y x 3"], camera: OverheadCamera, grid: Grid) -> Rectified:
    """The picture laid onto the floor; what is not seen stays black."""
    cv2 = opencv()
    centres = grid.centres()
    points = np.concatenate([centres, np.zeros((*centres.shape[:2], 1))], axis=-1)
    ahead = _ahead(camera, points)
    pixels = np.full(centres.shape, np.nan)
    pixels[ahead] = camera.pixels(points[ahead])
    height, width = picture.shape[:2]
    with np.errstate(invalid="ignore"):
        seen = (pixels > -0.5).all(axis=-1) & (pixels < [width - 0.5, height - 0.5]).all(axis=-1)
    seen &= ahead
    ratio = grid.cell / pixel_size(camera)
    if ratio > 1.5:  # else a cell would show a single pixel of the many that lie in it
        picture = cv2.GaussianBlur(picture, (0, 0), 0.4 * ratio)
    maps = [np.nan_to_num(pixels[..., k], nan=-9.0).astype(np.float32) for k in (0, 1)]
    colour = cv2.remap(picture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    colour[~seen] = 0
    return Rectified(grid, colour, seen, pixels)


def _ahead(
    camera: OverheadCamera, points: Float[np.ndarray, "row column 3"]
) -> Bool[np.ndarray, "row column"]:
    """Places before the lens, and no farther aside than it draws.

    The distortion of a lens is a polynomial: far outside the picture it folds back into it.
    """
    width, height = camera.lens.image_px
    across, down = np.linspace(0, width - 1, 65), np.linspace(0, height - 1, 65)
    ideal = camera.lens.ideal(np.stack(np.meshgrid(across, down), axis=-1))
    widest = 1.02 * np.linalg.norm(ideal, axis=-1).max()
    seen = (points - camera.place) @ camera.rotation.T
    near = np.linalg.norm(points[..., :2] - camera.place[:2], axis=-1) <= FARTHEST * camera.height
    depth = seen[..., 2]
    return near & (depth > 0) & (np.linalg.norm(seen[..., :2], axis=-1) <= widest * depth)


@dataclass(frozen=True)
class Robot:
    """An upright cylinder with a marker above its middle.

    Attributes:
        dictionary: of its marker, such as `4X4_50`.
        radius, height: of the cylinder [m].
    """

    dictionary: str = "4X4_50"
    radius: float = 0.2
    height: float = 0.25


@dataclass(frozen=True)
class Seen:
    """A robot in the picture.

    Attributes:
        marker: its number in the dictionary.
        x, y: of its middle on the floor [m].
    """

    marker: int
    x: float
    y: float


def robots(
    picture: UInt8[np.ndarray, "y x 3"], camera: OverheadCamera, robot: Robot
) -> tuple[Seen, ...]:
    """Every robot whose marker is found, the marker being as high as the robot."""
    cv2 = opencv()
    detector = cv2.aruco.ArucoDetector(marker_dictionary(robot.dictionary))
    corners, numbers, _ = detector.detectMarkers(picture)
    found = []
    for outline, number in zip(corners, [] if numbers is None else numbers.ravel(), strict=True):
        place = camera.on_plane(np.asarray(outline, float).reshape(4, 2), robot.height)
        if np.isfinite(place).all():
            x, y = place.mean(axis=0)
            found.append(Seen(int(number), float(x), float(y)))
    return tuple(found)


def hidden(camera: OverheadCamera, robot: Robot, seen: Seen) -> Bool[np.ndarray, "y x"]:
    """Pixels that show the robot's lid or its side, and not the floor."""
    cv2 = opencv()
    around = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    ring = robot.radius * np.stack([np.cos(around), np.sin(around)], axis=-1) + [seen.x, seen.y]
    levels = [
        np.column_stack([ring, np.full(len(ring), height)])
        for height in np.linspace(0, robot.height, 5)
    ]
    # what a cylinder hides is the hull of its rings, for it bulges nowhere
    outline = cv2.convexHull(camera.pixels(np.concatenate(levels)).astype(np.float32))
    width, height = camera.lens.image_px
    hull: Float[np.ndarray, "corner 2"] = np.asarray(outline, float).reshape(-1, 2)
    return filled(hull, height, width)
