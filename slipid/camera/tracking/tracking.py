"""`slipid track`: poses of marked bodies from a video, a folder of pictures or a camera."""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slipid.camera.frames.frame import Source, ahead, cut_off, uneven
from slipid.camera.frames.video import Device
from slipid.camera.opencv import marker_dictionary, opencv
from slipid.camera.overhead import OverheadCamera
from slipid.camera.tracking.finder import Finder, MarkerDetector, Region
from slipid.camera.tracking.poses_file import can_write, write_poses
from slipid.camera.tracking.preview import can_draw, write_preview
from slipid.camera.tracking.sightings import look_through, only_marker
from slipid.camera.tracking.target import Marker, Target
from slipid.camera.tracking.track import Flag, Track, summary, track_of
from slipid.support.checkpoint import Checkpoint, key_of, source_hash
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.progress import Reporter

SCHEMA = "slipid.track/1"


@dataclass(frozen=True, eq=False)
class Tracked:
    """What a video told.

    Attributes:
        source: what was looked at.
        tracks: of every body.
        notes: what a person should know, a sentence each.
        doubts: why the poses should not be used as they are; empty where nothing speaks against.
        kept: what was found, to be found again should the poses not be written.
    """

    source: Source
    tracks: tuple[Track, ...]
    notes: tuple[str, ...]
    doubts: tuple[str, ...]
    kept: Checkpoint

    def write(self, path: Path) -> list[Path]:
        """Write the poses: one body to this file, of several each to one with its name added."""
        names = [path]
        if len(self.tracks) > 1:
            names = [path.with_stem(f"{path.stem}_{t.target.name}") for t in self.tracks]
        for name, track in zip(names, self.tracks, strict=True):
            write_poses(name, track)
        self.kept.remove()
        return names

    def to_json(self) -> Content:
        """What programs read of it; the poses themselves are in files of their own."""
        return {
            "schema": SCHEMA,
            "source": self.source.name,
            "frames": len(self.tracks[0].frame),
            "targets": {track.target.name: _content(track) for track in self.tracks},
            "notes": list(self.notes),
            "doubts": list(self.doubts),
        }


def _content(track: Track) -> Content:
    good = track.good.any()
    return {
        "poses": int(track.good.sum()),
        "flags": {flag.word: track.count(flag) for flag in Flag},
        "corner_std_px": track.corner_std,
        "size": track.usual_size if good else None,
        "height_m": track.target.height,
        "height_told_m": track.height_told if good else None,
    }


def track(
    source: Source,
    camera: OverheadCamera,
    targets: tuple[Target, ...],
    checkpoint: Path,
    report: Reporter,
    region: Region | None = None,
) -> Tracked:
    """Poses of marked bodies in every frame of a source.

    Args:
        source: where the frames come from, see `open_source`.
        camera: calibrated, with its place above the floor.
        targets: the bodies and their markers, all of one dictionary.
        checkpoint: folder for what is done, from which it goes on after an interrupt; it is taken
            away once the poses are written.
        report: is told how far it is.
        region: the part of the picture that counts.

    Raises:
        DataError: frames of another size than the camera was calibrated at, no marker in any frame,
            times that do not increase.
    """
    camera.of_size(source.image_px, source.name)
    for target in targets:
        target.below(camera.height)
    ids = frozenset(number for target in targets for number in target.ids)
    if region is not None and region.within(Region(0, 0, *camera.lens.image_px)).empty:
        width, height = camera.lens.image_px
        raise DataError(f"--region lies outside; expected a part of 0,0,{width},{height}")
    finder = Finder(MarkerDetector(targets[0].dictionary), ids, region)
    kept = Checkpoint(
        checkpoint,
        key_of(
            *(source.identity, targets[0].dictionary, sorted(ids), region),
            *(source_hash("camera"), opencv().__version__),
        ),
    )
    seen = look_through(source, finder, kept, report)
    tracks = tuple(track_of(camera, target, seen) for target in targets)
    notes = [sentence for sentence in (uneven(seen.time),) if sentence]
    short = cut_off(source, len(seen.frame))
    doubts = [*([short] if short else []), *(d for t in tracks for d in t.doubts())]
    return Tracked(source, tracks, (*notes, *summary(tracks)), tuple(doubts), kept)


def before_long_work(source: Source, out: Path, drawn: Path | None) -> None:
    """Try what comes after it.

    Raises:
        DataError: nothing can be written there, or a device should be drawn: what it showed is
            gone by then.
    """
    can_write(out)
    if drawn is not None:
        if isinstance(source, Device):
            raise DataError(
                f"{source.name}: --preview of a device, whose frames are not kept; expected a "
                "video or a folder of pictures"
            )
        can_draw(drawn)


@dataclass(frozen=True)
class LoneMarker:
    """One marker in the middle of a body.

    Attributes:
        size: edge of its black square [m].
        height: above the floor [m].
        id: its number; None for the only one that is in view.
        yaw: of its top edge, counter-clockwise from ahead [rad].
    """

    size: float
    height: float
    id: int | None = None
    dictionary: str = "4X4_50"
    yaw: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.size < np.inf:
            raise DataError(f"--marker-size {self.size:g}; expected the edge in metres")
        if not 0 <= self.height < np.inf:
            raise DataError(
                f"--marker-height {self.height:g}; expected it in metres above the floor"
            )
        if not np.isfinite(self.yaw):
            raise DataError(f"--marker-yaw {np.degrees(self.yaw):g}; expected an angle in degrees")
        most = len(marker_dictionary(self.dictionary).bytesList) - 1
        if self.id is not None and self.id > most:
            raise DataError(f"--id {self.id}; expected 0 to {most} in {self.dictionary}")

    def target(self, source: Source, region: Region | None = None) -> Target:
        """The body; its marker is looked for, in a part of the picture, where it has no number.

        Raises:
            DataError: no marker in view, or several.
        """
        number = self.id
        if number is None:
            number = only_marker(source, MarkerDetector(self.dictionary), region)
        marker = Marker.at(number, self.size, self.height, yaw=self.yaw)
        return Target("robot", self.dictionary, (marker,))


def preview(path: Path, tracked: Tracked, camera: OverheadCamera, number: int | None) -> int:
    """Draw what was found in one frame; the number of that frame.

    Args:
        number: of the frame; by default the first one in which every body has a pose.

    Raises:
        DataError: there is no frame of that number, or nothing can be written there.
    """
    tracks = tracked.tracks
    if number is None:
        all_seen = np.logical_and.reduce([track.good for track in tracks])
        number = int(tracks[0].frame[int(np.argmax(all_seen))])
    rows = np.flatnonzero(tracks[0].frame == number)
    if not len(rows):
        raise DataError(
            f"{tracked.source.name}: no frame {number}; expected 0 to {tracks[0].frame[-1]}"
        )
    with closing(ahead(tracked.source.frames(number))) as frames:
        write_preview(path, next(frames).grey, camera, tracks, int(rows[0]))
    return number
