"""Which poses of a track are not to be believed: frames that do not fit to their neighbours.

A body has inertia. From the frames around it the pose in a frame is known to about half the largest
acceleration times the product of the times to two of them; what is further off, beyond its noise,
was not measured but mistaken: a reflection, a torn frame, a frame out of order.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

ACCELERATION = np.array([3.0, 3.0, 30.0])
"""Beyond what a wheeled robot does: x, y [m/s^2], heading [rad/s^2]."""
STDS = 6.0
"""Of the noise, below which nothing is an outlier."""
WIDE, NARROW = 4, 2
"""Neighbours on each side: at first many, among which some may be wrong; then the nearest."""
LONGEST = 1.0
"""Neighbours further away in time do not count [s]."""
SPEED = 5.0
"""Beyond what a body drives from one frame to the next [m/s]."""


@dataclass(frozen=True, eq=False)
class _Around:
    """What the neighbours of every frame say of it, medians over pairs of them.

    Attributes:
        expected: the pose.
        reach: half the product of the times to two neighbours [s^2].
    """

    expected: Float[np.ndarray, "frame 3"]
    reach: Float[np.ndarray, " frame"]


def jumps(
    time: Float[np.ndarray, " frame"],
    pose: Float[np.ndarray, "frame 3"],
    std: Float[np.ndarray, "frame 3"],
) -> Bool[np.ndarray, " frame"]:
    """Frames whose pose does not fit to those around; False where there is no pose.

    Args:
        time: increasing [s].
        pose: x, y [m], heading [rad] with or without wrap-around; NaN where it was not seen.
        std: of the noise of each.
    """
    there = np.isfinite(pose).all(axis=1)
    bad = np.zeros(len(time), bool)
    if there.sum() < 5:
        return bad
    known = pose.copy()
    known[there, 2] = np.unwrap(pose[there, 2])
    for neighbours in (WIDE, NARROW, NARROW):
        around = _around(time, known, there & ~bad, neighbours)
        gap = known - around.expected
        gap[:, 2] = np.angle(
            np.exp(1j * gap[:, 2])
        )  # a wrong heading may have unwrapped what follows
        allowed = STDS * std + around.reach[:, None] * ACCELERATION
        with np.errstate(invalid="ignore"):
            bad = there & (np.abs(gap) > allowed).any(axis=1)
    good = np.flatnonzero(there & ~bad)
    bad[good[~_of_one_way(time[good], known[good, :2])]] = True
    return bad


def _of_one_way(
    time: Float[np.ndarray, " frame"], place: Float[np.ndarray, "frame 2"]
) -> Bool[np.ndarray, " frame"]:
    """Frames of the longest stretch without an impossible step, and of what is reached from it.

    A marker that is mistaken for a while makes a stretch of its own, smooth in itself.
    """
    if len(time) < 2:
        return np.ones(len(time), bool)
    far = np.linalg.norm(np.diff(place, axis=0), axis=1) > SPEED * np.diff(time)
    edges = np.concatenate([[0], np.flatnonzero(far) + 1, [len(time)]])
    keep = np.zeros(len(time), bool)
    longest = int(np.argmax(np.diff(edges)))
    keep[edges[longest] : edges[longest + 1]] = True
    for k in [*range(longest + 1, len(edges) - 1), *range(longest - 1, -1, -1)]:
        part = np.arange(edges[k], edges[k + 1])
        kept = np.flatnonzero(keep)
        own, other = (part[0], kept[-1]) if k > longest else (part[-1], kept[0])
        within = SPEED * abs(time[own] - time[other])
        keep[part] = np.linalg.norm(place[own] - place[other]) <= within
    return keep


def _around(
    time: Float[np.ndarray, " frame"],
    pose: Float[np.ndarray, "frame 3"],
    good: Bool[np.ndarray, " frame"],
    neighbours: int,
) -> _Around:
    """Expected poses from good frames before and after, by a straight line through every pair."""
    at = np.flatnonzero(good)
    before = np.searchsorted(at, np.arange(len(time)), side="left")
    after = np.searchsorted(at, np.arange(len(time)), side="right")
    steps = np.arange(neighbours)
    ranks = np.concatenate([before[:, None] - 1 - steps, after[:, None] + steps], axis=1)
    inside = (ranks >= 0) & (ranks < len(at))
    near = at[ranks.clip(0, len(at) - 1)]
    inside &= np.abs(time[near] - time[:, None]) <= LONGEST
    first, second = np.triu_indices(2 * neighbours, 1)
    j, k = near[:, first], near[:, second]
    since, until = time[:, None] - time[j], time[k] - time[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        part = since / (since + until)
        line = pose[j] + part[..., None] * _turned_least(pose[k] - pose[j])
    both = inside[:, first] & inside[:, second] & (j != k)
    line = np.where(both[..., None], line, np.nan)
    reach = np.where(both, 0.5 * np.abs(since * until), np.nan)
    empty = ~both.any(axis=1)
    line[empty], reach[empty] = pose[empty, None], 0.0
    return _Around(np.nanmedian(line, axis=1), np.nanmedian(reach, axis=1))


def _turned_least(change: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """A change of pose, its heading by less than half a turn."""
    heading = np.angle(np.exp(1j * change[..., 2:]))
    return np.concatenate([change[..., :2], heading], axis=-1)
