"""A video file, or a camera plugged into this computer, as frames."""

import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import count as numbers
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.camera.frames.frame import Frame, even_times, grey_of, stamp
from slipid.camera.opencv import opencv
from slipid.support.errors import DataError

BROKEN = 25
"""Frames in a row that cannot be decoded, after which a video counts as ended."""


@dataclass(frozen=True, eq=False)
class Video:
    """A video file, with its own times or with given ones.

    Attributes:
        path: the file.
        image_px: width and height of a frame.
        count: announced number of frames, or that of the times; None where it is not known.
        times: given time of each frame [s]; None takes the file's own.
        fps: given frame rate [1/s], instead of times.
    """

    path: Path
    image_px: tuple[int, int]
    count: int | None
    times: Float[np.ndarray, " frame"] | None = None
    fps: float | None = None

    @classmethod
    def at(
        cls, path: Path, fps: float | None, times: Float[np.ndarray, " frame"] | None
    ) -> "Video":
        """Return a video; DataError where OpenCV cannot open it or decode its first frame."""
        if fps is not None:
            even_times(1, fps)
        with closing(Capture(str(path))) as capture:
            first = capture.next_picture()
            if first is None:
                raise DataError(
                    f"{path}: no frame that OpenCV can decode; expected a video (a file that was "
                    "cut off, as by a full disk, may have lost its index)"
                )
            announced = capture.value(opencv().CAP_PROP_FRAME_COUNT)
        count = int(announced) if 0 < announced < 1e9 else None
        if times is not None:
            count = len(times)
        return cls(path, (first.shape[1], first.shape[0]), count, times, fps)

    @property
    def name(self) -> str:
        """The file."""
        return str(self.path)

    @property
    def exact(self) -> bool:
        """Whether every frame has a given time."""
        return self.times is not None

    @property
    def identity(self) -> str:
        """Name, size and date of the file, and its given times or rate."""
        return repr(
            (stamp(self.path), self.fps, None if self.times is None else self.times.tolist())
        )

    def frames(self, first: int = 0) -> Iterator[Frame]:
        """Yield the frames from a number on; those before are skipped without decoding.

        Raises:
            DataError: the file has no times, they do not increase, or too few were given.
        """
        before = -np.inf
        with closing(Capture(str(self.path))) as capture:
            for k in numbers():
                picture = capture.next_picture(decode=k >= first)
                if picture is None:
                    return
                at = self._time(k, capture)
                if at <= before and k >= first:
                    raise DataError(
                        f"{self.path}: frame {k} has time {at:.4f} s after {before:.4f} s; it "
                        "has no times that increase: expected --fps, or --times FILE"
                    )
                before = at
                if k >= first:
                    yield Frame(k, at, grey_of(picture))

    def _time(self, k: int, capture: "Capture") -> float:
        if self.fps is not None:
            return k / self.fps
        if self.times is None:
            return capture.value(opencv().CAP_PROP_POS_MSEC) / 1000.0
        if k >= len(self.times):
            raise DataError(
                f"{self.path}: more than the {len(self.times)} frames that have a time; expected "
                "a time for each"
            )
        return float(self.times[k])


@dataclass(frozen=True)
class Device:
    """A camera plugged into this computer; times are of its clock, from the first frame on.

    Attributes:
        place: number or path of the device.
        seconds: duration of the recording [s].
        image_px: width and height of a frame.
        count: None, since the number of frames is not known.
        exact: False, likewise.
    """

    place: str
    seconds: float
    image_px: tuple[int, int]
    count: None = None
    exact: bool = False

    @classmethod
    def at(cls, place: str, seconds: float) -> "Device":
        """Return a camera; DataError where it supplies no frame."""
        with closing(Capture(place)) as capture:
            first = capture.next_picture()
        if first is None:
            raise DataError(
                f"device {place}: it shows nothing; expected a camera that is not in use"
            )
        return cls(place, seconds, (first.shape[1], first.shape[0]))

    @property
    def name(self) -> str:
        """The device as the user named it."""
        return f"device {self.place}"

    @property
    def identity(self) -> str:
        """A text that is never the same twice, since the frames of a device do not come back."""
        return f"{self.place} {time.time_ns()}"

    def frames(self, first: int = 0) -> Iterator[Frame]:
        """Yield the frames from now on, until the recording is over."""
        began: float | None = None
        with closing(Capture(self.place)) as capture:
            for k in numbers():
                picture = capture.next_picture()
                now = time.monotonic()
                began = now if began is None else began
                if picture is None or now - began > self.seconds:
                    return
                yield Frame(k, now - began, grey_of(picture))


class Capture:
    """OpenCV's reader of a file or a device.

    Raises:
        DataError: it cannot be opened.
    """

    def __init__(self, place: str):
        cv2 = opencv()
        self._capture = cv2.VideoCapture(int(place) if place.isdigit() else place)
        if not self._capture.isOpened():
            raise DataError(
                f"{place}: OpenCV cannot open it; expected a video in a format it knows, or a "
                "camera that is plugged in (a recording that was cut off may have lost its index)"
            )

    def next_picture(self, decode: bool = True) -> np.ndarray | None:
        """Return the next frame, or an empty one where it is not decoded; None at the end."""
        for _ in range(BROKEN):
            if not self._capture.grab():
                continue
            if not decode:
                return np.zeros((0, 0, 3), np.uint8)
            decoded, picture = self._capture.retrieve()
            if decoded and picture is not None and picture.size:
                return np.asarray(picture)
        return None

    def value(self, property_id: int) -> float:
        """Return one of OpenCV's properties of the file or device."""
        return float(self._capture.get(property_id))

    def close(self) -> None:
        """Release the file or device."""
        self._capture.release()
