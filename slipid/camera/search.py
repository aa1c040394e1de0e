"""Search for markers of any dictionary, upright or mirrored.

Searching a large image for each dictionary would take minutes. The image is searched once for
squares that may be markers; these are copied upright onto a small sheet, and each dictionary is
searched for there.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slipid.camera.frame import grey_of
from slipid.camera.opencv import (
    Grey,
    cv2,
    dictionary_names,
    marker_count,
    marker_dictionary,
)
from slipid.support.progress import Tell, silent

MOST_SEARCHED = 16_000_000
"""Number of pixels above which a smaller copy of an image is searched."""
MOST_CANDIDATES = 200
"""Largest number of candidates, the largest ones in the image, that are compared with all
dictionaries."""
SMALL_PIXELS = 1_200_000
"""Number of pixels of a small copy of an image."""
PATCH, MARGIN = 72, 18
"""Edge length of a candidate and width of the white margin around it in a sheet [pixel]."""
NEARLY_MOST = 0.8
"""Fraction of the best dictionary's marker count [1]: of all dictionaries that detect at least this
fraction, the smallest one is chosen."""
MIRRORED = (
    "can be read only mirrored; expected pixels as the sensor recorded them: switch off the "
    "camera's mirroring, or flip the recording back"
)
"""End of a sentence about markers in a mirrored image."""


@dataclass(frozen=True)
class VisibleMarkers:
    """Markers in images.

    Attributes:
        dictionary: name of their dictionary.
        numbers: their numbers, sorted; empty if there are no markers.
        mirrored: True if they were read in the mirrored images.
    """

    dictionary: str
    numbers: tuple[int, ...]
    mirrored: bool


def small(picture: np.ndarray, pixels: int = SMALL_PIXELS) -> Grey:
    """Return the grey levels of an image, in a copy of that many `pixels` if it has more."""
    grey = grey_of(picture)
    scale = (pixels / max(grey.size, 1)) ** 0.5
    if scale >= 1:
        return grey
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def mirror_image(picture: np.ndarray) -> np.ndarray:
    """Return an image with its columns in reverse order."""
    return np.ascontiguousarray(picture[:, ::-1])


def visible_markers(pictures: Sequence[np.ndarray], tell: Tell = silent) -> VisibleMarkers:
    """Return the markers in images, whatever their dictionary is.

    The smallest dictionary is chosen that detects at least the fraction `NEARLY_MOST` of the number
    of markers that the best dictionary detects. A large dictionary contains the markers of smaller
    ones and detects a few more by chance, so the one with the most detections may be wrong.

    Args:
        pictures: the images.
        tell: function to call with the finished and the total number of steps.
    """
    sheets = [sheet for one in pictures if (sheet := _sheet(one)) is not None]
    numbers: dict[tuple[str, bool], set[int]] = {}
    exact = cv2.aruco.DetectorParameters()
    exact.errorCorrectionRate = 0.0  # with corrected bits, markers of other dictionaries would fit
    # only whole patches: noise inside of them has many small squares
    longest = max((max(one.shape) for one in sheets), default=1)
    exact.minMarkerPerimeterRate = 2.5 * PATCH / longest
    families = _families()
    for done, members in enumerate(families):
        tell(done, len(families))
        detector = cv2.aruco.ArucoDetector(marker_dictionary(max(members, key=marker_count)), exact)
        for mirrored in (False, True):
            turned = map(mirror_image, sheets) if mirrored else sheets
            ids = [detector.detectMarkers(one)[1] for one in turned]
            every = {int(n) for one in ids if one is not None for n in np.ravel(one)}
            for name in members:
                numbers[name, mirrored] = {n for n in every if n < marker_count(name)}
    tell(len(families), len(families))
    most = max(map(len, numbers.values()))
    likely = [key for key in numbers if len(numbers[key]) >= NEARLY_MOST * most]
    name, mirrored = min(likely, key=lambda key: (marker_count(key[0]), key[1]))
    return VisibleMarkers(name, tuple(sorted(numbers[name, mirrored])), mirrored)


def _sheet(picture: np.ndarray) -> Grey | None:
    """Return the squares in an image that may be markers, upright; None without any."""
    grey = small(picture, MOST_SEARCHED)
    if not grey.size:
        return None
    # any dictionary will do: squares that are none of its markers are returned as rejected
    settings = cv2.aruco.DetectorParameters()
    # by default only the outermost of nested squares is returned: the edge of the white margin
    settings.minMarkerDistanceRate = 0.001
    detector = cv2.aruco.ArucoDetector(marker_dictionary("4X4_50"), settings)
    found, _, rejected = detector.detectMarkers(grey)
    squares = [np.asarray(one, np.float32).reshape(4, 2) for one in (*found, *rejected)]
    squares.sort(key=lambda one: -cv2.contourArea(one))
    corners = np.array([[0, 0], [PATCH, 0], [PATCH, PATCH], [0, PATCH]], np.float32) - 0.5
    patches = []
    for square in squares:
        turn = cv2.getPerspectiveTransform(square, corners)
        patch = cv2.warpPerspective(grey, turn, (PATCH, PATCH), borderMode=cv2.BORDER_REPLICATE)
        if _like_a_marker(patch):
            white = int(patch.max())
            patches.append(
                cv2.copyMakeBorder(patch, *[MARGIN] * 4, cv2.BORDER_CONSTANT, value=white)
            )
        if len(patches) == MOST_CANDIDATES:
            break
    if not patches:
        return None
    columns = int(np.ceil(len(patches) ** 0.5))
    patches += [np.full_like(patches[0], 255)] * (-len(patches) % columns)
    rows = [np.hstack(patches[k : k + columns]) for k in range(0, len(patches), columns)]
    return np.vstack(rows)


def _like_a_marker(patch: Grey) -> bool:
    """Return whether a square has a dark border, and both dark and bright parts inside."""
    low, high = int(patch.min()), int(patch.max())
    dark = patch < (low + high) / 2
    edge = PATCH // 12  # less than the border of a marker with 7 x 7 bits
    inside = dark[2 * edge : -2 * edge, 2 * edge : -2 * edge].mean()
    border = (dark.sum() - dark[edge:-edge, edge:-edge].sum()) / (4 * edge * (PATCH - edge))
    return bool(high - low > 30 and border > 0.75 and 0.05 < inside < 0.98)


def _families() -> list[list[str]]:
    """Return the names of all dictionaries, those of one list with the same first markers."""
    families: dict[str, list[str]] = {}
    for name in dictionary_names():
        families.setdefault(re.sub(r"^(\dX\d)_\d+$", r"\1", name), []).append(name)
    return list(families.values())
