"""Frames from the file, folder or device that a user gives."""

import stat
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import count as numbers
from pathlib import Path

import numpy as np

from slipid.camera.frame import Frame, FrameSource, Times, even_times, grey_of, read_times, stamp
from slipid.camera.opencv import cv2, size_of
from slipid.camera.picture_file import is_picture, pictures_in, read_picture
from slipid.camera.video import Video
from slipid.support.errors import DataError, shown
from slipid.support.files import PIPE

LONGEST_NUMBER = 4
"""Largest number of digits in the number of a camera device."""
MOST_BROKEN = 25
"""Number of consecutive frames that a device may fail to supply before it counts as stopped."""


class Capture:
    """OpenCV's reader of a camera device.

    Raises:
        DataError: the device cannot be opened.
    """

    def __init__(self, place: str):
        self._capture = cv2.VideoCapture(int(place) if place.isdecimal() else place)
        if not self._capture.isOpened():
            raise DataError(
                f"device {place}: OpenCV cannot open it; expected a camera that is plugged in"
            )

    def next_picture(self) -> np.ndarray | None:
        """Return the next frame, or None at the end."""
        for _ in range(MOST_BROKEN):
            decoded, picture = self._capture.read()
            if decoded and picture is not None and picture.size:
                return np.asarray(picture)
        return None

    def close(self) -> None:
        """Release the device."""
        self._capture.release()


@dataclass(frozen=True, eq=False)
class Device(FrameSource):
    """A camera connected to this computer, whose clock gives the frame times from the first frame.

    Every recording has its own `identity`, since its frames cannot be read again.

    Attributes:
        place: number or path of the device.
        seconds: duration of the recording [s].
    """

    place: str
    seconds: float

    @classmethod
    def at(cls, place: str, seconds: float) -> "Device":
        """Return a camera; raise `DataError` if it supplies no frame."""
        name = f"device {place}"
        with closing(Capture(place)) as capture:
            first = capture.next_picture()
        if first is None:
            raise DataError(f"{name}: no frame; expected a camera that no other program uses")
        return cls(name, size_of(first), None, False, f"{place} {time.time_ns()}", place, seconds)

    def frames(self, first: int = 0) -> Iterator[Frame]:
        """Yield frames from now until `seconds` have passed; `first` has no effect on a device."""
        began: float | None = None
        with closing(Capture(self.place)) as capture:
            for k in numbers():
                picture = capture.next_picture()
                now = time.monotonic()
                began = now if began is None else began
                if picture is None or now - began > self.seconds:
                    return
                yield Frame(k, now - began, grey_of(picture))


@dataclass(frozen=True, eq=False)
class PictureFolder(FrameSource):
    """Images in the order of their file names, all of one size.

    Attributes:
        paths: files of the images.
        times: time of each image [s].
    """

    paths: tuple[Path, ...]
    times: Times

    @classmethod
    def at(cls, folder: Path, fps: float | None, times: Times | None) -> "PictureFolder":
        """Return the images in a folder, with a frame rate [1/s] or given times [s].

        Raises:
            DataError: there is no image, or the numbers of images and times differ.
        """
        paths = pictures_in(folder)
        if times is None:
            if fps is None:
                raise DataError(f"{folder}: images have no times; expected --fps or --times FILE")
            times = even_times(len(paths), fps)
        if len(times) != len(paths):
            raise DataError(
                f"{folder}: {len(paths)} images and {len(times)} times; expected one time for each "
                "image"
            )
        return cls.of(folder, paths, times)

    @classmethod
    def of(cls, place: Path, paths: Sequence[Path], times: Times) -> "PictureFolder":
        """Return a source of images that all have the size of the first image.

        Raises:
            DataError: the first file is not an image.
        """
        size, identity = size_of(read_picture(paths[0])), repr([stamp(path) for path in paths])
        return cls(str(place), size, len(paths), True, identity, tuple(paths), times)

    def frames(self, first: int = 0) -> Iterator[Frame]:
        """Yield the images from number `first`; raise `DataError` if an image has another size."""
        for k in range(first, len(self.paths)):
            picture = read_picture(self.paths[k], self.notes)
            if size_of(picture) != self.image_px:
                (w, h), (width, height) = size_of(picture), self.image_px
                raise DataError(
                    f"{self.paths[k]}: {w} x {h} pixels; expected {width} x {height}, the size of "
                    f"{self.paths[0].name}"
                )
            yield Frame(k, float(self.times[k]), grey_of(picture))


def open_source(
    place: str, fps: float | None = None, times: Path | None = None, seconds: float | None = None
) -> FrameSource:
    """Return the frames of a video file, a folder of images or a device.

    Args:
        place: a file, a folder, or a device given by its number or its path such as /dev/video0.
        fps: frame rate from which times are computed [1/s]; None to use those of the source.
        times: CSV file with the columns frame and time [s], used instead of the source's times.
        seconds: duration of the recording from a device [s]; None for other sources.

    Raises:
        DataError: the source cannot be read, has no times, or an option does not apply to it.
    """
    if fps is not None and times is not None:
        raise DataError("both --fps and --times are given; expected one of them")
    path = Path(place)
    if place.isdecimal() and len(place) > LONGEST_NUMBER:
        raise DataError(f"device {shown(place)}: no such number; expected that of a camera, as 0")
    if place.isdecimal() or place.startswith("/dev/video"):
        if seconds is None or not 0 < seconds < float("inf"):
            raise DataError(
                f"device {place}: no duration; expected --seconds with the recording's duration, "
                "a positive number"
            )
        if fps is not None or times is not None:
            raise DataError(
                f"device {place}: --fps or --times is given, but this computer's clock times a "
                "device; omit both"
            )
        return Device.at(place, seconds)
    if seconds is not None:
        raise DataError(
            f"--seconds is for devices, not for {place}; a video or folder is read to its end: "
            "omit --seconds"
        )
    try:
        kept = path.stat()
    except (OSError, ValueError):
        expected = "a video or a folder of images"
        raise DataError(f"{path}: no such file or folder; expected {expected}") from None
    given = None if times is None else read_times(times)
    if path.is_dir():
        return PictureFolder.at(path, fps, given)
    if not stat.S_ISREG(kept.st_mode):
        raise DataError(f"{path}: {PIPE}; expected a video or a folder of images")
    if not kept.st_size:
        raise DataError(f"{path}: the file is empty; expected a video")
    if is_picture(path):
        given = even_times(1, fps or 1.0) if given is None else given
        return PictureFolder.of(path, (path,), given)
    return Video.at(path, fps, given)
