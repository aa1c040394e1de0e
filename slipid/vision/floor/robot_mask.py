"""Robots in the picture, by the markers on them: what they hide of the floor."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from slipid.vision.camera import OverheadCamera
from slipid.vision.floor.grid import filled
from slipid.vision.opencv import marker_dictionary, opencv


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
