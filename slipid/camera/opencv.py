"""OpenCV, imported when first needed, with wrappers for what differs in its versions 4 and 5."""

import os
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from slipid.support.errors import DataError, did_you_mean
from slipid.support.extras import missing

MOST_PIXELS = 200_000_000
"""Largest number of pixels of an image or a frame; it limits the memory a file can claim."""
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
    # both must be set before cv2 is loaded
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))
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
    names = [name.removeprefix(prefix) for name in dir(cv2.aruco) if name.startswith(prefix)]
    # OpenCV 5 has some of them twice, with letters in upper and lower case
    return sorted({name.upper(): name for name in names}.values())


def marker_dictionary(name: str) -> Any:
    """Return OpenCV's marker dictionary with a name such as `4X4_50` or `DICT_4X4_50`.

    Raises:
        DataError: no dictionary has that name.
    """
    short = name.upper().removeprefix("DICT_")
    names = {known.upper(): known for known in dictionary_names()}
    if short not in names:
        hint = did_you_mean(short, names)
        expected = ", ".join(names.values())
        raise DataError(f"no marker dictionary '{name}'{hint}; expected one of {expected}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{names[short]}"))


def marker_count(dictionary: str) -> int:
    """Return the number of markers in a dictionary."""
    return len(marker_dictionary(dictionary).bytesList)


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
