"""The overhead camera: its lens, its pose above the floor, and positions at a known height.

A pixel determines a ray, not a position. A point at height h above the floor lies where its ray
crosses the plane z = h. For a camera at height H that looks straight down, a marker at height h
appears H / (H - h) times as far from the point below the lens as it really is. If the position of a
robot's marker is computed as if it lay on the floor, every path length is too large by that factor
(12 % for h = 0.105 H). The marker itself appears too large by the same factor, which reveals the
mistake.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from slipid.camera.opencv import cv2, ideal_points
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.files import read_json, write_json
from slipid.support.quantities import Bounds, Coordinate, Height
from slipid.support.toml_file import Section, checked

SCHEMA = "slipid.camera/1"
Pixels = Annotated[int, Field(gt=0, le=100_000)]
Entry = Annotated[float, Bounds(-1e6, 1e6)]
Row = Annotated[list[Entry], Field(min_length=3, max_length=3)]
Coefficient = Annotated[float, Bounds(-1e4, 1e4)]
Three = Annotated[list[Row], Field(min_length=3, max_length=3)]


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens, by OpenCV's pinhole model with distortion.

    Attributes:
        image_px: width and height of its images [pixel].
        matrix: camera matrix, with focal lengths and principal point [pixel].
        distortion: coefficients k1, k2, p1, p2, k3, ... of OpenCV's distortion model.
    """

    image_px: tuple[int, int]
    matrix: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, " coefficient"]

    def to_json(self) -> Content:
        """Return the lens part of a camera file."""
        return {
            "schema": SCHEMA,
            "image_px": list(self.image_px),
            "matrix": self.matrix.tolist(),
            "distortion": self.distortion.tolist(),
        }

    def ideal(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Return pixels as undistorted image coordinates of a camera with focal length 1 [1]."""
        flat = np.ascontiguousarray(pixels, float).reshape(-1, 1, 2)
        if not len(flat):
            return flat.reshape(np.shape(pixels))
        return ideal_points(flat, self.matrix, self.distortion).reshape(np.shape(pixels))

    def check_size(self, image_px: tuple[int, int], source: Path | str) -> None:
        """Raise `DataError` unless images have the size at which the lens was calibrated.

        Raises:
            DataError: the size differs. The images cannot be adapted to the lens, since a smaller
                image may be either cropped or scaled.
        """
        if tuple(image_px) != tuple(self.image_px):
            w, h = self.image_px
            raise DataError(
                f"{source}: images of {image_px[0]} x {image_px[1]} pixels, but the camera was "
                f"calibrated at {w} x {h}; expected the same resolution: record at {w} x {h}, or "
                f"calibrate at {image_px[0]} x {image_px[1]}"
            )


@dataclass(frozen=True, eq=False)
class OverheadCamera:
    """A calibrated camera above a floor; the world's axes have z = 0 on the floor and z up.

    Attributes:
        lens: the lens.
        rotation: rotation from the world's axes to the camera's: x right, y down, z forward.
        place: position of the lens in the world [m].
        scale_std: relative std of lengths on the floor [1]; None if it is not known.
        report: report of the calibration, as in the camera file.
    """

    lens: Lens
    rotation: Float[np.ndarray, "3 3"]
    place: Float[np.ndarray, "3"]
    scale_std: float | None = None
    report: Content = field(default_factory=dict)

    @classmethod
    def straight_down(
        cls,
        image_px: tuple[int, int],
        metres_per_pixel: float,
        height_m: float,
        turn_deg: float = 0.0,
    ) -> "OverheadCamera":
        """Return a camera without distortion that looks straight down.

        The world's x points to the right in the image and y up; its origin is in the middle of
        the image.

        Args:
            image_px: width and height of the camera's images [pixel].
            metres_per_pixel: size of a pixel on the floor [m].
            height_m: height of the lens above the floor [m].
            turn_deg: angle by which the world's x and y are turned to the left in the image,
                about z [deg]; at 180, x points to the left in the image and y down.
        """
        focal, (width, height) = height_m / metres_per_pixel, image_px
        matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
        cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
        # columns are the world's x, y and z axes in the camera's axes: right, down, forward
        rotation = np.array([[cosine, -sine, 0], [-sine, -cosine, 0], [0, 0, -1]])
        return cls(Lens(image_px, matrix, np.zeros(4)), rotation, np.array([0.0, 0.0, height_m]))

    @property
    def height(self) -> float:
        """Height of the lens above the floor [m]."""
        return float(self.place[2])

    def pixels(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Return the pixels at which points in the world [m] appear."""
        flat = np.ascontiguousarray(points, float).reshape(-1, 1, 3)
        shape = (*np.shape(points)[:-1], 2)
        if not len(flat):
            return np.zeros(shape)
        turn = cv2.Rodrigues(self.rotation)[0]
        shift = -self.rotation @ self.place
        pixels = cv2.projectPoints(flat, turn, shift, self.lens.matrix, self.lens.distortion)[0]
        return np.asarray(pixels).reshape(shape)

    def on_plane(
        self, pixels: Float[np.ndarray, "*batch 2"], height_m: float
    ) -> Float[np.ndarray, "*batch 2"]:
        """Return x and y [m] of the points at a height [m] that appear at the given pixels.

        The coordinates are NaN where the ray of a pixel does not reach that height.
        """
        ideal = self.lens.ideal(pixels)
        rays = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1) @ self.rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (height_m - self.place[2]) / rays[..., 2:]
            xy = self.place[:2] + depth * rays[..., :2]
        return np.asarray(np.where(depth > 0, xy, np.nan))

    def to_json(self) -> Content:
        """Return the content of a camera file, which `load` can read."""
        return self.lens.to_json() | {
            "rotation_from_world": self.rotation.tolist(),
            "place_m": self.place.tolist(),
            "scale_std": self.scale_std,
            "report": self.report,
        }

    def save(self, path: Path | str) -> None:
        """Write the camera as a JSON file.

        Raises:
            DataError: the file cannot be written.
        """
        write_json(Path(path), self.to_json())

    @classmethod
    def load(cls, path: Path | str) -> "OverheadCamera":
        """Return the camera in a file that `slipid calibrate` or `slipid simulate` wrote.

        Raises:
            DataError: the file is absent, is not a camera file, or contains only a lens.
        """
        return read_camera(Path(path)).above_floor(path)


class CameraFile(Section):
    """Content of a camera file: a lens, and the camera's pose above the floor if it is known."""

    schema_: Literal["slipid.camera/1"] = Field(alias="schema")
    image_px: tuple[Pixels, Pixels]
    matrix: Three
    distortion: list[Coefficient] = Field(default_factory=list, max_length=14)
    rotation_from_world: Three | None = None
    place_m: tuple[Coordinate, Coordinate, Height] | None = None
    frame_s: Annotated[float, Field(gt=0, le=1e5)] | None = None
    scale_std: Annotated[float, Field(ge=0, le=1)] | None = None
    report: Content = Field(default_factory=dict)

    @model_validator(mode="after")
    def _possible(self) -> "CameraFile":
        """Raise `ValueError` for values that no camera can have."""
        (fx, skew, cx), (zero, fy, cy), last = self.matrix
        (width, height_px), near = self.image_px, True
        for middle, size in ((cx, width), (cy, height_px)):
            near = near and -size <= middle <= 2 * size
        if not (min(fx, fy) >= 1 and near and skew == zero == 0 and last == [0, 0, 1]):
            raise ValueError(
                f"matrix {self.matrix}; expected [[f, 0, x], [0, f, y], [0, 0, 1]] in pixels, f "
                "above 1, x and y in the image or near it"
            )
        if (count := len(self.distortion)) not in (0, 4, 5, 8, 12, 14):
            raise ValueError(f"{count} distortion coefficients; expected 4, 5, 8, 12 or 14")
        if self.rotation_from_world is None or self.place_m is None:
            return self
        rotation, height = np.array(self.rotation_from_world), self.place_m[2]
        right_handed = np.linalg.det(rotation) > 0
        if not (right_handed and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)):
            raise ValueError(
                "rotation_from_world is not a rotation; expected an orthonormal matrix with "
                "determinant 1"
            )
        if not (height > 0 and rotation[2, 2] < 0):
            raise ValueError(
                f"the camera is {height:g} m high and "
                f"{'looks up' if rotation[2, 2] >= 0 else 'looks down'}; expected a camera above "
                "the floor (z up) that looks down"
            )
        return self

    @property
    def lens(self) -> Lens:
        """The lens."""
        distortion = np.array(self.distortion or [0.0] * 4)
        return Lens(self.image_px, np.array(self.matrix), distortion)

    def above_floor(self, path: Path | str) -> OverheadCamera:
        """Return the camera; raise `DataError` if the file `path` contains only a lens."""
        if self.rotation_from_world is None or self.place_m is None:
            raise DataError(
                f"{path}: a lens without a pose above the floor; expected rotation_from_world and "
                "place_m: `slipid calibrate --camera FILE --floor PICTURE` adds them"
            )
        rotation, place = np.array(self.rotation_from_world), np.array(self.place_m)
        return OverheadCamera(self.lens, rotation, place, self.scale_std, self.report)


def read_camera(path: Path) -> CameraFile:
    """Return the checked content of a camera file.

    Raises:
        DataError: the file is absent, is not a camera file, or has values that no camera can have.
    """
    expected = "a camera file (slipid.camera/1) that `slipid calibrate` wrote"
    return checked(path, read_json(path, expected), CameraFile)
