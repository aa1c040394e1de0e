"""Tracked poses of a body, each with its covariance, or a rejected frame with the reason.

A pose that no body can drive through is an outlier. A body has inertia: from its place and speed it
gets only so far in a short time. A track is cut wherever it turns more sharply than that allows. Of
the segments, those are kept that can be driven one after the other and have most poses together.
A rejected pose was not measured but mistaken: a reflection, a torn frame or a frame out of order,
for one frame or for many.
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


class Flag(IntEnum):
    """Whether a frame has a pose, or the reason why it was rejected.

    Attributes:
        OK: it has a pose.
        MISSING: no marker was detected.
        AMBIGUOUS: a marker was detected twice.
        REPEATED: its picture is identical to that of the frame before.
        SHAPE: the corners are not those of a marker of this size.
        JUMP: the pose does not fit those of the frames around.
    """

    OK = 0
    MISSING = 1
    AMBIGUOUS = 2
    REPEATED = 3
    SHAPE = 4
    JUMP = 5

    @property
    def word(self) -> str:
        """Its name in files and messages."""
        return self.name.lower()


LEAST_NOISE = 0.05
"""Smallest std of a corner [pixel]; a smaller estimate is not credible."""
SHARED = 0.05
"""Std of the error that all corners of a frame share [pixel]; residuals do not show it."""
ODD_SQUARES = 25.0
"""Mean squared residual, relative to its median, above which corners are not a marker's."""
ODD_LEAST = 1.0
"""Root mean square residual [pixel] below which corners are a marker's whatever the median is: an
edge along the pixels' rows is located better than a slanted one, so residuals vary with heading."""
ODD_SIZE = 0.05
"""Part by which a marker's size in a frame may differ from its median."""
WRONG_SIZE = 0.02
"""Part by which the median size may differ from the stated one: more is a wrong height or size."""
LEAST_TRACKED = 0.5
"""Part of the frames that should have a pose."""


@dataclass(frozen=True, eq=False)
class TrackedPoses:
    """Poses of one body, a row for each frame.

    Attributes:
        target: the body.
        frame, time: number and time [s] of every frame.
        pose: x, y [m], heading [rad] without wrap-around; NaN where the flag is not `OK`.
        covariance: covariance of the pose [m, rad]; NaN likewise.
        rejected: the fitted pose of a rejected frame, else NaN.
        flag: number of a `Flag`.
        size: apparent over true size of the markers [1].
        corner_std: std of the error of a corner [pixel], from the residuals.
        apparent_height: height of the markers above the floor that their size in the picture
            implies [m].
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
        """Frames that have a pose."""
        return np.asarray(self.flag == Flag.OK)

    @property
    def share(self) -> float:
        """Part of the frames that have a pose [1]."""
        return float(self.good.mean()) if len(self.flag) else 0.0

    @property
    def median_size(self) -> float:
        """Median of the apparent over the true size [1]; NaN where no frame has a pose."""
        return float(np.median(self.size[self.good])) if self.good.any() else float("nan")

    def count(self, flag: Flag) -> int:
        """Return the number of frames with a flag."""
        return int((self.flag == flag).sum())

    def doubts(self) -> list[str]:
        """Return sentences on why the poses should not be used as they are; none if all is well."""
        name, out = self.target.name, []
        if self.share < LEAST_TRACKED:
            out.append(
                f"{name}: {self.good.sum()} of {len(self.flag)} frames have a pose; the others "
                "say in column 'flag' why not"
            )
        if self.count(Flag.AMBIGUOUS) > (1 - LEAST_TRACKED) * len(self.flag):
            out.append(
                f"{name}: its marker is detected twice in {self.count(Flag.AMBIGUOUS)} frames "
                "(another robot, a mirror?); --region keeps to a part of the picture"
            )
        if abs(self.median_size - 1) > WRONG_SIZE:
            out.append(
                f"{name}: markers look {100 * (self.median_size - 1):+.1f} % larger than they are, "
                f"at {self.target.height:g} m above the floor; if their size is right they are at "
                f"{self.apparent_height:.3f} m, and every path length is wrong by about as much"
            )
        return out

    def summary(self) -> str:
        """Return a sentence about the number of poses and their accuracy."""
        text = f"{self.target.name}: {int(self.good.sum())} of {len(self.flag)} frames have a pose"
        others = [flag for flag in Flag if flag is not Flag.OK and self.count(flag)]
        if others:
            text += f" (others: {', '.join(f'{self.count(f)} {f.word}' for f in others)})"
        if not self.good.any():
            return text
        std = np.sqrt(np.diagonal(self.covariance[self.good], axis1=1, axis2=2).mean(axis=0))
        return (
            f"{text}; std {1e3 * max(std[0], std[1]):.2f} mm and {np.degrees(std[2]):.3f} deg, "
            f"corners err by {self.corner_std:.2f} pixel; size in the picture implies a height of "
            f"{self.apparent_height:.3f} m ({self.target.height:g} stated)"
        )


def track_of(camera: OverheadCamera, target: Target, detections: Detections) -> TrackedPoses:
    """Return the tracked poses of a body by the detections of its markers."""
    ids = [marker.id for marker in target.markers]
    twice = (detections.counts(ids) > 1).any(axis=1)
    fit = poses_of(camera, target, detections.corners_of(ids))
    present = np.isfinite(fit.pose).all(axis=1)
    flag = np.where(twice, Flag.AMBIGUOUS, np.where(present, Flag.OK, Flag.MISSING))
    flag[detections.repeated] = Flag.REPEATED
    mean_square = fit.squares / np.maximum(fit.free, 1.0)
    flag[_odd(mean_square, fit.size, present) & (flag == Flag.OK)] = Flag.SHAPE
    noise = _corner_std(mean_square[flag == Flag.OK])
    corners_used = 0.5 * (fit.free + 4.0)
    variance = noise**2 + corners_used * SHARED**2
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


def _odd(
    mean_square: Float[np.ndarray, " frame"],
    size: Float[np.ndarray, " frame"],
    present: Bool[np.ndarray, " frame"],
) -> Bool[np.ndarray, " frame"]:
    """Return the frames whose residuals are too large, or whose marker has another size."""
    odd = np.zeros(len(size), bool)
    if present.any():
        usual = max(float(np.median(mean_square[present])), LEAST_NOISE**2)
        odd[present] = mean_square[present] > max(ODD_SQUARES * usual, ODD_LEAST**2)
        odd[present] |= np.abs(size[present] / np.median(size[present]) - 1) > ODD_SIZE
    return odd


def _corner_std(mean_square: Float[np.ndarray, " frame"]) -> float:
    """Return the std of a corner [pixel] by the mean squared residuals of good frames."""
    return max(LEAST_NOISE, float(np.sqrt(mean_square.mean()))) if len(mean_square) else LEAST_NOISE
