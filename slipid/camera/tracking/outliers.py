"""Which poses of a track are not to be believed: those that no body drives through.

A body has inertia: from where it was and how fast, it gets in a short time only so far. A track is
cut wherever it turns more sharply than that allows, and of the pieces those are believed that can
be driven one after the other and have most frames together. What is left out was not measured but
mistaken: a reflection, a torn frame, a frame out of order, for one frame or for many.

Corners of markers below a pixel: straight lines through their four edges, and where these cross.

A corner alone says little where a marker is small: the window around it is full of the pattern
inside, and all four corners are drawn the same way, as if the marker were turned. An edge is seen
over its whole length. Across it, from the black border to the white margin, brightness rises from
one level to another, and the area below that rise tells where its middle is, however blurred it is,
by the lens or by motion.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from slipid.camera.opencv import opencv

ACCELERATION = np.array([3.0, 3.0, 30.0])
"""Beyond what a wheeled robot does: x, y [m/s^2], heading [rad/s^2]."""
SUDDEN = np.array([0.1, 0.1, 2.0])
"""By which its speed may change at once, where it hits something: x, y [m/s], heading [rad/s]."""
SPEED = np.array([5.0, 5.0, 15.0])
"""Beyond what it drives: x, y [m/s], heading [rad/s]."""
STDS = 6.0
"""Of the noise, below which nothing is an outlier."""
BEHIND = 2
"""Frames over which the speed at the end of a piece is taken."""
PIECES = 60
"""Pieces before one after which it may come."""
FEWEST = 5
"""Poses, below which nothing can be said."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """Poses that were found: time [s], x, y [m], heading [rad], and the std of their noise."""

    time: Float[np.ndarray, " pose"]
    pose: Float[np.ndarray, "pose 3"]
    std: Float[np.ndarray, "pose 3"]


def jumps(
    time: Float[np.ndarray, " frame"],
    pose: Float[np.ndarray, "frame 3"],
    std: Float[np.ndarray, "frame 3"],
) -> Bool[np.ndarray, " frame"]:
    """Frames whose pose no body drives through; False where there is no pose.

    Args:
        time: increasing [s].
        pose: x, y [m], heading [rad] with or without wrap-around; NaN where it was not seen.
        std: of the noise of each.
    """
    there = np.isfinite(pose).all(axis=1)
    bad = np.zeros(len(time), bool)
    if there.sum() < FEWEST:
        return bad
    seen = _Seen(time[there], pose[there], std[there])
    first = _pieces(seen)
    last = np.append(first[1:], len(seen.time)) - 1
    believed = np.zeros(len(seen.time), bool)
    for piece in _longest_way(seen, first, last):
        believed[first[piece] : last[piece] + 1] = True
    bad[np.flatnonzero(there)[~believed]] = True
    return bad


def _pieces(seen: _Seen) -> Int[np.ndarray, " piece"]:
    """First poses of the pieces: a pose that does not fit between its neighbours is one alone."""
    t, p, s = seen.time, seen.pose, seen.std
    since, until = (t[1:-1] - t[:-2])[:, None], (t[2:] - t[1:-1])[:, None]
    part = since / (since + until)
    gap = _turned_least(p[1:-1] - p[:-2]) - part * _turned_least(p[2:] - p[:-2])
    noise = np.sqrt(s[1:-1] ** 2 + ((1 - part) * s[:-2]) ** 2 + (part * s[2:]) ** 2)
    reach = since * until * (0.5 * ACCELERATION + SUDDEN / (since + until))
    sharp = np.abs(gap) > reach + STDS * noise
    odd = np.flatnonzero(sharp.any(axis=1)) + 1
    fast = np.abs(_turned_least(np.diff(p, axis=0))) > SPEED * np.diff(t)[:, None] + STDS * s[1:]
    steps = np.flatnonzero(fast.any(axis=1)) + 1
    return np.unique(np.concatenate([[0], odd, odd + 1, steps]))


def _longest_way(
    seen: _Seen, first: Int[np.ndarray, " piece"], last: Int[np.ndarray, " piece"]
) -> list[int]:
    """Pieces that can be driven one after the other, with most poses together."""
    poses = last - first + 1
    before = np.full(len(first), -1)
    base = np.where(last > first, np.maximum(first, last - BEHIND), -1)
    for piece in range(1, len(first)):
        candidates = np.arange(max(0, piece - PIECES), piece)
        start = np.full(len(candidates), first[piece])
        onward = min(first[piece] + BEHIND, last[piece])
        after = np.full(len(candidates), onward if onward > first[piece] else -1)
        turn = np.maximum(
            _turn(seen, last[candidates], base[candidates], start),
            _turn(seen, start, after, last[candidates]),
        )
        if (near := candidates[turn <= 1]).size:
            best = near[np.argmax(poses[near])]
            poses[piece] += poses[best]
            before[piece] = best
            if base[piece] < 0:
                base[piece] = last[best]
    way = [int(np.argmax(poses))]
    while before[way[-1]] >= 0:
        way.append(int(before[way[-1]]))
    return way


def _turn(
    seen: _Seen,
    at: Int[np.ndarray, " way"],
    base: Int[np.ndarray, " way"],
    to: Int[np.ndarray, " way"],
) -> Float[np.ndarray, " way"]:
    """How sharply ways turn from a pose to another, as a part of what a body can.

    Args:
        seen: all poses.
        at: the pose each way has come to.
        base: one it has come from, which tells the speed; negative where there is none.
        to: where it goes; before `at` in time where the way is followed backwards.
    """
    t, p, s = seen.time, seen.pose, seen.std
    after = np.abs(t[to] - t[at])[:, None]
    way = _turned_least(p[to] - p[at])
    fast = (np.abs(way) / (SPEED * after + STDS * (s[to] + s[at]))).max(axis=1)
    moving = base >= 0
    span = np.where(moving, np.abs(t[at] - t[base]), 1.0)[:, None]
    times = after / span
    gone = times * _turned_least(p[at] - p[base])
    noise = np.sqrt(s[to] ** 2 + ((1 + times) * s[at]) ** 2 + (times * s[base]) ** 2)
    allowed = after * (0.5 * (after + span) * ACCELERATION + SUDDEN) + STDS * noise
    sharp = (np.abs(_turned_least(way - gone)) / allowed).max(axis=1)
    return np.asarray(np.where(moving, np.maximum(fast, sharp), fast))


def _turned_least(change: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """A change of pose, its heading by less than half a turn."""
    heading = np.angle(np.exp(1j * change[..., 2:]))
    return np.concatenate([change[..., :2], heading], axis=-1)


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
