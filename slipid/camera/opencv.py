"""OpenCV, imported when first needed, with wrappers for what differs in its versions 4 and 5."""

import os
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from slipid.support.errors import DataError, did_you_mean
from slipid.support.extras import missing

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
"""File suffixes by which images are recognised in folders and next to videos; an image file that a
user gives directly for camera calibration may have any suffix."""
NEARLY_MOST = 0.8
"""Fraction of the best dictionary's marker count [1]: of all dictionaries that detect at least this
fraction, the smallest one is chosen."""
MOST_PIXELS = 200_000_000
"""Largest number of pixels of an image or a frame; it limits the memory that a file can claim."""
Mask = Bool[np.ndarray, "row column"]
"""Boolean mask over the pixels of an image or the cells of a grid."""
Labels = Int[np.ndarray, "row column"]
"""Number of the surface or patch in each cell of a grid."""
Grey = UInt8[np.ndarray, "row column"]
"""Grey levels of an image, from 0 to 255."""


@cache
def _opencv() -> ModuleType:
    """Return the module cv2, with OpenCV's own messages about unreadable files switched off.

    Raises:
        DataError: OpenCV is absent, too old, or built without its ArUco module.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # must be set before cv2 is loaded
    try:
        import cv2
    except ImportError as error:
        raise missing("camera", "an image", error) from error
    if not hasattr(getattr(cv2, "aruco", None), "CharucoDetector"):
        raise DataError(
            f"OpenCV {cv2.__version__} has no marker detector; expected version 4.8 or newer of "
            "opencv-contrib-python-headless, and no other installed build of OpenCV"
        )
    log = getattr(getattr(cv2, "utils", None), "logging", None)
    if log is not None:
        # slipid's own messages tell the user what is wrong with a file
        log.setLogLevel(log.LOG_LEVEL_SILENT)
    return cv2


class _LoadedOnUse:
    """The module cv2, loaded when one of its attributes is first used; see `_opencv`."""

    def __getattr__(self, name: str) -> Any:
        return getattr(_opencv(), name)


cv2: Any = _LoadedOnUse()


def dictionary_names() -> list[str]:
    """Return the names of OpenCV's marker dictionaries, such as `4X4_50`."""
    prefix = "DICT_"
    names = dir(cv2.aruco)
    return sorted(name.removeprefix(prefix) for name in names if name.startswith(prefix))


def marker_dictionary(name: str) -> Any:
    """Return OpenCV's marker dictionary with a name such as `4X4_50` or `DICT_4X4_50`.

    Raises:
        DataError: no dictionary has that name.
    """
    short = name.upper().removeprefix("DICT_")
    names = dictionary_names()
    if short not in names:
        hint = did_you_mean(short, names)
        raise DataError(f"no marker dictionary '{name}'{hint}; expected one of {', '.join(names)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{short}"))


def marker_count(dictionary: str) -> int:
    """Return the number of markers in a dictionary."""
    return len(marker_dictionary(dictionary).bytesList)


def visible_markers(pictures: Sequence[np.ndarray]) -> tuple[str, list[int]]:
    """Find the dictionary of the markers in images; return its name and the markers' numbers.

    The smallest dictionary is chosen that detects at least the fraction `NEARLY_MOST` of the number
    of markers that the best dictionary detects.
    """
    numbers: dict[str, set[int]] = {}
    for name in dictionary_names():
        detector = cv2.aruco.ArucoDetector(marker_dictionary(name))
        ids = [detector.detectMarkers(np.ascontiguousarray(one))[1] for one in pictures if one.size]
        numbers[name] = {int(n) for one in ids if one is not None for n in np.ravel(one)}
    # a large dictionary contains the markers of smaller ones and detects a few more by chance, so
    # do not simply choose the dictionary with the most detections
    most = max(map(len, numbers.values()))
    best = min((n for n in numbers if len(numbers[n]) >= NEARLY_MOST * most), key=marker_count)
    return best, sorted(numbers[best])


def is_picture(path: Path) -> bool:
    """Return whether a file is an image, judged by its suffix."""
    return path.suffix.lower() in SUFFIXES


def pictures_in(folder: Path) -> list[Path]:
    """Return the images in a folder, sorted by name; raise `DataError` if there is none."""
    if paths := sorted(filter(is_picture, folder.iterdir())):
        return paths
    raise DataError(f"{folder}: no image; expected {', '.join(SUFFIXES)}")


def read_picture(path: Path) -> np.ndarray:
    """Return the image in a file, indexed by row, column and channel: blue, green, red, 0 to 255.

    Raises:
        DataError: the file is absent, empty or not an image.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; expected an image") from error
    if not data:
        raise DataError(f"{path}: the file is empty; expected an image (PNG, JPEG, ...)")
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        # OpenCV raises for images that are too large, and returns None for other unreadable files
        picture = None
    if picture is None:
        raise DataError(f"{path}: not an image that OpenCV reads; expected a PNG or JPEG file")
    return np.asarray(picture)


def check_pixels(path: Path, width: int, height: int) -> None:
    """Raise `DataError` if the images in a file have too many pixels, or none."""
    if not 0 < width * height <= MOST_PIXELS:
        raise DataError(
            f"{path}: {width} x {height} pixels; expected {MOST_PIXELS // 10**6} million at most"
        )


def size_of(picture: np.ndarray) -> tuple[int, int]:
    """Return width and height of an image [pixel]."""
    return int(picture.shape[1]), int(picture.shape[0])


def ideal_points(
    pixels: Float[np.ndarray, "point 1 2"],
    matrix: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, " coefficient"],
) -> Float[np.ndarray, "point 1 2"]:
    """Return pixels as normalised image coordinates, for focal length 1 and without distortion [1].

    The distortion is inverted by iteration to convergence.
    """
    # up to 50 iterations, or until the reprojection error is below 1e-12
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
    iterated = getattr(cv2, "undistortPointsIter", None)
    if iterated is not None:  # OpenCV 4
        return np.asarray(iterated(pixels, matrix, distortion, None, None, until))
    return np.asarray(cv2.undistortPoints(pixels, matrix, distortion, None, None, None, until))
