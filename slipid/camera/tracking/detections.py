"""Detections of markers throughout a video, with a checkpoint from which a job can resume."""

import time as clock
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.camera.frame import Frame, FrameSource, read_ahead
from slipid.camera.opencv import Grey, visible_markers
from slipid.camera.tracking.detector import MarkerDetector, MarkerTracker, Region, cut
from slipid.support.checkpoint import Checkpoint
from slipid.support.errors import DataError
from slipid.support.progress import Reporter

KEPT_S = 10.0
"""Time between two checkpoints [s]."""
PART = "sightings"
"""Name under which a checkpoint stores the detections."""
FIRST_FRAMES = 100
"""Number of frames without any wanted marker after which a message lists the visible markers."""


@dataclass(frozen=True, eq=False)
class Detections:
    """All detections of the wanted markers in all frames.

    Attributes:
        frame, time: number and time [s] of every frame.
        repeated: True if a frame's picture is identical to that of the frame before.
        row: frame of each detection, as an index into `frame`.
        id: number of the detected marker.
        corners: x, y of its corners in OpenCV's order [pixel].
    """

    frame: Int[np.ndarray, " frame"]
    time: Float[np.ndarray, " frame"]
    repeated: Bool[np.ndarray, " frame"]
    row: Int[np.ndarray, " detection"]
    id: Int[np.ndarray, " detection"]
    corners: Float[np.ndarray, "detection 4 2"]

    def counts(self, ids: Sequence[int]) -> Int[np.ndarray, "frame marker"]:
        """Return the number of detections of each marker in each frame."""
        rows = [self.row[self.id == number] for number in ids]
        return np.stack([np.bincount(row, minlength=len(self.frame)) for row in rows], axis=1)

    def corners_of(self, ids: Sequence[int]) -> Float[np.ndarray, "frame marker 4 2"]:
        """Return the corners of markers [pixel], NaN if a marker was not detected exactly once."""
        corners = np.full((len(self.frame), len(ids), 4, 2), np.nan)
        for k, number in enumerate(ids):
            own = self.id == number
            corners[self.row[own], k] = self.corners[own]
        corners[self.counts(ids) > 1] = np.nan
        return corners


@dataclass(eq=False)
class _DetectionLog:
    """Detections so far, with the attributes of `Detections`."""

    frame: list[int] = field(default_factory=list)
    time: list[float] = field(default_factory=list)
    repeated: list[bool] = field(default_factory=list)
    row: list[int] = field(default_factory=list)
    id: list[int] = field(default_factory=list)
    corners: list[Float[np.ndarray, "4 2"]] = field(default_factory=list)

    def add(self, frame: Frame, repeated: bool, tracker: MarkerTracker) -> None:
        """Add a frame and the markers in it; a repeated frame is not searched for markers."""
        for detection in [] if repeated else tracker.detect(frame.grey, frame.index):
            self.row.append(len(self.frame))
            self.id.append(detection.id)
            self.corners.append(detection.corners)
        self.frame.append(frame.index)
        self.time.append(frame.time)
        self.repeated.append(repeated)

    def detections(self) -> Detections:
        return Detections(
            np.array(self.frame, int),
            np.array(self.time, float),
            np.array(self.repeated, bool),
            np.array(self.row, int),
            np.array(self.id, int),
            np.array(self.corners, float).reshape(-1, 4, 2),
        )

    @classmethod
    def resumed(cls, checkpoint: Checkpoint) -> "_DetectionLog":
        """Return the log stored in a checkpoint, or an empty one."""
        if (kept := checkpoint.load(PART)) is None:
            return cls()
        plain = {name: kept[name].tolist() for name in vars(cls()) if name != "corners"}
        return cls(**plain, corners=list(kept["corners"]))


def detect_all(
    source: FrameSource, tracker: MarkerTracker, checkpoint: Checkpoint, report: Reporter
) -> Detections:
    """Return the detections in every frame, continuing from a checkpoint if there is one.

    Raises:
        DataError: no frame shows any wanted marker; the message lists the visible markers.
    """
    log = _DetectionLog.resumed(checkpoint)
    if log.frame:
        report.line(f"going on from frame {len(log.frame)}")
    report.stage("tracking")
    before: Grey | None = None
    known, saved = len(log.frame), clock.monotonic()
    # the last frame of the checkpoint is read again, to check whether the next one repeats it
    with closing(read_ahead(source.frames(max(0, known - 1)))) as frames:
        try:
            for frame in frames:
                if frame.index >= known:
                    repeated = before is not None and np.array_equal(before, frame.grey)
                    log.add(frame, repeated, tracker)
                    if len(log.frame) == FIRST_FRAMES and not log.row:
                        report.line(_others(frame.grey, tracker) or "no marker in sight so far")
                before = frame.grey
                if clock.monotonic() > saved + KEPT_S:
                    checkpoint.save(PART, vars(log.detections()))
                    saved = clock.monotonic()
                report.advance(len(log.frame), max(source.count or 0, len(log.frame)))
        except KeyboardInterrupt:
            checkpoint.save(PART, vars(log.detections()))
            raise
    if not log.row:
        if before is not None and (sentence := _others(before, tracker)):
            raise DataError(f"{source.name}: {sentence}")
        wanted = ", ".join(map(str, sorted(tracker.ids)))
        raise DataError(
            f"{source.name}: marker {wanted} in none of {len(log.frame)} frames; expected it in "
            "view, sharp, flat, with a white margin around"
        )
    return log.detections()


def _others(grey: Grey, tracker: MarkerTracker) -> str | None:
    """Return advice if a picture shows markers, but none of the wanted ones; None otherwise."""
    wanted = ", ".join(map(str, sorted(tracker.ids)))
    visible = {d.id for d in tracker.detector.detect(grey, tracker.region)}
    if others := sorted(visible - tracker.ids):
        return (
            f"marker {wanted} is in no frame so far, but {_numbers(others)}; expected --id "
            f"{others[0]}, or a file of targets"
        )
    markers = visible_markers([cut(grey, tracker.region)])
    if not markers.numbers:
        return None
    return (
        f"marker {wanted} is in no frame so far, but {_numbers(markers.numbers)} of the dictionary "
        f"{markers.dictionary}; expected --dictionary {markers.dictionary}"
    )


def _numbers(ids: Sequence[int]) -> str:
    return f"marker{'s' if len(ids) > 1 else ''} {', '.join(map(str, ids))}"


def only_marker(source: FrameSource, detector: MarkerDetector, region: Region | None = None) -> int:
    """Return the number of the only marker in the first frames of a video, or in a region of them.

    Raises:
        DataError: these frames show no marker, or several.
    """
    counts: Counter[int] = Counter()
    last: Grey | None = None
    with closing(read_ahead(source.frames())) as frames:
        for frame in frames:
            last = frame.grey
            counts.update({d.id for d in detector.detect(frame.grey, region)})
            if frame.index >= FIRST_FRAMES or sum(counts.values()) >= FIRST_FRAMES // 4:
                break
    often = sorted(number for number, n in counts.items() if 5 * n >= max(counts.values()))
    if len(often) == 1:
        return often[0]
    if often:
        raise DataError(
            f"{source.name}: {_numbers(often)} in view; expected --id for the robot's, or a file "
            "of targets"
        )
    if last is not None and (markers := visible_markers([cut(last, region)])).numbers:
        raise DataError(
            f"{source.name}: no marker of this dictionary, but {_numbers(markers.numbers)} of "
            f"{markers.dictionary}; expected --dictionary {markers.dictionary}"
        )
    raise DataError(
        f"{source.name}: no marker of any dictionary in the first frames; expected one in view, "
        "sharp, flat, with a white margin around, or --id where it comes later"
    )
