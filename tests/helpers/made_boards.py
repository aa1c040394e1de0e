"""Pictures of a ChArUco board as a known camera sees it: a ray for each pixel, nothing fitted."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import cv2
import numpy as np

COLUMNS, ROWS, SQUARE, MARKER = 7, 5, 0.04, 0.03
DOTS = 40
"""Number of dots of the drawing along a square."""
FINE = 2
"""Number of rays along a pixel."""


@dataclass(frozen=True)
class TrueLens:
    """The lens that draws: OpenCV's model, written out.

    Attributes:
        width, height: of its pictures [pixel].
        fx, fy, cx, cy: [pixel].
        bend: k1, k2, p1, p2.
    """

    width: int = 640
    height: int = 480
    fx: float = 520.0
    fy: float = 523.0
    cx: float = 326.0
    cy: float = 233.0
    bend: tuple[float, float, float, float] = (-0.22, 0.06, 0.0012, -0.0008)

    def bent(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        k1, k2, p1, p2 = self.bend
        r2 = x * x + y * y
        wide = 1 + k1 * r2 + k2 * r2 * r2
        return (
            x * wide + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * wide + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return the pixels of points in the camera's axes."""
        x, y = self.bent(points[..., 0] / points[..., 2], points[..., 1] / points[..., 2])
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], -1)

    @cached_property
    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """x and y at distance 1 of every fine ray, by iterated inversion of the model."""
        u, v = (
            (np.arange(FINE * n, dtype=float) + 0.5) / FINE - 0.5 for n in (self.width, self.height)
        )
        u, v = np.meshgrid((u - self.cx) / self.fx, (v - self.cy) / self.fy)
        x, y = u.copy(), v.copy()
        for _ in range(12):
            bx, by = self.bent(x, y)
            x, y = x + u - bx, y + v - by
        return x, y


@dataclass(frozen=True)
class Light:
    """Light and flaws of a picture.

    Attributes:
        blur_px: blur of the lens [pixel].
        noise: standard deviation [of 255].
        falloff: share of the light that is missing at the right edge.
    """

    blur_px: float = 0.7
    noise: float = 3.0
    falloff: float = 0.35


@cache
def drawing(columns: int = COLUMNS, rows: int = ROWS, legacy: bool = False) -> np.ndarray:
    """Return the printed board with a white margin of one square."""
    book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((columns, rows), SQUARE, MARKER, book)
    board.setLegacyPattern(legacy)
    print_ = board.generateImage((columns * DOTS, rows * DOTS))
    return cv2.copyMakeBorder(print_, *[DOTS] * 4, cv2.BORDER_CONSTANT, value=235)


@dataclass(frozen=True, eq=False)
class Place:
    """Pose of the board (x right, y down, origin at its upper left) in the camera's axes."""

    rotation: np.ndarray
    shift: np.ndarray


def held(tilt_x: float, tilt_y: float, turn: float, middle: tuple[float, float, float]) -> Place:
    """Return a board with its middle at a point of the camera's axes [m], by angles [deg]."""
    rotation = np.eye(3)
    for axis, angle in (([0, 0, 1.0], turn), ([0, 1.0, 0], tilt_y), ([1.0, 0, 0], tilt_x)):
        rotation = cv2.Rodrigues(np.radians(angle) * np.array(axis))[0] @ rotation
    inside = 0.5 * SQUARE * np.array([COLUMNS, ROWS, 0])
    return Place(rotation, np.array(middle) - rotation @ inside)


def photo(
    lens: TrueLens,
    place: Place,
    seed: int,
    light: Light = Light(),
    print_: np.ndarray | None = None,
) -> np.ndarray:
    """Return a picture of the board, with equal blue, green and red."""
    print_ = drawing() if print_ is None else print_
    x, y = lens.rays
    # the plane is z' = 0 of the board: solve R^T (s ray - t) for s, then x' and y'
    back, start = place.rotation.T, place.rotation.T @ place.shift
    rays = [back[k, 0] * x + back[k, 1] * y + back[k, 2] for k in range(3)]
    depth = start[2] / rays[2]
    at = [((depth * rays[k] - start[k]) / SQUARE + 1) * DOTS - 0.5 for k in range(2)]
    at = [np.where(depth > 0, a, -1e4).astype(np.float32) for a in at]
    fine = cv2.remap(print_, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=120)
    image = cv2.resize(fine, (lens.width, lens.height), interpolation=cv2.INTER_AREA).astype(float)
    image = cv2.GaussianBlur(image, (0, 0), light.blur_px)
    image *= 1 - light.falloff * np.linspace(0, 1, lens.width)
    image += light.noise * np.random.default_rng(seed).standard_normal(image.shape)
    return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def places(count: int = 14, tilt: float = 32.0) -> list[Place]:
    """Return good views of the board: all over the picture, tilted about both axes."""
    spots = [(-0.16, -0.11), (0.16, -0.11), (-0.16, 0.11), (0.16, 0.11), (0.0, 0.0)]
    spots += [(0.0, -0.12), (0.0, 0.12), (-0.18, 0.0), (0.18, 0.0)]
    poses = []
    for k in range(count):
        angle = 2.4 * k
        x, y = spots[k % len(spots)]
        at = (x, y, 0.46 + 0.06 * (k % 3))
        lean = tilt * (0.6 + 0.4 * (k % 2))
        poses.append(held(lean * np.cos(angle), lean * np.sin(angle), 20.0 * (k % 5 - 2), at))
    return poses


def overhead(tilt_x: float, tilt_y: float, turn: float, place: tuple[float, float, float]) -> Place:
    """Return the pose of the board on the floor for a camera at a place in the world.

    The world's origin is the middle of the board, x along its columns, y up its rows, z up. Angles
    [deg] are those by which the camera is off from straight down with x to the right.
    """
    down = np.diag([1.0, -1.0, -1.0])
    rotation = down
    for axis, angle in (([0, 0, 1.0], turn), ([0, 1.0, 0], tilt_y), ([1.0, 0, 0], tilt_x)):
        rotation = cv2.Rodrigues(np.radians(angle) * np.array(axis))[0] @ rotation
    # world = down @ (board - middle), for down also turns the board's y and z about
    inside = 0.5 * SQUARE * np.array([COLUMNS, ROWS, 0])
    return Place(rotation @ down, -rotation @ (down @ inside + np.array(place)))


def from_world(board: Place) -> np.ndarray:
    """Return the rotation from the world of `overhead` to the camera's axes."""
    return board.rotation @ np.diag([1.0, -1.0, -1.0])


def write(image: np.ndarray, path: Path) -> Path:
    """Write a picture as a PNG file, and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    return path


def exif(orientation: int, order: str = "<") -> bytes:
    """Return EXIF data with an orientation flag, in little or big endian."""
    start = b"II*\0" if order == "<" else b"MM\0*"
    return start + struct.pack(order + "IHHHIHHI", 8, 1, 0x112, 3, 1, orientation, 0, 0)


def write_flagged(jpeg: bytes, orientation: int, path: Path) -> Path:
    """Write a JPEG with an EXIF orientation flag, and return its path."""
    block = b"Exif\0\0" + exif(orientation, "<" if orientation % 2 else ">")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + jpeg[2:])
    return path
