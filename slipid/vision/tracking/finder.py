"""Find markers in a frame: near where they were, and in all of it now and then.

OpenCV looks through a whole frame in tens of milliseconds and through the surroundings of a marker
in one. Where every marker that was seen last is found again near its expected place, nothing else
is looked at, except in every `WHOLE`-th frame, in which a second marker of the same number shows.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

from slipid.vision.opencv import marker_dictionary, opencv

WHOLE = 30
"""Every so many frames all of the frame is looked at."""
AROUND = 0.7
"""Margin around the expected place, as a part of the marker's size in the picture."""
LEAST_AROUND = 12.0
"""Least margin [pixel]: corners are refined in windows of some pixels."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """A marker in a frame.

    Attributes:
        id: its number.
        corners: x, y [pixel] of top left, top right, bottom right, bottom left.
    """

    id: int
    corners: Float[np.ndarray, "corner 2"]

    @property
    def middle(self) -> Float[np.ndarray, "2"]:
        """Mean of the corners [pixel]."""
        return np.asarray(self.corners.mean(axis=0))


@dataclass(frozen=True)
class Region:
    """A part of the picture, from one pixel up to, and without, another."""

    left: int
    top: int
    right: int
    bottom: int

    def within(self, other: "Region") -> "Region":
        """What it has in common with another; empty where that is nothing."""
        left, top = max(self.left, other.left), max(self.top, other.top)
        right, bottom = min(self.right, other.right), min(self.bottom, other.bottom)
        return Region(left, top, max(left, right), max(top, bottom))

    @property
    def empty(self) -> bool:
        """Whether no pixel is in it."""
        return self.right <= self.left or self.bottom <= self.top


class MarkerDetector:
    """OpenCV's detector of the markers of a dictionary, with corners refined below a pixel.

    Raises:
        DataError: no dictionary of that name, or no OpenCV.
    """

    def __init__(self, dictionary: str):
        aruco = opencv().aruco
        parameters = aruco.DetectorParameters()
        parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
        # windows of 5 pixels; corners of markers that are small in the picture have smaller ones
        parameters.cornerRefinementWinSize = 5
        parameters.cornerRefinementMinAccuracy = 0.01
        self._detector = aruco.ArucoDetector(marker_dictionary(dictionary), parameters)

    def find(
        self, grey: UInt8[np.ndarray, "row column"], region: Region | None = None
    ) -> list[Sighting]:
        """Every marker in a frame, or in a part of it."""
        shift = np.zeros(2)
        if region is not None:
            region = region.within(Region(0, 0, grey.shape[1], grey.shape[0]))
            if region.empty:
                return []
            grey = np.ascontiguousarray(
                grey[region.top : region.bottom, region.left : region.right]
            )
            shift = np.array([region.left, region.top], float)
        corners, ids, _ = self._detector.detectMarkers(grey)
        if ids is None:
            return []
        numbers = np.asarray(ids).ravel().tolist()
        return [
            Sighting(number, np.asarray(found, float).reshape(4, 2) + shift)
            for number, found in zip(numbers, corners, strict=True)
        ]


@dataclass(eq=False)
class Finder:
    """Follows markers from frame to frame.

    Attributes:
        detector: what finds them.
        ids: numbers of the markers that are wanted.
        region: the part of the picture that counts.
        last: where each wanted marker was seen last.
        speed: how far its middle moved in the frame before [pixel].
        whole: frames that were looked at as a whole.
        twice: whether a marker was seen twice in the last of them; then all of the next is looked
            at, too, lest the wrong one is followed.
    """

    detector: MarkerDetector
    ids: frozenset[int]
    region: Region | None = None
    last: dict[int, Sighting] = field(default_factory=dict)
    speed: dict[int, Float[np.ndarray, "2"]] = field(default_factory=dict)
    whole: int = 0
    twice: bool = False

    def find(self, grey: UInt8[np.ndarray, "row column"], number: int) -> list[Sighting]:
        """The wanted markers in the frame of this number; each as often as it is seen."""
        if self.last and not self.twice and number % WHOLE:
            near = [s for s in self.detector.find(grey, self._around()) if s.id in self.ids]
            if {s.id for s in near} >= set(self.last):
                self._follow(near)
                return near
        found = [s for s in self.detector.find(grey, self.region) if s.id in self.ids]
        self.whole += 1
        self.twice = len({s.id for s in found}) < len(found)
        self._follow(found)
        return found

    def _around(self) -> Region:
        """Where the markers that were seen last are expected."""
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        for number, seen in self.last.items():
            corners = seen.corners + self.speed.get(number, np.zeros(2))
            moved = np.abs(self.speed.get(number, np.zeros(2)))
            margin = max(LEAST_AROUND, AROUND * float(np.ptp(corners, axis=0).max())) + moved
            low = np.minimum(low, corners.min(axis=0) - margin)
            high = np.maximum(high, corners.max(axis=0) + margin)
        left, top = np.floor(low).astype(int).tolist()
        right, bottom = np.ceil(high).astype(int).tolist()
        around = Region(left, top, right + 1, bottom + 1)
        return around if self.region is None else around.within(self.region)

    def _follow(self, found: Sequence[Sighting]) -> None:
        """Remember where each marker is; of several of one number the nearest to the last place."""
        chosen = _nearest(found, self.last)
        self.speed = {
            number: seen.middle - self.last[number].middle
            for number, seen in chosen.items()
            if number in self.last
        }
        self.last = chosen


def _nearest(found: Iterable[Sighting], last: Mapping[int, Sighting]) -> dict[int, Sighting]:
    out: dict[int, Sighting] = {}
    for seen in found:
        other = out.get(seen.id)
        if other is None:
            out[seen.id] = seen
        elif seen.id in last:
            middle = last[seen.id].middle
            if np.linalg.norm(seen.middle - middle) < np.linalg.norm(other.middle - middle):
                out[seen.id] = seen
    return out
