"""Find markers in a frame: near where they were, and in all of it now and then.

OpenCV looks through a whole frame in tens of milliseconds and through the surroundings of a marker
in one. Where every wanted marker was seen last and is found again near its expected place, nothing
else is looked at, except in every `WHOLE`-th frame, in which a second marker of the same number
shows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

from slipid.camera.opencv import marker_dictionary, opencv
from slipid.camera.tracking.outliers import refined

WHOLE = 30
"""Every so many frames all of the frame is looked at."""
AROUND = 0.7
"""Margin around the expected place, as a part of the marker's size in the picture."""
LEAST_AROUND = 12.0
"""Least margin [pixel]: the detector passes over what touches the border."""


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
        book = marker_dictionary(dictionary)
        self._squares = int(book.markerSize) + 2
        self._detector = opencv().aruco.ArucoDetector(book)

    def find(
        self, grey: UInt8[np.ndarray, "row column"], region: Region | None = None
    ) -> list[Sighting]:
        """Every marker in a frame, or in a part of it."""
        whole = Region(0, 0, grey.shape[1], grey.shape[0])
        part = whole if region is None else region.within(whole)
        if part.empty:
            return []
        looked = np.ascontiguousarray(grey[part.top : part.bottom, part.left : part.right])
        corners, ids, _ = self._detector.detectMarkers(looked)
        if ids is None or not len(ids):
            return []
        shift = np.array([part.left, part.top])
        rough = np.asarray(corners, float).reshape(-1, 4, 2) + shift
        numbers = np.asarray(ids).ravel().tolist()
        fine = refined(grey, rough, self._squares)
        return [Sighting(number, fine[k]) for k, number in enumerate(numbers)]


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
        twice: whether a marker was seen twice in the frame before; then all of the next is looked
            at, lest the wrong one is followed.
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
        if self.ids == self.last.keys() and not self.twice and number % WHOLE:
            near = [s for s in self.detector.find(grey, self._around()) if s.id in self.ids]
            if self.ids == {s.id for s in near}:
                self._follow(near)
                return near
        found = [s for s in self.detector.find(grey, self.region) if s.id in self.ids]
        self.whole += 1
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
        """Remember where each marker is."""
        seen = {one.id: one for one in found}
        self.twice = len(seen) < len(found)
        self.speed = {
            number: one.middle - self.last[number].middle
            for number, one in seen.items()
            if number in self.last
        }
        self.last = seen
