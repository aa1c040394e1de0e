"""`slipid track`: poses of marked bodies from a video, a folder of images or a camera."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slipid.camera.frame import FrameSource, cut_off, read_ahead, uneven
from slipid.camera.frame_source import Device
from slipid.camera.opencv import cv2, marker_count
from slipid.camera.overhead import OverheadCamera
from slipid.camera.tracking.detections import detect_all, only_marker
from slipid.camera.tracking.detector import MarkerDetector, MarkerTracker, Region
from slipid.camera.tracking.outputs import (
    check_drawable,
    check_writable,
    write_poses,
    write_preview,
)
from slipid.camera.tracking.target import Marker, Target
from slipid.camera.tracking.track import Flag, TrackedPoses, track_of
from slipid.support.checkpoint import Checkpoint, key_of, source_hash
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from slipid.support.quantities import Degrees, Height, MarkerEdge, limits_of

SCHEMA = "slipid.track/1"


@dataclass(frozen=True, eq=False)
class TrackingResult:
    """Tracked poses of all bodies in a video.

    Attributes:
        source: the frames.
        tracks: tracked poses of every body.
        notes: sentences for the user about frame times and the poses.
        doubts: sentences about reasons not to use the poses as they are; empty for good poses.
        checkpoint: checkpoint with the detections, kept until the poses are written.
    """

    source: FrameSource
    tracks: tuple[TrackedPoses, ...]
    notes: tuple[str, ...]
    doubts: tuple[str, ...]
    checkpoint: Checkpoint

    def write(self, path: Path) -> list[Path]:
        """Write the poses to a file, remove the checkpoint, and return the files written.

        If there are several bodies, each one gets its own file, whose name ends in the body's name.
        """
        names = pose_files(path, [track.target for track in self.tracks])
        for name, track in zip(names, self.tracks, strict=True):
            write_poses(name, track)
        self.checkpoint.remove()
        return names

    def to_json(self) -> Content:
        """Return a summary of the results for programs; the poses are in separate files."""
        return {
            "schema": SCHEMA,
            "source": self.source.name,
            "frames": len(self.tracks[0].frame),
            "targets": {track.target.name: _content(track) for track in self.tracks},
            "notes": list(self.notes),
            "doubts": list(self.doubts),
        }


def _content(track: TrackedPoses) -> Content:
    good = track.good.any()
    return {
        "poses": int(track.good.sum()),
        "flags": {flag.word: track.count(flag) for flag in Flag},
        "corner_std_px": track.corner_std,
        "size": track.median_size if good else None,
        "height_m": track.target.height,
        "height_told_m": track.apparent_height if good else None,
    }


def track(
    source: FrameSource,
    camera: OverheadCamera,
    targets: tuple[Target, ...],
    checkpoint: Path,
    report: Reporter,
    region: Region | None = None,
) -> TrackingResult:
    """Return the poses of marked bodies in every frame of a source.

    Args:
        source: the frames, see `open_source`.
        camera: calibrated camera with its pose above the floor.
        targets: the bodies and their markers, all of one dictionary.
        checkpoint: folder of the checkpoint from which an interrupted job resumes; it is removed
            once the poses are written.
        report: receives the progress.
        region: region of the image to which detections are limited.

    Raises:
        DataError: frames do not have the size at which the camera was calibrated, a marker is not
            below the camera, the region is outside the image, no frame shows a marker of the
            bodies, or times do not increase.
    """
    camera.lens.check_size(source.image_px, source.name)
    for target in targets:
        target.below(camera.height)
    ids = frozenset(number for target in targets for number in target.ids)
    if region is not None and region.within(Region(0, 0, *camera.lens.image_px)).empty:
        width, height = camera.lens.image_px
        raise DataError(
            f"--region is outside the image; expected a region within 0,0,{width},{height}"
        )
    dictionary = targets[0].dictionary
    kept = Checkpoint(
        checkpoint,
        key_of(
            *(source.identity, dictionary, sorted(ids), region),
            *(source_hash("camera"), cv2.__version__),
        ),
    )
    tracker = MarkerTracker(MarkerDetector(dictionary), ids, region)
    detections = detect_all(source, tracker, kept, report)
    tracks = tuple(track_of(camera, target, detections) for target in targets)
    notes = [*source.notes, *filter(None, [uneven(detections.time)])]
    doubts = [*source.faults, *filter(None, [cut_off(source, len(detections.frame))])]
    return TrackingResult(
        source,
        tracks,
        (*notes, *(track.summary() for track in tracks)),
        (*doubts, *(doubt for track in tracks for doubt in track.doubts())),
        kept,
    )


def pose_files(path: Path, bodies: Sequence[Target]) -> list[Path]:
    """Return the file of poses for each body: the path itself if there is only one body."""
    if len(bodies) == 1:
        return [path]
    return [path.with_stem(f"{path.stem}_{body.name}") for body in bodies]


def check_outputs(source: FrameSource, out: Path, preview: Path | None) -> None:
    """Raise `DataError`, before the tracking starts, unless its results can be written.

    Raises:
        DataError: a file cannot be written, or a preview is requested of a device, since a device's
            frames cannot be read again.
    """
    check_writable(out)
    if preview is not None:
        if isinstance(source, Device):
            raise DataError(
                f"{source.name}: --preview is not possible for a device, whose frames are not "
                "kept; expected a video or a folder of images, or no --preview"
            )
        check_drawable(preview)


@dataclass(frozen=True)
class LoneMarker:
    """A single marker in the middle of a body.

    Attributes:
        size: edge length of its black square [m].
        height: height of the marker above the floor [m].
        id: number of the marker; None for the only marker in view.
        dictionary: name of its dictionary.
        yaw: direction of its top edge, counter-clockwise from ahead [rad].
    """

    size: float
    height: float
    id: int | None = None
    dictionary: str = "4X4_50"
    yaw: float = 0.0

    def __post_init__(self) -> None:
        for option, value, kind in (
            ("--marker-size", self.size, MarkerEdge),
            ("--marker-height", self.height, Height),
            ("--marker-yaw", float(np.degrees(self.yaw)), Degrees),
        ):
            if not limits_of(kind).holds(value):
                raise DataError(f"{option} {value:g}; expected a number {limits_of(kind)}")
        most = marker_count(self.dictionary) - 1
        if self.id is not None and self.id > most:
            raise DataError(f"--id {self.id}; expected 0 to {most} in {self.dictionary}")

    def target(self, source: FrameSource, report: Reporter, region: Region | None = None) -> Target:
        """Return the body with its marker.

        If the marker has no number, the first frames, or a region of them, are searched for it.

        Raises:
            DataError: no marker is in view, or several are in view.
        """
        number = self.id
        if number is None:
            number = only_marker(source, MarkerDetector(self.dictionary), region, report)
        marker = Marker.at(number, self.size, self.height, yaw=self.yaw)
        return Target("robot", self.dictionary, (marker,))


def preview(path: Path, result: TrackingResult, camera: OverheadCamera, number: int | None) -> int:
    """Draw the tracked poses into one frame, and return the number of that frame.

    Args:
        path: the image to write.
        result: tracked poses.
        camera: the camera that took the video.
        number: number of the frame; by default the first in which every body has a pose.

    Raises:
        DataError: there is no frame of that number, or the file cannot be written.
    """
    tracks = result.tracks
    if number is None:
        complete = np.logical_and.reduce([track.good for track in tracks])
        number = int(tracks[0].frame[int(np.argmax(complete))])
    rows = np.flatnonzero(tracks[0].frame == number)
    if not len(rows):
        raise DataError(
            f"{result.source.name}: no frame {number}; expected 0 to {tracks[0].frame[-1]}"
        )
    with closing(read_ahead(result.source.frames(number))) as frames:
        write_preview(path, next(frames).grey, camera, tracks, int(rows[0]))
    return number
