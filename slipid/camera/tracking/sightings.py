"""Where markers were seen through a video: found frame by frame, kept so that it can go on."""

import time as clock
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from slipid.camera.frames.frame import Frame, Source, ahead
from slipid.camera.opencv import dictionary_names
from slipid.camera.tracking.finder import Finder, MarkerDetector, Region
from slipid.support.checkpoint import Checkpoint
from slipid.support.errors import DataError
from slipid.support.progress import Reporter

KEPT_S = 10.0
"""Time between two checkpoints [s]."""
PART = "sightings"
LOOKED = 100
"""Frames without any marker after which it is said what is in the picture instead."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """Every wanted marker in every frame.

    Attributes:
        frame, time: number and time [s] of every frame.
        repeated: frames with the very picture of the one before.
        row: frame of each sighting, as a row of `frame`.
        id: number of the marker.
        corners: x, y [pixel] as OpenCV counts them.
    """

    frame: Int[np.ndarray, " frame"]
    time: Float[np.ndarray, " frame"]
    repeated: Bool[np.ndarray, " frame"]
    row: Int[np.ndarray, " sighting"]
    id: Int[np.ndarray, " sighting"]
    corners: Float[np.ndarray, "sighting 4 2"]

    def of(
        self, ids: Sequence[int]
    ) -> tuple[Float[np.ndarray, "frame marker 4 2"], Bool[np.ndarray, " frame"]]:
        """Corners of some markers, NaN where one is not seen or seen twice; and where one is."""
        corners = np.full((len(self.frame), len(ids), 4, 2), np.nan)
        twice = np.zeros(len(self.frame), bool)
        for k, number in enumerate(ids):
            mine = self.id == number
            corners[self.row[mine], k] = self.corners[mine]
            times = np.bincount(self.row[mine], minlength=len(self.frame))
            corners[times > 1, k] = np.nan
            twice |= times > 1
        return corners, twice


@dataclass(eq=False)
class _Notebook:
    """What was seen so far."""

    frame: list[int] = field(default_factory=list)
    time: list[float] = field(default_factory=list)
    repeated: list[bool] = field(default_factory=list)
    row: list[int] = field(default_factory=list)
    id: list[int] = field(default_factory=list)
    corners: list[Float[np.ndarray, "4 2"]] = field(default_factory=list)

    def add(self, frame: Frame, repeated: bool, finder: Finder) -> None:
        """Note a frame and the markers in it; in a repeated one nothing is looked for."""
        for found in [] if repeated else finder.find(frame.grey, frame.index):
            self.row.append(len(self.frame))
            self.id.append(found.id)
            self.corners.append(found.corners)
        self.frame.append(frame.index)
        self.time.append(frame.time)
        self.repeated.append(repeated)

    def sightings(self) -> Sightings:
        return Sightings(
            np.array(self.frame, int),
            np.array(self.time, float),
            np.array(self.repeated, bool),
            np.array(self.row, int),
            np.array(self.id, int),
            np.array(self.corners, float).reshape(-1, 4, 2),
        )

    @classmethod
    def again(cls, kept: dict[str, np.ndarray]) -> "_Notebook":
        plain = {name: kept[name].tolist() for name in vars(cls()) if name != "corners"}
        return cls(**plain, corners=list(kept["corners"]))


def look_through(
    source: Source, finder: Finder, checkpoint: Checkpoint, report: Reporter
) -> Sightings:
    """Find the wanted markers in every frame; called again it goes on where it was cut off.

    Raises:
        DataError: no frame has any of them; the message says what was seen instead.
    """
    kept = checkpoint.load(PART)
    seen = _Notebook() if kept is None else _Notebook.again(kept)
    if seen.frame:
        report.line(f"going on from frame {len(seen.frame)}")
    report.stage("tracking")
    before: UInt8[np.ndarray, "row column"] | None = None
    known, saved = len(seen.frame), clock.monotonic()
    # the last known frame again: whether the next one repeats it
    with closing(ahead(source.frames(max(0, known - 1)))) as frames:
        try:
            for frame in frames:
                if frame.index >= known:
                    repeated = before is not None and np.array_equal(before, frame.grey)
                    seen.add(frame, repeated, finder)
                    if len(seen.frame) == LOOKED and not seen.row:
                        report.line(_others(frame.grey, finder) or "no marker in sight so far")
                before = frame.grey
                if clock.monotonic() > saved + KEPT_S:
                    checkpoint.save(PART, vars(seen.sightings()))
                    saved = clock.monotonic()
                report.advance(len(seen.frame), max(source.count or 0, len(seen.frame)))
        except KeyboardInterrupt:
            checkpoint.save(PART, vars(seen.sightings()))
            raise
    if not seen.row:
        if before is not None and (words := _others(before, finder)):
            raise DataError(f"{source.name}: {words}")
        wanted = ", ".join(map(str, sorted(finder.ids)))
        raise DataError(
            f"{source.name}: marker {wanted} in none of {len(seen.frame)} frames; expected it in "
            "view, sharp, flat, with a white margin around"
        )
    return seen.sightings()


def _others(grey: UInt8[np.ndarray, "row column"], finder: Finder) -> str | None:
    """What to do where a picture shows markers, but none that is wanted."""
    wanted = ", ".join(map(str, sorted(finder.ids)))
    if others := sorted({s.id for s in finder.detector.find(grey, finder.region)} - finder.ids):
        return (
            f"marker {wanted} is in no frame so far, but {_numbers(others)}; expected --id "
            f"{others[0]}, or a file of targets"
        )
    for name, ids in markers_in(grey, finder.region):
        return (
            f"marker {wanted} is in no frame so far, but {_numbers(ids)} of the dictionary {name}; "
            f"expected --dictionary {name}"
        )
    return None


def _numbers(ids: Sequence[int]) -> str:
    return f"marker{'s' if len(ids) > 1 else ''} {', '.join(map(str, ids))}"


def markers_in(
    grey: UInt8[np.ndarray, "row column"], region: Region | None = None
) -> list[tuple[str, list[int]]]:
    """Dictionaries that know markers in a picture, most markers first, of those the smallest."""
    found = {
        name: {s.id for s in MarkerDetector(name).find(grey, region)} for name in dictionary_names()
    }
    names = sorted((n for n in found if found[n]), key=lambda n: (-len(found[n]), len(n), n))
    return [(name, sorted(found[name])) for name in names]


def only_marker(source: Source, detector: MarkerDetector, region: Region | None = None) -> int:
    """Number of the one marker that a video, or a part of its picture, shows in its first frames.

    Raises:
        DataError: it shows none, or several.
    """
    counts: Counter[int] = Counter()
    last: UInt8[np.ndarray, "row column"] | None = None
    with closing(ahead(source.frames())) as frames:
        for frame in frames:
            last = frame.grey
            counts.update({s.id for s in detector.find(frame.grey, region)})
            if frame.index >= LOOKED or sum(counts.values()) >= LOOKED // 4:
                break
    often = sorted(number for number, n in counts.items() if 5 * n >= max(counts.values()))
    if len(often) == 1:
        return often[0]
    if often:
        raise DataError(
            f"{source.name}: {_numbers(often)} in view; expected --id for the robot's, or a file "
            "of targets"
        )
    if last is not None:
        for name, ids in markers_in(last, region):
            raise DataError(
                f"{source.name}: no marker of this dictionary, but {_numbers(ids)} of {name}; "
                f"expected --dictionary {name}"
            )
    raise DataError(
        f"{source.name}: no marker of any dictionary in the first frames; expected one in view, "
        "sharp, flat, with a white margin around, or --id where it comes later"
    )
