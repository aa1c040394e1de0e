"""Detection of markers in frames, near their last position and periodically in the whole frame.

OpenCV searches a whole frame in tens of milliseconds, but the surroundings of a marker in one
millisecond. If every tracked marker was detected in the last frame and is detected again near its
expected position, the rest of the frame is skipped. Every `WHOLE_INTERVAL`-th frame is searched
completely, so that a second marker of the same number is detected.

Corners are refined to less than a pixel as intersections of straight lines fitted to the four
edges. Refining each corner by itself is inaccurate for a small marker: the window around the corner
contains the marker's inner pattern, which shifts all four corners in a way that looks like a
rotation of the marker. An edge is visible over its whole length. Across it, from the black border
to the white margin, brightness rises from one level to another, and the area below that profile
gives the position of the edge for any blur by the lens or by motion.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

from slipid.camera.opencv import Grey, cv2, marker_dictionary, size_of

WHOLE_INTERVAL = 30
"""Interval, in frames, at which the whole frame is searched."""
MARGIN = 0.7
"""Margin of the search region around a marker's expected position, relative to the marker's size in
the image [1]."""
LEAST_MARGIN = 12.0
"""Smallest margin of the search region [pixel]; it is needed because the detector ignores markers
at the region's border."""
REFINEMENTS = 3
"""Number of iterations in which edges are sampled and corners refined, starting from corners with
errors of about a pixel."""
ALONG, ACROSS = 20, 11
"""Number of brightness profiles along an edge, and number of samples across the edge in each."""
END_SHARE = 0.12
"""Fraction of an edge's length that is not sampled at each end, near the next edge [1]."""
SAMPLED_REACH = 0.6
"""Distance to which brightness is sampled on both sides of an edge, in squares of the marker [1];
it is below 1, since the inner pattern begins one square from the edge."""
MOST_SAMPLED_REACH = 6.0
"""Largest distance to which brightness is sampled [pixel]; a larger one would only add noise."""
LEVEL_SAMPLES = 3
"""Number of outermost samples on each side whose median is the dark or the bright level."""
LEAST_CONTRAST = 12.0
"""Difference of the bright and the dark level below which there is no edge [grey levels]."""
LEAST_OUTLIER = 0.15
"""Distance from the fitted line below which a point of an edge is never excluded [pixel]."""


@dataclass(frozen=True, eq=False)
class Detection:
    """A marker detected in a frame.

    Attributes:
        id: number of the marker.
        corners: x, y of top left, top right, bottom right and bottom left corner [pixel].
    """

    id: int
    corners: Float[np.ndarray, "corner 2"]

    @property
    def middle(self) -> Float[np.ndarray, "2"]:
        """Mean of the corners [pixel]."""
        return np.asarray(self.corners.mean(axis=0))


@dataclass(frozen=True)
class Region:
    """A rectangle of pixels; column `right` and row `bottom` are just outside of it."""

    left: int
    top: int
    right: int
    bottom: int

    def within(self, other: "Region") -> "Region":
        """Return the intersection with another region, which may be empty."""
        left, top = max(self.left, other.left), max(self.top, other.top)
        right, bottom = min(self.right, other.right), min(self.bottom, other.bottom)
        return Region(left, top, max(left, right), max(top, bottom))

    @property
    def empty(self) -> bool:
        """True if the region contains no pixel."""
        return self.right <= self.left or self.bottom <= self.top


def cut(grey: Grey, region: Region | None) -> UInt8[np.ndarray, "down across"]:
    """Return the part of an image within a region, or the whole image if the region is None."""
    if region is None:
        return grey
    part = region.within(Region(0, 0, *size_of(grey)))
    return np.ascontiguousarray(grey[part.top : part.bottom, part.left : part.right])


class MarkerDetector:
    """OpenCV's detector for markers of a dictionary, with corners refined to less than a pixel.

    Raises:
        DataError: no dictionary has the given name, or OpenCV is not installed.
    """

    def __init__(self, dictionary: str):
        book = marker_dictionary(dictionary)
        self._squares = int(book.markerSize) + 2
        self._detector = cv2.aruco.ArucoDetector(book)

    def detect(self, grey: Grey, region: Region | None = None) -> list[Detection]:
        """Return all markers in a frame, or in a region of it."""
        part = cut(grey, region)
        corners, ids, _ = self._detector.detectMarkers(part) if part.size else (None, None, None)
        if ids is None or not len(ids):
            return []
        rough = np.asarray(corners, float).reshape(-1, 4, 2)
        if region is not None:
            rough = rough + np.maximum([region.left, region.top], 0)
        fine = refined(grey, rough, self._squares)
        numbers = np.asarray(ids).ravel().tolist()
        return [Detection(*one) for one in zip(numbers, fine, strict=True)]


@dataclass(eq=False)
class MarkerTracker:
    """Detector that follows markers from frame to frame.

    Attributes:
        detector: detector of the markers.
        ids: numbers of the markers to track.
        region: region of the image to which detections are limited.
        last: last detection of each marker to track.
        speed: motion of each marker's middle between the last two frames [pixel].
        twice: True if a marker was detected twice in the last frame; the next frame is then
            searched completely, so that the tracker does not follow the wrong marker.
    """

    detector: MarkerDetector
    ids: frozenset[int]
    region: Region | None = None
    last: dict[int, Detection] = field(default_factory=dict)
    speed: dict[int, Float[np.ndarray, "2"]] = field(default_factory=dict)
    twice: bool = False

    def detect(self, grey: Grey, number: int) -> list[Detection]:
        """Return all detections of the markers to track in frame number `number`."""
        if self.ids == self.last.keys() and not self.twice and number % WHOLE_INTERVAL:
            near = [d for d in self.detector.detect(grey, self._around()) if d.id in self.ids]
            if self.ids == {d.id for d in near}:
                return self._followed(near)
        return self._followed(
            [d for d in self.detector.detect(grey, self.region) if d.id in self.ids]
        )

    def _around(self) -> Region:
        """Return the region in which the markers of the last frame are expected now."""
        speed = np.array([self.speed.get(number, np.zeros(2)) for number in self.last])
        corners = np.array([one.corners for one in self.last.values()]) + speed[:, None]
        size = np.ptp(corners, axis=1).max(axis=1, keepdims=True)
        reach = np.maximum(LEAST_MARGIN, MARGIN * size) + np.abs(speed)
        low, high = corners.min(axis=1) - reach, corners.max(axis=1) + reach
        left, top = np.floor(low.min(axis=0)).astype(int).tolist()
        right, bottom = np.ceil(high.max(axis=0)).astype(int).tolist()
        around = Region(left, top, right + 1, bottom + 1)
        return around if self.region is None else around.within(self.region)

    def _followed(self, detections: list[Detection]) -> list[Detection]:
        """Store detections for the next frame, and return them."""
        now = {one.id: one for one in detections}
        self.twice = len(now) < len(detections)
        self.speed = {
            number: one.middle - self.last[number].middle
            for number, one in now.items()
            if number in self.last
        }
        self.last = now
        return detections


@dataclass(frozen=True, eq=False)
class _Edges:
    """Edges between neighbouring corners of markers, in the order of the corners.

    Attributes:
        start: x, y of the start of each edge [pixel].
        along: vector from the start of the edge to its end [pixel].
        outward: unit vector perpendicular to the edge, pointing out of the marker.
        reach: distance up to which brightness is sampled on both sides of the edge [pixel].
    """

    start: Float[np.ndarray, "marker 4 2"]
    along: Float[np.ndarray, "marker 4 2"]
    outward: Float[np.ndarray, "marker 4 2"]
    reach: Float[np.ndarray, "marker 4"]

    @classmethod
    def between(cls, corners: Float[np.ndarray, "marker 4 2"], squares: int) -> "_Edges":
        along = np.roll(corners, -1, axis=1) - corners
        length = np.maximum(np.linalg.norm(along, axis=-1), 1e-6)
        outward = np.stack([along[..., 1], -along[..., 0]], axis=-1) / length[..., None]
        reach = np.minimum(SAMPLED_REACH * length / squares, MOST_SAMPLED_REACH)
        return cls(corners, along, outward, reach)


def refined(
    grey: Grey, corners: Float[np.ndarray, "marker 4 2"], squares: int
) -> Float[np.ndarray, "marker 4 2"]:
    """Return corners refined to intersections of lines fitted to the markers' edges [pixel].

    The corners of a marker are returned unchanged if its edges are not clear, or if a corner would
    move too far.

    Args:
        grey: the frame.
        corners: x, y of the corners, clockwise, with errors of about a pixel [pixel].
        squares: number of squares along an edge of a marker, including its border.
    """
    result = corners
    for _ in range(REFINEMENTS):
        edges = _Edges.between(result, squares)
        better = _intersections(edges, _offsets(edges, _profiles(grey, edges)))
        moved = np.linalg.norm(better - corners, axis=-1).max(axis=-1)
        with np.errstate(invalid="ignore"):
            sound = moved < 1.5 + edges.reach.min(axis=-1)
        result = np.where(sound[:, None, None], better, corners)
    return result


def _profiles(grey: Grey, edges: _Edges) -> Float[np.ndarray, "marker 4 along across"]:
    """Return brightness profiles across each edge, from inside to outside of the marker."""
    along, across = np.linspace(END_SHARE, 1 - END_SHARE, ALONG), np.linspace(-1, 1, ACROSS)
    aside = edges.reach[..., None] * across
    places = (
        edges.start[:, :, None, None]
        + edges.along[:, :, None, None] * along[:, None, None]
        + (edges.outward[:, :, None] * aside[..., None])[:, :, None]
    )
    flat = places.reshape(-1, ALONG * ACROSS, 2).astype(np.float32)
    brightness = cv2.remap(
        *(grey, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR), borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(brightness, float).reshape(places.shape[:-1])


def _offsets(
    edges: _Edges, profiles: Float[np.ndarray, "marker 4 along across"]
) -> Float[np.ndarray, "marker 4 2"]:
    """Return the outward offset of each edge's fitted line from the edge's start and end [pixel].

    The offset is NaN if the two sides of the edge do not differ enough in brightness.
    """
    dark = np.median(profiles[..., :LEVEL_SAMPLES], axis=(-1, -2))
    bright = np.median(profiles[..., -LEVEL_SAMPLES:], axis=(-1, -2))
    contrast = np.where(bright - dark > LEAST_CONTRAST, bright - dark, np.nan)
    part = (profiles - dark[..., None, None]) / contrast[..., None, None]
    area = np.trapezoid(np.clip(part, -0.2, 1.2), dx=2 / (ACROSS - 1), axis=-1)
    outside = (1.0 - area) * edges.reach[..., None]
    along = np.broadcast_to(np.linspace(END_SHARE, 1 - END_SHARE, ALONG), outside.shape)
    kept = np.ones(outside.shape)
    for _ in range(2):
        weight = kept / kept.sum(axis=-1, keepdims=True)
        middle = (weight * along).sum(axis=-1, keepdims=True)
        mean = (weight * outside).sum(axis=-1, keepdims=True)
        spread = (weight * (along - middle) ** 2).sum(axis=-1, keepdims=True)
        slope = (weight * (along - middle) * (outside - mean)).sum(axis=-1, keepdims=True) / spread
        residual = np.abs(outside - mean - slope * (along - middle))
        limit = np.maximum(LEAST_OUTLIER, 4.5 * np.median(residual, axis=-1, keepdims=True))
        kept = np.where(np.isfinite(residual), (residual <= limit) * 1.0, 1.0)
    return np.asarray(mean + slope * (np.array([0.0, 1.0]) - middle))


def _intersections(
    edges: _Edges, offsets: Float[np.ndarray, "marker 4 2"]
) -> Float[np.ndarray, "marker 4 2"]:
    """Return the start of each edge, where its line meets that of the previous edge [pixel]."""
    start = edges.start + edges.outward * offsets[..., :1]
    along = edges.start + edges.along + edges.outward * offsets[..., 1:] - start
    other, other_along = np.roll(start, 1, axis=1), np.roll(along, 1, axis=1)
    gap = other - start
    with np.errstate(divide="ignore", invalid="ignore"):
        part = _cross(gap, other_along) / _cross(along, other_along)
    return np.asarray(start + part[..., None] * along)


def _cross(
    one: Float[np.ndarray, "*batch 2"], other: Float[np.ndarray, "*batch 2"]
) -> Float[np.ndarray, "*batch"]:
    return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]
