"""The overhead camera: where it hangs, and how its lens bends what it sees."""

from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field, FiniteFloat
from pydantic.dataclasses import dataclass

from slipid.support.toml_file import CLOSED, NotNegative, Positive

Tilt = Annotated[float, Field(ge=-10, le=10)]
"""[deg]."""


@dataclass(frozen=True, config=CLOSED)
class Camera:
    """A camera that looks down on the floor, its image turned by half a turn from the world's axes.

    Attributes:
        height_m: height of the lens above the floor.
        focal_px: focal length [pixel].
        width_px, height_px: size of the image.
        centre_m: where on the floor it hangs above, x and y.
        tilt_deg: about the image's x and y axes.
        distortion: k1, k2, p1, p2 of OpenCV's lens model.
        blur_px: std of the blur [pixel].
        noise: std of every pixel [grey levels of 255].
        flicker: how much the light changes within some seconds, as a part of it.
        exposure_s: how long a frame is exposed; what moves is seen twice, at both ends.
        frame_s: between frames.
    """

    height_m: Positive = 2.2
    focal_px: Positive = 1200.0
    width_px: Annotated[int, Field(gt=0)] = 1920
    height_px: Annotated[int, Field(gt=0)] = 1080
    centre_m: tuple[FiniteFloat, FiniteFloat] = (0.0, 0.0)
    tilt_deg: tuple[Tilt, Tilt] = (0.6, -0.4)
    distortion: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat] = (
        -0.06,
        0.02,
        0.0006,
        -0.0004,
    )
    blur_px: NotNegative = 0.8
    noise: NotNegative = 2.0
    flicker: NotNegative = 0.06
    exposure_s: NotNegative = 0.012
    frame_s: Positive = 1 / 29

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """OpenCV's camera matrix; the principal point is the middle of the image."""
        x, y = 0.5 * (self.width_px - 1), 0.5 * (self.height_px - 1)
        return np.array([[self.focal_px, 0.0, x], [0.0, self.focal_px, y], [0.0, 0.0, 1.0]])

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Rotation from the world to OpenCV's camera axes: x right, y down, z away."""
        a, b = np.radians(self.tilt_deg)
        down = np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
        about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
        about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
        return about_y @ about_x @ down

    @property
    def place(self) -> Float[np.ndarray, "3"]:
        """Place of the lens in the world [m]."""
        return np.array([*self.centre_m, self.height_m])

    def pixels(self, points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 2"]:
        """Pixels at which points of the world are seen."""
        import cv2

        turn, _ = cv2.Rodrigues(self.rotation)
        shift = -self.rotation @ self.place
        lens = np.array(self.distortion)
        seen, _ = cv2.projectPoints(np.asarray(points, float), turn, shift, self.matrix, lens)
        return seen[:, 0]

    def as_dict(self) -> dict[str, object]:
        """What a tracker has to know."""
        return {
            "schema": "slipid.camera/1",
            "image_px": [self.width_px, self.height_px],
            "matrix": self.matrix.tolist(),
            "distortion": list(self.distortion),
            "rotation_from_world": self.rotation.tolist(),
            "place_m": self.place.tolist(),
            "frame_s": self.frame_s,
        }
