"""Corners of markers below a pixel: straight lines through their four edges, and where these cross.

A corner alone says little where a marker is small: the window around it is full of the pattern
inside, and all four corners are drawn the same way, as if the marker were turned. An edge is seen
over its whole length. Across it, from the black border to the white margin, brightness rises from
one level to another, and the area below that rise tells where its middle is, however blurred it is,
by the lens or by motion.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from slipid.vision.opencv import opencv

ROUNDS = 3
"""Of sampling: the first starts from corners that are off by a pixel."""
ALONG, ACROSS = 20, 11
"""Samples along an edge, and across it at each."""
ENDS = 0.12
"""Part at both ends of an edge that is left out: there the other edge is near."""
REACH = 0.6
"""How far is sampled to both sides, as a part of a square of the marker: beyond is its pattern."""
MOST_REACH = 6.0
"""And no further than this [pixel]: it takes up noise."""
LEVELS = 3
"""Outermost samples on each side that tell how dark and how bright it is there."""
LEAST_CONTRAST = 12.0
"""Grey levels between them, below which there is no edge."""
OFF = 0.15
"""Least distance from its line from which on a point may be left out [pixel]."""


@dataclass(frozen=True, eq=False)
class _Edges:
    """The edges between neighbouring corners, in their order.

    Attributes:
        start, way: x, y [pixel] of where each starts, and from there to its end.
        outward: of length 1, at a right angle.
        reach: to both sides [pixel].
    """

    start: Float[np.ndarray, "marker 4 2"]
    way: Float[np.ndarray, "marker 4 2"]
    outward: Float[np.ndarray, "marker 4 2"]
    reach: Float[np.ndarray, "marker 4"]

    @classmethod
    def between(cls, corners: Float[np.ndarray, "marker 4 2"], squares: int) -> "_Edges":
        way = np.roll(corners, -1, axis=1) - corners
        length = np.maximum(np.linalg.norm(way, axis=-1), 1e-6)
        outward = np.stack([way[..., 1], -way[..., 0]], axis=-1) / length[..., None]
        return cls(corners, way, outward, np.minimum(REACH * length / squares, MOST_REACH))


def refined(
    grey: UInt8[np.ndarray, "row column"], corners: Float[np.ndarray, "marker 4 2"], squares: int
) -> Float[np.ndarray, "marker 4 2"]:
    """Corners where lines through the edges cross; as they were where no such edges are seen.

    Args:
        grey: the frame.
        corners: x, y [pixel], clockwise, off by a pixel or so.
        squares: of the marker along an edge, with its border.
    """
    found = corners
    for _ in range(ROUNDS):
        edges = _Edges.between(found, squares)
        better = _crossings(edges, _offsets(edges, _profiles(grey, edges)))
        moved = np.linalg.norm(better - corners, axis=-1).max(axis=-1)
        with np.errstate(invalid="ignore"):
            sound = moved < 1.5 + edges.reach.min(axis=-1)
        found = np.where(sound[:, None, None], better, corners)
    return found


def _profiles(
    grey: UInt8[np.ndarray, "row column"], edges: _Edges
) -> Float[np.ndarray, "marker 4 along across"]:
    """Brightness from inside to outside, at places along each edge."""
    along, across = np.linspace(ENDS, 1 - ENDS, ALONG), np.linspace(-1, 1, ACROSS)
    aside = edges.reach[..., None] * across
    places = (
        edges.start[:, :, None, None]
        + edges.way[:, :, None, None] * along[:, None, None]
        + (edges.outward[:, :, None] * aside[..., None])[:, :, None]
    )
    flat = places.reshape(-1, ALONG * ACROSS, 2).astype(np.float32)
    cv2 = opencv()
    seen = cv2.remap(
        *(grey, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR), borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(seen, float).reshape(places.shape[:-1])


def _offsets(
    edges: _Edges, profiles: Float[np.ndarray, "marker 4 along across"]
) -> Float[np.ndarray, "marker 4 2"]:
    """How far outside of its start and of its end the line through an edge lies [pixel].

    NaN where black and white do not differ.
    """
    dark = np.median(profiles[..., :LEVELS], axis=(-1, -2))
    bright = np.median(profiles[..., -LEVELS:], axis=(-1, -2))
    contrast = np.where(bright - dark > LEAST_CONTRAST, bright - dark, np.nan)
    part = (profiles - dark[..., None, None]) / contrast[..., None, None]
    area = np.trapezoid(np.clip(part, -0.2, 1.2), dx=2 / (ACROSS - 1), axis=-1)
    outside = (1.0 - area) * edges.reach[..., None]
    along = np.broadcast_to(np.linspace(ENDS, 1 - ENDS, ALONG), outside.shape)
    kept = np.ones(outside.shape)
    for _ in range(2):
        weight = kept / kept.sum(axis=-1, keepdims=True)
        middle = (weight * along).sum(axis=-1, keepdims=True)
        mean = (weight * outside).sum(axis=-1, keepdims=True)
        spread = (weight * (along - middle) ** 2).sum(axis=-1, keepdims=True)
        slope = (weight * (along - middle) * (outside - mean)).sum(axis=-1, keepdims=True) / spread
        left = np.abs(outside - mean - slope * (along - middle))
        kept = (left <= np.maximum(OFF, 4.5 * np.median(left, axis=-1, keepdims=True))) * 1.0
        kept = np.where(np.isfinite(left), kept, 1.0)
    ends = mean + slope * (np.array([0.0, 1.0]) - middle)
    return np.asarray(ends)


def _crossings(
    edges: _Edges, offsets: Float[np.ndarray, "marker 4 2"]
) -> Float[np.ndarray, "marker 4 2"]:
    """Where each edge's line crosses that of the edge before: at its start."""
    start = edges.start + edges.outward * offsets[..., :1]
    end = edges.start + edges.way + edges.outward * offsets[..., 1:]
    way = end - start
    other, other_way = np.roll(start, 1, axis=1), np.roll(way, 1, axis=1)
    gap = other - start
    with np.errstate(divide="ignore", invalid="ignore"):
        part = (gap[..., 0] * other_way[..., 1] - gap[..., 1] * other_way[..., 0]) / (
            way[..., 0] * other_way[..., 1] - way[..., 1] * other_way[..., 0]
        )
    return np.asarray(start + part[..., None] * way)
