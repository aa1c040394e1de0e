"""Tracked poses of a body, each with its covariance, and rejected frames with the reason.

A pose that no body can drive through is an outlier. Since a body has inertia, its pose and speed
limit where it can be a short time later. The sequence of poses is cut into segments wherever its
motion changes more suddenly than these limits allow. Of all chains of segments that a body can
drive one after the other, the chain with the largest number of poses is kept. The poses of all
other segments are rejected as false detections, such as a reflection, a torn frame or frames out of
order; these may last for one frame or for many.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.camera.overhead import OverheadCamera
from slipid.camera.tracking.detections import Detections
from slipid.camera.tracking.pose import poses_of
from slipid.camera.tracking.target import Target

ACCELERATION = np.array([3.0, 3.0, 30.0])
"""Largest accepted acceleration, above that of wheeled robots: x, y [m/s^2], heading [rad/s^2]."""
SUDDEN_CHANGE = np.array([0.1, 0.1, 2.0])
"""Largest accepted sudden change of speed, as in a collision: x, y [m/s], heading [rad/s]."""
SPEED = np.array([5.0, 5.0, 15.0])
"""Largest accepted speed, above that of wheeled robots: x, y [m/s], heading [rad/s]."""
NOISE_STDS = 6.0
"""Deviation below which no pose is an outlier, in stds of the noise [1]."""
POSES_BEHIND = 2
"""Largest number of steps between poses over which the speed at a segment's end is computed."""
SEGMENTS_BEHIND = 60
"""Number of preceding segments that are tried as a segment's predecessor in the chain."""
FEWEST_POSES = 5
"""Number of poses below which outliers cannot be recognised."""


@dataclass(frozen=True, eq=False)
class _NoisyPoses:
    """Poses of the frames that have one: time [s], x, y [m], heading [rad], and noise stds."""

    time: Float[np.ndarray, " pose"]
    pose: Float[np.ndarray, "pose 3"]
    std: Float[np.ndarray, "pose 3"]


def jumps(
    time: Float[np.ndarray, " frame"],
    pose: Float[np.ndarray, "frame 3"],
    std: Float[np.ndarray, "frame 3"],
) -> Bool[np.ndarray, " frame"]:
    """Return a mask of the frames whose pose no body can drive through; see the module's text.

    The mask is False for frames without a pose.

    Args:
        time: increasing time [s].
        pose: x, y [m], heading [rad] with or without wrap-around; NaN where there is none.
        std: std of the noise of each component [m, m, rad].
    """
    present = np.isfinite(pose).all(axis=1)
    bad = np.zeros(len(time), bool)
    if present.sum() < FEWEST_POSES:
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
    """Return the index of the first pose of each segment.

    A pose that is inconsistent with its neighbours becomes a segment of its own.
    """
    t, p, s = poses.time, poses.pose, poses.std
    since, until = (t[1:-1] - t[:-2])[:, None], (t[2:] - t[1:-1])[:, None]
    part = since / (since + until)
    gap = _wrapped(p[1:-1] - p[:-2]) - part * _wrapped(p[2:] - p[:-2])
    noise = np.sqrt(s[1:-1] ** 2 + ((1 - part) * s[:-2]) ** 2 + (part * s[2:]) ** 2)
    reach = since * until * (0.5 * ACCELERATION + SUDDEN_CHANGE / (since + until))
    sharp = np.abs(gap) > reach + NOISE_STDS * noise
    odd = np.flatnonzero(sharp.any(axis=1)) + 1
    fast = np.abs(_wrapped(np.diff(p, axis=0))) > SPEED * np.diff(t)[:, None] + NOISE_STDS * s[1:]
    steps = np.flatnonzero(fast.any(axis=1)) + 1
    return np.unique(np.concatenate([[0], odd, odd + 1, steps]))


def _longest_path(
    poses: _NoisyPoses, first: Int[np.ndarray, " segment"], last: Int[np.ndarray, " segment"]
) -> list[int]:
    """Return the indices of the segments in the drivable chain with the most poses, latest first.

    In a drivable chain a body can get from each segment to the next, see `_sharpness`. `first` and
    `last` are the indices of the first and the last pose of each segment.
    """
    total = last - first + 1
    before = np.full(len(first), -1)
    base = np.where(last > first, np.maximum(first, last - POSES_BEHIND), -1)
    for segment in range(1, len(first)):
        candidates = np.arange(max(0, segment - SEGMENTS_BEHIND), segment)
        start = np.full(len(candidates), first[segment])
        onward = min(first[segment] + POSES_BEHIND, last[segment])
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
    """Return the change of motion that reaching a pose needs, relative to a body's limits [1].

    A body can drive a path if the result is at most 1.

    Args:
        poses: all poses.
        at: index of the pose that each path has reached.
        base: index of an earlier pose of the path, from which its speed is computed; negative if
            there is none.
        to: index of the pose that follows on the path; it is before `at` in time if the path is
            followed backwards.
    """
    t, p, s = poses.time, poses.pose, poses.std
    after = np.abs(t[to] - t[at])[:, None]
    change = _wrapped(p[to] - p[at])
    fast = (np.abs(change) / (SPEED * after + NOISE_STDS * (s[to] + s[at]))).max(axis=1)
    moving = base >= 0
    span = np.where(moving, np.abs(t[at] - t[base]), 1.0)[:, None]
    times = after / span
    expected = times * _wrapped(p[at] - p[base])
    noise = np.sqrt(s[to] ** 2 + ((1 + times) * s[at]) ** 2 + (times * s[base]) ** 2)
    allowed = after * (0.5 * (after + span) * ACCELERATION + SUDDEN_CHANGE) + NOISE_STDS * noise
    sharp = (np.abs(_wrapped(change - expected)) / allowed).max(axis=1)
    return np.asarray(np.where(moving, np.maximum(fast, sharp), fast))


def _wrapped(change: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Return a change of pose with the change of heading wrapped to -pi ... pi."""
    heading = np.angle(np.exp(1j * change[..., 2:]))
    return np.concatenate([change[..., :2], heading], axis=-1)


class Flag(IntEnum):
    """State of a frame: it has a pose, or was rejected for some reason.

    Attributes:
        OK: the frame has a pose.
        MISSING: none of the body's markers was detected.
        AMBIGUOUS: a marker was detected twice.
        REPEATED: the image is identical to that of the frame before.
        SHAPE: the corners do not have the shape of a marker of the given size.
        JUMP: no body could drive through this pose and the poses of other frames.
    """

    OK = 0
    MISSING = 1
    AMBIGUOUS = 2
    REPEATED = 3
    SHAPE = 4
    JUMP = 5

    @property
    def word(self) -> str:
        """Name of the flag in files and messages."""
        return self.name.lower()


LEAST_CORNER_STD = 0.05
"""Smallest std assumed for the error of a corner [pixel]; smaller estimates are not credible."""
SHARED_STD = 0.05
"""Std of the error that all corners of a frame share, which residuals do not show [pixel]."""
ODD_SQUARES = 25.0
"""Mean squared residual of a frame, relative to the median over frames, above which its corners do
not have the shape of a marker [1]."""
ODD_LEAST = 1.0
"""Root mean square residual of a frame up to which its corners are accepted whatever the median is
[pixel]. The limit is needed because residuals vary with heading: an edge along the rows of pixels
is located better than a slanted edge."""
ODD_SIZE = 0.05
"""Largest relative difference of the markers' size in a frame from its median over frames [1]."""
WRONG_SIZE = 0.02
"""Largest relative difference of the median apparent size from the true size [1]; a larger
difference means that the markers' height or size is wrong."""
LEAST_TRACKED = 0.5
"""Fraction of frames with a pose below which a result is reported as doubtful [1]."""


@dataclass(frozen=True, eq=False)
class TrackedPoses:
    """Poses of one body, a row for each frame.

    Attributes:
        target: the body.
        frame, time: number and time [s] of every frame.
        pose: x, y [m], heading [rad] without wrap-around; NaN where the flag is not `OK`.
        covariance: covariance of the pose in products of [m, m, rad]; NaN where there is no pose.
        rejected: the fitted pose of a rejected frame [m, m, rad], else NaN.
        flag: state of the frame, the number of a `Flag`.
        size: apparent size of the markers divided by their true size [1].
        corner_std: std of the error of a corner, estimated from the residuals [pixel].
        apparent_height: height of the markers above the floor, computed from their size in the
            image [m].
    """

    target: Target
    frame: Int[np.ndarray, " frame"]
    time: Float[np.ndarray, " frame"]
    pose: Float[np.ndarray, "frame 3"]
    covariance: Float[np.ndarray, "frame 3 3"]
    rejected: Float[np.ndarray, "frame 3"]
    flag: Int[np.ndarray, " frame"]
    size: Float[np.ndarray, " frame"]
    corner_std: float
    apparent_height: float

    @property
    def good(self) -> Bool[np.ndarray, " frame"]:
        """Mask of the frames that have a pose."""
        return np.asarray(self.flag == Flag.OK)

    @property
    def share(self) -> float:
        """Fraction of the frames that have a pose [1]."""
        return float(self.good.mean()) if len(self.flag) else 0.0

    @property
    def median_size(self) -> float:
        """Median over frames of apparent divided by true size [1]; NaN if no frame has a pose."""
        return float(np.median(self.size[self.good])) if self.good.any() else float("nan")

    def count(self, flag: Flag) -> int:
        """Return the number of frames with a flag."""
        return int((self.flag == flag).sum())

    def doubts(self) -> list[str]:
        """Return sentences about reasons not to use the poses as they are; empty for good poses."""
        name, out = self.target.name, []
        if self.share < LEAST_TRACKED:
            out.append(
                f"{name}: only {self.good.sum()} of {len(self.flag)} frames have a pose; column "
                "'flag' gives the reason for each other frame"
            )
        if self.count(Flag.AMBIGUOUS) > (1 - LEAST_TRACKED) * len(self.flag):
            out.append(
                f"{name}: its marker is detected twice in {self.count(Flag.AMBIGUOUS)} frames "
                "(another robot, a mirror?); limit tracking to a part of the image with --region"
            )
        if abs(self.median_size - 1) > WRONG_SIZE:
            out.append(
                f"{name}: markers appear {100 * (self.median_size - 1):+.1f} % larger than they "
                f"are, at {self.target.height:g} m above the floor; if their size is right, they "
                f"are at {self.apparent_height:.3f} m, and every path length is wrong by about the "
                "same percentage: measure size and height again"
            )
        return out

    def summary(self) -> str:
        """Return a sentence about the number of poses and their accuracy."""
        text = f"{self.target.name}: {int(self.good.sum())} of {len(self.flag)} frames have a pose"
        others = [flag for flag in Flag if flag is not Flag.OK and self.count(flag)]
        if others:
            text += f" (without a pose: {', '.join(f'{self.count(f)} {f.word}' for f in others)})"
        if not self.good.any():
            return text
        std = np.sqrt(np.diagonal(self.covariance[self.good], axis1=1, axis2=2).mean(axis=0))
        return (
            f"{text}; std {1e3 * max(std[0], std[1]):.2f} mm and {np.degrees(std[2]):.3f} deg, "
            f"corners err by {self.corner_std:.2f} pixel; size in the image implies a height of "
            f"{self.apparent_height:.3f} m (given: {self.target.height:g} m)"
        )


def track_of(camera: OverheadCamera, target: Target, detections: Detections) -> TrackedPoses:
    """Return the tracked poses of a body, from the detections of its markers."""
    ids = [marker.id for marker in target.markers]
    twice = (detections.counts(ids) > 1).any(axis=1)
    fit = poses_of(camera, target, detections.corners_of(ids))
    present = np.isfinite(fit.pose).all(axis=1)
    flag = np.where(twice, Flag.AMBIGUOUS, np.where(present, Flag.OK, Flag.MISSING))
    flag[detections.repeated] = Flag.REPEATED
    mean_square = fit.squares / np.maximum(fit.free, 1.0)
    flag[_odd_shapes(mean_square, fit.size, present) & (flag == Flag.OK)] = Flag.SHAPE
    squares = mean_square[flag == Flag.OK]
    noise = max(LEAST_CORNER_STD, float(np.sqrt(squares.sum() / max(len(squares), 1))))
    corners_used = 0.5 * (fit.free + 4.0)
    variance = noise**2 + corners_used * SHARED_STD**2
    covariance = variance[:, None, None] * fit.unit_covariance
    pose = np.where((flag == Flag.OK)[:, None], fit.pose, np.nan)
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    flag[jumps(detections.time, pose, std)] = Flag.JUMP
    good = flag == Flag.OK
    pose = np.where(good[:, None], fit.pose, np.nan)
    pose[good, 2] = np.unwrap(pose[good, 2])
    size = float(np.median(fit.size[good])) if good.any() else float("nan")
    return TrackedPoses(
        target=target,
        frame=detections.frame,
        time=detections.time,
        pose=pose,
        covariance=np.where(good[:, None, None], covariance, np.nan),
        rejected=np.where(good[:, None], np.nan, fit.pose),
        flag=flag,
        size=fit.size,
        corner_std=noise,
        apparent_height=camera.height - (camera.height - target.height) / size,
    )


def _odd_shapes(
    mean_square: Float[np.ndarray, " frame"],
    size: Float[np.ndarray, " frame"],
    present: Bool[np.ndarray, " frame"],
) -> Bool[np.ndarray, " frame"]:
    """Return a mask of the frames with too large residuals or an unusual size of the markers."""
    odd = np.zeros(len(size), bool)
    if present.any():
        usual = max(float(np.median(mean_square[present])), LEAST_CORNER_STD**2)
        odd[present] = mean_square[present] > max(ODD_SQUARES * usual, ODD_LEAST**2)
        odd[present] |= np.abs(size[present] / np.median(size[present]) - 1) > ODD_SIZE
    return odd
