"""Poses of a body through a video, each with its covariance or with the reason why it has none."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.camera.overhead import OverheadCamera
from slipid.camera.tracking.outliers import jumps
from slipid.camera.tracking.pose import poses_of
from slipid.camera.tracking.sightings import Sightings
from slipid.camera.tracking.target import Target


class Flag(IntEnum):
    """What is said of a frame.

    Attributes:
        OK: it has a pose.
        MISSING: no marker was found.
        AMBIGUOUS: a marker is in it twice.
        REPEATED: it is the very picture of the frame before.
        SHAPE: the corners are those of no marker of this size.
        JUMP: the pose does not fit to those of the frames around.
    """

    OK = 0
    MISSING = 1
    AMBIGUOUS = 2
    REPEATED = 3
    SHAPE = 4
    JUMP = 5

    @property
    def word(self) -> str:
        """How files and messages call it."""
        return self.name.lower()


LEAST_NOISE = 0.05
"""Least std of a corner that is believed [pixel]."""
SHARED = 0.05
"""What all corners of a frame err in common [pixel]: nothing that is left over shows it."""
ODD_SQUARES = 25.0
"""Mean square left over, in units of the usual one, from which on corners are no marker's."""
ODD_LEAST = 1.0
"""Root mean square left over [pixel] below which corners are a marker's whatever is usual: an edge
along the pixels' rows is found better than one aslant, and a heading that changes is no mistake."""
ODD_SIZE = 0.05
"""Part by which a marker's size in a frame may differ from its usual one."""
WRONG_SIZE = 0.02
"""Part by which the usual size may differ from the stated one: more is a wrong height or size."""
LEAST_SEEN = 0.5
"""Part of the frames that should have a pose."""


@dataclass(frozen=True, eq=False)
class Track:
    """Poses of one body, a row per frame.

    Attributes:
        target: the body.
        frame, time: number and time [s] of every frame.
        pose: x, y [m], heading [rad] without wrap-around; NaN where the flag is not `OK`.
        covariance: of the pose [m, rad]; NaN likewise.
        rejected: a pose that was found and not believed, else NaN.
        flag: number of a `Flag`.
        size: how large the markers look over what they are [1].
        corner_std: std of the error of a corner [pixel], from what is left over.
        height_told: height of the markers above the floor that their size in the picture tells [m].
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
    height_told: float

    @property
    def good(self) -> Bool[np.ndarray, " frame"]:
        """Frames that have a pose."""
        return np.asarray(self.flag == Flag.OK)

    @property
    def seen(self) -> float:
        """Part of the frames that have a pose."""
        return float(self.good.mean()) if len(self.flag) else 0.0

    @property
    def usual_size(self) -> float:
        """Median of the size over what was stated [1]; NaN where no frame has a pose."""
        return float(np.median(self.size[self.good])) if self.good.any() else float("nan")

    def count(self, flag: Flag) -> int:
        """Frames with a flag."""
        return int((self.flag == flag).sum())

    def doubts(self) -> list[str]:
        """Why these poses should not be used as they are; empty where nothing speaks against."""
        name, out = self.target.name, []
        if self.seen < LEAST_SEEN:
            found = f"{self.good.sum()} of {len(self.flag)} frames have a pose"
            out.append(f"{name}: {found}; the others say in column 'flag' why not")
        if self.count(Flag.AMBIGUOUS) > (1 - LEAST_SEEN) * len(self.flag):
            out.append(
                f"{name}: its marker is seen twice in {self.count(Flag.AMBIGUOUS)} frames (another "
                "robot, a mirror?); --region keeps to a part of the picture"
            )
        if abs(self.usual_size - 1) > WRONG_SIZE:
            out.append(
                f"{name}: markers look {100 * (self.usual_size - 1):+.1f} % larger than they are, "
                f"at {self.target.height:g} m above the floor; if their size is right they are at "
                f"{self.height_told:.3f} m, and every way is wrong by about as much"
            )
        return out


def track_of(camera: OverheadCamera, target: Target, seen: Sightings) -> Track:
    """Poses of a body from where its markers were seen."""
    corners, twice = seen.of([marker.id for marker in target.markers])
    found = poses_of(camera, target, corners)
    there = np.isfinite(found.pose).all(axis=1)
    flag = np.where(twice, Flag.AMBIGUOUS, np.where(there, Flag.OK, Flag.MISSING))
    flag[seen.repeated] = Flag.REPEATED
    mean_square = found.squares / np.maximum(found.free, 1.0)
    odd = _odd(mean_square, found.size, there)
    flag[odd & (flag == Flag.OK)] = Flag.SHAPE
    noise = _corner_std(mean_square[flag == Flag.OK])
    corners_used = 0.5 * (found.free + 4.0)
    variance = noise**2 + corners_used * SHARED**2
    covariance = variance[:, None, None] * found.unit_covariance
    believed = np.where((flag == Flag.OK)[:, None], found.pose, np.nan)
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    flag[jumps(seen.time, believed, std)] = Flag.JUMP
    good = flag == Flag.OK
    pose = np.where(good[:, None], found.pose, np.nan)
    pose[good, 2] = np.unwrap(pose[good, 2])
    size = float(np.median(found.size[good])) if good.any() else float("nan")
    return Track(
        target=target,
        frame=seen.frame,
        time=seen.time,
        pose=pose,
        covariance=np.where(good[:, None, None], covariance, np.nan),
        rejected=np.where(good[:, None], np.nan, found.pose),
        flag=flag,
        size=found.size,
        corner_std=noise,
        height_told=camera.height - (camera.height - target.height) / size,
    )


def _odd(
    mean_square: Float[np.ndarray, " frame"],
    size: Float[np.ndarray, " frame"],
    there: Bool[np.ndarray, " frame"],
) -> Bool[np.ndarray, " frame"]:
    """Frames whose corners are left over too much, or make a marker of another size."""
    odd = np.zeros(len(size), bool)
    if there.any():
        usual = max(float(np.median(mean_square[there])), LEAST_NOISE**2)
        odd[there] = mean_square[there] > max(ODD_SQUARES * usual, ODD_LEAST**2)
        odd[there] |= np.abs(size[there] / np.median(size[there]) - 1) > ODD_SIZE
    return odd


def _corner_std(mean_square: Float[np.ndarray, " frame"]) -> float:
    """Std of a corner [pixel] from what is left over in good frames."""
    return max(LEAST_NOISE, float(np.sqrt(mean_square.mean()))) if len(mean_square) else LEAST_NOISE


def summary(tracks: Sequence[Track]) -> list[str]:
    """What was found of every body, a sentence each."""
    return [_sentence(track) for track in tracks]


def _sentence(track: Track) -> str:
    counts = [f"{track.count(f)} {f.word}" for f in Flag if f is not Flag.OK and track.count(f)]
    words = f"{track.target.name}: {int(track.good.sum())} of {len(track.flag)} frames have a pose"
    if counts:
        words += f" (others: {', '.join(counts)})"
    if not track.good.any():
        return words
    std = np.sqrt(np.diagonal(track.covariance[track.good], axis1=1, axis2=2).mean(axis=0))
    return (
        f"{words}; std {1e3 * max(std[0], std[1]):.2f} mm and {np.degrees(std[2]):.3f} deg, "
        f"corners err by {track.corner_std:.2f} pixel; size in the picture tells a height of "
        f"{track.height_told:.3f} m ({track.target.height:g} stated)"
    )
