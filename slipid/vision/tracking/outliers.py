"""Which poses of a track are not to be believed: those that no body drives through.

A body has inertia: from where it was and how fast, it gets in a short time only so far. A track is
cut wherever it turns more sharply than that allows, and of the pieces those are believed that can
be driven one after the other and have most frames together. What is left out was not measured but
mistaken: a reflection, a torn frame, a frame out of order, for one frame or for many.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

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
