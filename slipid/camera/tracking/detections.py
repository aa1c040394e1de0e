"""Detections of markers throughout a video, with a checkpoint from which a job can resume."""

import time as clock
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.camera.frame import FrameSource, read_ahead
from slipid.camera.opencv import Grey, visible_markers
from slipid.camera.tracking.detector import MarkerDetector, MarkerTracker, Region, cut
from slipid.support.checkpoint import Checkpoint
from slipid.support.errors import DataError
from slipid.support.progress import Reporter

CHECKPOINT_S = 10.0
"""Time between two checkpoints [s]."""
CHECKPOINT_NAME = "sightings"
"""Name under which the detections are stored in a checkpoint."""
KINDS = {"frame": int, "time": float, "repeated": bool, "row": int, "id": int, "corners": float}
"""Number type of each attribute of `Detections`."""
FIRST_FRAMES = 100
"""Number of frames without a tracked marker after which a message lists the visible markers."""


@dataclass(frozen=True, eq=False)
class Detections:
    """All detections of the tracked markers in all frames.

    Attributes:
        frame, time: number and time [s] of every frame.
        repeated: True if a frame's image is identical to that of the frame before.
        row: frame of each detection, as an index into `frame`.
        id: number of the detected marker.
        corners: x, y of the detected marker's corners in OpenCV's order [pixel].
    """

    frame: Int[np.ndarray, " frame"]
    time: Float[np.ndarray, " frame"]
    repeated: Bool[np.ndarray, " frame"]
    row: Int[np.ndarray, " detection"]
    id: Int[np.ndarray, " detection"]
    corners: Float[np.ndarray, "detection 4 2"]

    @classmethod
    def of(cls, lists: dict[str, list[Any]]) -> "Detections":
        """Return the detections as arrays, from lists keyed by the names of the attributes."""
        arrays = {name: np.array(lists[name], kind) for name, kind in KINDS.items()}
        return cls(**arrays | {"corners": arrays["corners"].reshape(-1, 4, 2)})

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


def detect_all(
    source: FrameSource, tracker: MarkerTracker, checkpoint: Checkpoint, report: Reporter
) -> Detections:
    """Return the detections in every frame; the job resumes from a checkpoint if there is one.

    Raises:
        DataError: no frame shows any tracked marker; the message lists the visible markers.
    """
    kept = checkpoint.load(CHECKPOINT_NAME) or {}
    log = {name: list(kept.get(name, ())) for name in KINDS}
    known, saved = len(log["frame"]), clock.monotonic()
    if known:
        report.line(f"resuming at frame {known}")
    report.stage("tracking")
    before: Grey | None = None
    # read the last frame of the checkpoint again, to check whether the next frame repeats it
    with closing(read_ahead(source.frames(max(0, known - 1)))) as frames:
        try:
            for frame in frames:
                if frame.index >= known:
                    repeated = before is not None and np.array_equal(before, frame.grey)
                    found = [] if repeated else tracker.detect(frame.grey, frame.index)
                    log["row"] += [len(log["frame"])] * len(found)
                    log["id"] += [one.id for one in found]
                    log["corners"] += [one.corners for one in found]
                    log["frame"].append(frame.index)
                    log["time"].append(frame.time)
                    log["repeated"].append(repeated)
                    if len(log["frame"]) == FIRST_FRAMES and not log["row"]:
                        report.line(_others(frame.grey, tracker) or "no marker detected so far")
                before = frame.grey
                if clock.monotonic() > saved + CHECKPOINT_S:
                    checkpoint.save(CHECKPOINT_NAME, vars(Detections.of(log)))
                    saved = clock.monotonic()
                report.advance(len(log["frame"]), max(source.count or 0, len(log["frame"])))
        except KeyboardInterrupt:
            checkpoint.save(CHECKPOINT_NAME, vars(Detections.of(log)))
            raise
    if not log["row"]:
        if before is not None and (sentence := _others(before, tracker)):
            raise DataError(f"{source.name}: {sentence}")
        wanted = ", ".join(map(str, sorted(tracker.ids)))
        raise DataError(
            f"{source.name}: marker {wanted} in none of {len(log['frame'])} frames; expected the "
            "marker in view, sharp, flat, with a white margin around it"
        )
    return Detections.of(log)


def _others(grey: Grey, tracker: MarkerTracker) -> str | None:
    """Return advice if an image shows markers but no tracked marker; None otherwise."""
    wanted = ", ".join(map(str, sorted(tracker.ids)))
    visible = {d.id for d in tracker.detector.detect(grey, tracker.region)}
    if others := sorted(visible - tracker.ids):
        return (
            f"marker {wanted} is in no frame so far, but {_numbers(others)} in view; expected "
            f"--id {others[0]}, or a file of targets"
        )
    dictionary, numbers = visible_markers([cut(grey, tracker.region)])
    if not numbers:
        return None
    return (
        f"marker {wanted} is in no frame so far, but {_numbers(numbers)} of the dictionary "
        f"{dictionary} in view; expected --dictionary {dictionary}"
    )


def _numbers(ids: Sequence[int]) -> str:
    return f"marker{'s' if len(ids) > 1 else ''} {', '.join(map(str, ids))}"


def only_marker(source: FrameSource, detector: MarkerDetector, region: Region | None = None) -> int:
    """Return the number of the only marker in the first frames of a video, or in a region of them.

    Raises:
        DataError: these frames show no marker of the dictionary, or several.
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
            f"{source.name}: {_numbers(often)} in view; expected --id with the number of the "
            "robot's marker, or a file of targets"
        )
    dictionary, numbers = visible_markers([] if last is None else [cut(last, region)])
    if numbers:
        raise DataError(
            f"{source.name}: no marker of the requested dictionary, but {_numbers(numbers)} of "
            f"{dictionary} in view; expected --dictionary {dictionary}"
        )
    raise DataError(
        f"{source.name}: no marker of any dictionary in the first frames; expected a marker in "
        "view, sharp, flat, with a white margin around it; if it comes into view later, give --id"
    )
