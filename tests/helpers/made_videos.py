"""Videos of marked robots under a known camera: a ray for each pixel, nothing fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property

import cv2
import numpy as np

from slipid.camera.overhead import Lens, OverheadCamera
from tests.helpers.made_boards import FINE, TrueLens, from_world, overhead

DOTS = 24
"""Number of dots of the drawing along one of the marker's squares."""
FPS = 30.0
AREA = cv2.INTER_AREA
SHIFT = 41
"""Largest shift of the noise of a frame along each edge [pixel]."""


@dataclass(frozen=True)
class Printed:
    """A printed marker with a white margin of one of its squares, somewhere on a body.

    Attributes:
        size, height: edge of the black square and its height above the floor [m].
        ahead, left: its middle on the body [m].
        yaw: angle of its top edge, counter-clockwise from ahead [rad].
    """

    id: int = 0
    size: float = 0.131
    height: float = 0.25
    ahead: float = 0.0
    left: float = 0.0
    yaw: float = 0.0
    dictionary: str = "4X4_50"

    @property
    def squares(self) -> int:
        """Number of squares along the black square's edge."""
        return int(self.dictionary[0]) + 2

    def middle(self, pose: np.ndarray) -> np.ndarray:
        """Return its middle in the world [m]."""
        c, s = np.cos(pose[2]), np.sin(pose[2])
        flat = pose[:2] + np.array([[c, -s], [s, c]]) @ (self.ahead, self.left)
        return np.array([*flat, self.height])


@dataclass(frozen=True)
class Box:
    """A rectangle of a picture [pixel]."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def width(self) -> int:
        return self.x1 - self.x0

    @property
    def height(self) -> int:
        return self.y1 - self.y0

    @property
    def rows(self) -> slice:
        return slice(self.y0, self.y1)

    @property
    def columns(self) -> slice:
        return slice(self.x0, self.x1)

    @property
    def fine(self) -> tuple[slice, slice]:
        """Rows and columns of its fine rays."""
        return (
            slice(FINE * self.y0, FINE * self.y1),
            slice(FINE * self.x0, FINE * self.x1),
        )


@cache
def _drawn(id: int, dictionary: str) -> np.ndarray:
    book = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
    edge = (int(dictionary[0]) + 2) * DOTS
    drawn = 30 + cv2.aruco.generateImageMarker(book, id, edge) // 255 * 195
    return cv2.copyMakeBorder(drawn, *[DOTS] * 4, cv2.BORDER_CONSTANT, value=225)


@dataclass(frozen=True)
class Light:
    """Light and flaws of a frame.

    Attributes:
        exposure_s: time over which it is smeared [s].
        blur_px: blur of the lens [pixel].
        noise: standard deviation [of 255].
        falloff: part of the light that is missing at the right edge.
        flicker: part by which the light varies.
        bright: factor of all light.
    """

    exposure_s: float = 0.008
    blur_px: float = 0.7
    noise: float = 2.5
    falloff: float = 0.3
    flicker: float = 0.06
    bright: float = 1.0


@cache
def lens_of(width: int, focal: float | None = None, bend: float = -0.08) -> TrueLens:
    """Return a lens for 16:9 pictures, by default of focal length 1200 pixel at 1080p."""
    height = round(width * 9 / 16)
    f = width * 1200 / 1920 if focal is None else focal
    return TrueLens(
        *(width, height, f, 1.002 * f, 0.505 * width, 0.493 * height),
        bend=(bend, -0.25 * bend, 0.0006, -0.0004),
    )


@dataclass(frozen=True, eq=False)
class Stage:
    """A camera, its light and the floor below it.

    Attributes:
        tilt: angles about the picture's axes and about the vertical [deg].
        place: place of the lens in the world [m].
    """

    lens: TrueLens = field(default_factory=lambda: lens_of(640))
    tilt: tuple[float, float, float] = (2.0, -3.0, 10.0)
    place: tuple[float, float, float] = (0.1, -0.05, 2.2)
    light: Light = field(default_factory=Light)
    seed: int = 0

    @cached_property
    def rotation(self) -> np.ndarray:
        return from_world(overhead(*self.tilt, self.place))

    @cached_property
    def camera(self) -> OverheadCamera:
        lens = self.lens
        matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
        known = Lens((lens.width, lens.height), matrix, np.array(lens.bend))
        return OverheadCamera(known, self.rotation, np.array(self.place))

    @cached_property
    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """x and y in the world of every fine ray one metre below the lens."""
        x, y = self.lens.rays
        ray = np.stack([x, y, np.ones_like(x)], -1) @ self.rotation
        return -ray[..., 0] / ray[..., 2], -ray[..., 1] / ray[..., 2]

    @cached_property
    def floor(self) -> np.ndarray:
        """Fine picture of the empty floor: patches with a grain."""
        rng = np.random.default_rng(self.seed)
        x, y = (self.place[k] + self.place[2] * self.rays[k] for k in range(2))
        coarse = rng.uniform(70, 150, (16, 16))
        patches = coarse[(4 * x).astype(int) % 16, (4 * y).astype(int) % 16]
        return np.clip(patches + rng.normal(0, 9, x.shape), 0, 255).astype(np.float32)

    @cached_property
    def grain(self) -> np.ndarray:
        rng = np.random.default_rng(self.seed + 1)
        size = (self.lens.height + SHIFT, self.lens.width + SHIFT)
        return self.light.noise * rng.standard_normal(size, np.float32)

    @cached_property
    def empty(self) -> np.ndarray:
        """The empty floor as the lens blurs it."""
        small = cv2.resize(self.floor, (self.lens.width, self.lens.height), None, 0, 0, AREA)
        return cv2.GaussianBlur(small, (0, 0), max(self.light.blur_px, 1e-3))

    @cached_property
    def shade(self) -> np.ndarray:
        across = np.linspace(0, 1, self.lens.width, dtype=np.float32)
        return self.light.bright * (1 - self.light.falloff * across)

    def _box(self, marker: Printed, poses: Sequence[np.ndarray]) -> Box:
        """Return the pixels that a marker covers at some poses, with room for blur."""
        corners = []
        for pose in poses:
            away = self.rotation @ (marker.middle(pose) - np.array(self.place))
            half = marker.size * self.lens.fx / away[2] + 8 + 4 * self.light.blur_px
            corners += [self.lens.project(away) - half, self.lens.project(away) + half]
        limit = np.array([self.lens.width, self.lens.height])
        low, high = (np.clip(f(corners, axis=0), 0, limit).astype(int) for f in (np.min, np.max))
        return Box(*low.tolist(), *high.tolist())

    def _put(self, fine: np.ndarray, box: Box, marker: Printed, pose: np.ndarray) -> None:
        """Draw a marker into a fine part of the picture."""
        middle, down = marker.middle(pose), self.place[2] - marker.height
        x, y = (self.place[k] + down * self.rays[k][box.fine] - middle[k] for k in range(2))
        turn = pose[2] + marker.yaw
        ahead, left = np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
        dots, middle_dot = marker.squares * DOTS / marker.size, 0.5 * (marker.squares + 2) * DOTS
        at = [(middle_dot - dots * a - 0.5).astype(np.float32) for a in (left, ahead)]
        drawn = _drawn(marker.id, marker.dictionary)
        picture = cv2.remap(drawn, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        edge = middle_dot / dots
        inside = (np.abs(ahead) < edge) & (np.abs(left) < edge)
        np.copyto(fine, picture, where=inside, casting="unsafe")

    def _draw(self, total: np.ndarray, marker: Printed, poses: Sequence[np.ndarray]) -> None:
        """Draw a marker, smeared over some poses, into a picture."""
        box = self._box(marker, poses)
        if box.width <= 0 or box.height <= 0:
            return
        fine = np.zeros((FINE * box.height, FINE * box.width), np.float32)
        for pose in poses:
            part = self.floor[box.fine].copy()
            self._put(part, box, marker, pose)
            fine += part / len(poses)
        small = cv2.resize(fine, (box.width, box.height), None, 0, 0, AREA)
        total[box.rows, box.columns] = cv2.GaussianBlur(
            small, (0, 0), max(self.light.blur_px, 1e-3)
        )

    def frame(self, time: float, bodies: Sequence[Body]) -> np.ndarray:
        """Return a frame whose exposure is centred on a time; markers lie well apart."""
        light, (w, h) = self.light, (self.lens.width, self.lens.height)
        steps = (-0.375, -0.125, 0.125, 0.375) if light.exposure_s > 0 else (0.0,)
        total = self.empty.copy()
        for body in bodies:
            poses = [body.pose_at(time + step * light.exposure_s) for step in steps]
            for marker in body.markers:
                self._draw(total, marker, poses)
        total *= self.shade * np.float32(1 + light.flicker * np.sin(2 * np.pi * time / 1.7))
        row, column = np.random.default_rng(round(1e4 * time)).integers(SHIFT, size=2)
        total += self.grain[row : row + h, column : column + w]
        return cv2.convertScaleAbs(np.maximum(total, 0, out=total))

    def film(self, bodies: Sequence[Body], count: int, fps: float = FPS) -> list[np.ndarray]:
        """Return frames from time 0 on."""
        return [self.frame(k / fps, bodies) for k in range(count)]


@dataclass(frozen=True, eq=False)
class Body:
    """Markers that drive together; x, y [m], heading [rad] at a time [s]."""

    pose_at: Callable[[float], np.ndarray]
    markers: tuple[Printed, ...] = (Printed(),)

    def poses(self, count: int, fps: float = FPS) -> np.ndarray:
        return np.array([self.pose_at(k / fps) for k in range(count)])
