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
from slipid.camera.opencv import Grey
from slipid.camera.search import MIRRORED, mirror_image, visible_markers
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
                        report.line(_others(source, frame.grey, tracker, report))
                        report.stage("tracking")
                before = frame.grey
                if clock.monotonic() > saved + CHECKPOINT_S:
                    checkpoint.save(CHECKPOINT_NAME, vars(Detections.of(log)))
                    saved = clock.monotonic()
                report.advance(len(log["frame"]), max(source.count or 0, len(log["frame"])))
        except KeyboardInterrupt:
            checkpoint.save(CHECKPOINT_NAME, vars(Detections.of(log)))
            raise
    if len(log["frame"]) > 1 and all(log["repeated"][1:]):
        raise DataError(
            f"{source.name}: all {len(log['frame'])} frames are identical; expected a recording "
            "whose frames differ at least by noise: the camera or the recording has stopped"
        )
    if not log["row"]:
        last = _not_uniform(source, before)
        raise DataError(f"{source.name}: {_others(source, last, tracker, report)}")
    return Detections.of(log)


def _others(source: FrameSource, grey: Grey, tracker: MarkerTracker, report: Reporter) -> str:
    """Return advice if no frame so far, the last of which is given, shows any tracked marker.

    Raises:
        DataError: the frame shows a tracked marker mirrored.
    """
    wanted = ", ".join(map(str, sorted(tracker.ids)))
    part = cut(grey, tracker.region)
    _refuse_mirrored(source, part, tracker.detector, tracker.ids)
    visible = {d.id for d in tracker.detector.detect(grey, tracker.region)}
    if others := sorted(visible - tracker.ids):
        return (
            f"marker {wanted} is in no frame so far, but {_numbers(others)} in view; expected "
            f"--id {others[0]}, or a file of targets"
        )
    found = f"marker {wanted} is in no frame so far"
    report.stage("searching for markers of any dictionary")
    visible_now = visible_markers([part], report.steps)
    if not visible_now.numbers:
        return f"{found}; expected it in view, sharp, flat, with a white margin around it"
    where = f"{_numbers(visible_now.numbers)} of the dictionary {visible_now.dictionary}"
    if visible_now.mirrored:
        return f"{found}, but {where} {MIRRORED}"
    return f"{found}, but {where} in view; expected --dictionary {visible_now.dictionary}"


def _not_uniform(source: FrameSource, grey: Grey | None) -> Grey:
    """Return the last frame that was searched; raise `DataError` if all its pixels are equal."""
    if grey is None:
        raise DataError(f"{source.name}: no frame; expected a video with frames")
    if not np.ptp(grey):
        raise DataError(
            f"{source.name}: no marker, and every pixel of the last searched frame is "
            f"{grey.flat[0]}; expected frames that show the floor: is the lens covered, or the "
            "video empty?"
        )
    return grey


def _refuse_mirrored(
    source: FrameSource, part: Grey, detector: MarkerDetector, ids: frozenset[int] | None
) -> None:
    """Raise `DataError` if markers with these numbers can be read only mirrored.

    `part` is the searched part of a frame without these markers; `ids` is None for any number.
    """
    mirrored = {d.id for d in detector.detect(mirror_image(part))}
    if mirrored and (ids is None or mirrored & ids):
        raise DataError(f"{source.name}: {_numbers(sorted(mirrored))} {MIRRORED}")


def _numbers(ids: Sequence[int]) -> str:
    return f"marker{'s' if len(ids) > 1 else ''} {', '.join(map(str, ids))}"


def only_marker(
    source: FrameSource, detector: MarkerDetector, region: Region | None, report: Reporter
) -> int:
    """Return the number of the only marker in the first frames of a video, or in a region of them.

    Raises:
        DataError: these frames show no marker of the dictionary, or several.
    """
    report.stage("searching for the marker")
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
    part = cut(_not_uniform(source, last), region)
    _refuse_mirrored(source, part, detector, None)
    report.stage("searching for markers of any dictionary")
    visible = visible_markers([part], report.steps)
    if visible.numbers:
        end = (
            MIRRORED if visible.mirrored else f"in view; expected --dictionary {visible.dictionary}"
        )
        raise DataError(
            f"{source.name}: no marker of the requested dictionary, but "
            f"{_numbers(visible.numbers)} of {visible.dictionary} {end}"
        )
    raise DataError(
        f"{source.name}: no marker of any dictionary in the first frames; expected a marker in "
        "view, sharp, flat, with a white margin around it; if it comes into view later, give --id"
    )
