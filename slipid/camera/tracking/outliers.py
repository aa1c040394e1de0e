"""Outliers of a track: poses that no body can drive through.

A body has inertia: from its place and speed it gets only so far in a short time. A track is cut
wherever it turns more sharply than that allows. Of the segments, those are kept that can be driven
one after the other and have most poses together. A rejected pose was not measured but mistaken: a
reflection, a torn frame or a frame out of order, for one frame or for many.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

ACCELERATION = np.array([3.0, 3.0, 30.0])
"""Acceleration beyond that of a wheeled robot: x, y [m/s^2], heading [rad/s^2]."""
SUDDEN = np.array([0.1, 0.1, 2.0])
"""Sudden change of its speed, as in a collision: x, y [m/s], heading [rad/s]."""
SPEED = np.array([5.0, 5.0, 15.0])
"""Speed beyond that of a wheeled robot: x, y [m/s], heading [rad/s]."""
STDS = 6.0
"""Deviation below which nothing is an outlier [std of the noise]."""
BEHIND = 2
"""Number of frames over which the speed at the end of a segment is taken."""
SEGMENTS = 60
"""Number of segments before another among which its predecessor is searched."""
FEWEST = 5
"""Number of poses below which no outlier can be recognised."""


@dataclass(frozen=True, eq=False)
class _NoisyPoses:
    """Poses that exist: time [s], x, y [m], heading [rad], and the std of their noise."""

    time: Float[np.ndarray, " pose"]
    pose: Float[np.ndarray, "pose 3"]
    std: Float[np.ndarray, "pose 3"]


def jumps(
    time: Float[np.ndarray, " frame"],
    pose: Float[np.ndarray, "frame 3"],
    std: Float[np.ndarray, "frame 3"],
) -> Bool[np.ndarray, " frame"]:
    """Return the frames whose pose no body can drive through; False where there is no pose.

    Args:
        time: increasing time [s].
        pose: x, y [m], heading [rad] with or without wrap-around; NaN where there is none.
        std: std of the noise of each.
    """
    present = np.isfinite(pose).all(axis=1)
    bad = np.zeros(len(time), bool)
    if present.sum() < FEWEST:
        return bad
    poses = _NoisyPoses(time[present], pose[present], std[present])
    first = _segments(poses)
    last = np.append(first[1:], len(poses.time)) - 1
    kept = np.zeros(len(poses.time), bool)
    for segment in _longest_path(poses, first, last):
        kept[first[segment] : last[segment] + 1] = True
    bad[np.flatnonzero(present)[~kept]] = True
    return bad


def _segments(poses: _NoisyPoses) -> Int[np.ndarray, " segment"]:
    """Return the first pose of each segment.

    A pose that does not fit between its neighbours is a segment of its own.
    """
    t, p, s = poses.time, poses.pose, poses.std
    since, until = (t[1:-1] - t[:-2])[:, None], (t[2:] - t[1:-1])[:, None]
    part = since / (since + until)
    gap = _wrapped(p[1:-1] - p[:-2]) - part * _wrapped(p[2:] - p[:-2])
    noise = np.sqrt(s[1:-1] ** 2 + ((1 - part) * s[:-2]) ** 2 + (part * s[2:]) ** 2)
    reach = since * until * (0.5 * ACCELERATION + SUDDEN / (since + until))
    sharp = np.abs(gap) > reach + STDS * noise
    odd = np.flatnonzero(sharp.any(axis=1)) + 1
    fast = np.abs(_wrapped(np.diff(p, axis=0))) > SPEED * np.diff(t)[:, None] + STDS * s[1:]
    steps = np.flatnonzero(fast.any(axis=1)) + 1
    return np.unique(np.concatenate([[0], odd, odd + 1, steps]))


def _longest_path(
    poses: _NoisyPoses, first: Int[np.ndarray, " segment"], last: Int[np.ndarray, " segment"]
) -> list[int]:
    """Return segments that can be driven one after the other, with most poses together."""
    total = last - first + 1
    before = np.full(len(first), -1)
    base = np.where(last > first, np.maximum(first, last - BEHIND), -1)
    for segment in range(1, len(first)):
        candidates = np.arange(max(0, segment - SEGMENTS), segment)
        start = np.full(len(candidates), first[segment])
        onward = min(first[segment] + BEHIND, last[segment])
        after = np.full(len(candidates), onward if onward > first[segment] else -1)
        sharpness = np.maximum(
            _sharpness(poses, last[candidates], base[candidates], start),
            _sharpness(poses, start, after, last[candidates]),
        )
        if (possible := candidates[sharpness <= 1]).size:
            best = possible[np.argmax(total[possible])]
            total[segment] += total[best]
            before[segment] = best
            if base[segment] < 0:
                base[segment] = last[best]
    path = [int(np.argmax(total))]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return path


def _sharpness(
    poses: _NoisyPoses,
    at: Int[np.ndarray, " path"],
    base: Int[np.ndarray, " path"],
    to: Int[np.ndarray, " path"],
) -> Float[np.ndarray, " path"]:
    """Return how sharply paths turn from a pose to another, relative to the limits of a body [1].

    Args:
        poses: all poses.
        at: pose that each path has reached.
        base: pose that it came from, which gives its speed; negative where there is none.
        to: pose that it goes to; before `at` in time where the path is followed backwards.
    """
    t, p, s = poses.time, poses.pose, poses.std
    after = np.abs(t[to] - t[at])[:, None]
    change = _wrapped(p[to] - p[at])
    fast = (np.abs(change) / (SPEED * after + STDS * (s[to] + s[at]))).max(axis=1)
    moving = base >= 0
    span = np.where(moving, np.abs(t[at] - t[base]), 1.0)[:, None]
    times = after / span
    expected = times * _wrapped(p[at] - p[base])
    noise = np.sqrt(s[to] ** 2 + ((1 + times) * s[at]) ** 2 + (times * s[base]) ** 2)
    allowed = after * (0.5 * (after + span) * ACCELERATION + SUDDEN) + STDS * noise
    sharp = (np.abs(_wrapped(change - expected)) / allowed).max(axis=1)
    return np.asarray(np.where(moving, np.maximum(fast, sharp), fast))


def _wrapped(change: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Return a change of pose with its heading between -pi and pi."""
    heading = np.angle(np.exp(1j * change[..., 2:]))
    return np.concatenate([change[..., :2], heading], axis=-1)
