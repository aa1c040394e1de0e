"""Frames from the file, folder or device that a user gives, and still images from videos."""

import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import count as numbers
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.camera.frame import Frame, FrameSource, even_times, grey_of, read_times, stamp
from slipid.camera.opencv import cv2, is_picture, pictures_in, read_picture, size_of
from slipid.support.errors import DataError

MOST_BROKEN = 25
"""Number of consecutive frames that cannot be decoded after which a video counts as ended."""
MEDIAN_FRAMES = 25
"""Approximate number of frames of a video whose pixelwise median gives a still image; at most
twice as many are used."""
Times = Float[np.ndarray, " frame"]
"""Times of frames [s]."""


class Capture:
    """OpenCV's reader of a file or a device.

    Raises:
        DataError: the file or device cannot be opened.
    """

    def __init__(self, place: str):
        self._capture = cv2.VideoCapture(int(place) if place.isdigit() else place)
        if not self._capture.isOpened():
            raise DataError(
                f"{place}: OpenCV cannot open this source; expected a video in a format that "
                "OpenCV reads, or a camera that is plugged in (a recording that was cut off may "
                "have lost its index)"
            )

    def next_picture(self, decode: bool = True) -> np.ndarray | None:
        """Return the next frame, or None at the end.

        Without `decode` the frame is skipped, and an empty array is returned.
        """
        for _ in range(MOST_BROKEN):
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


@dataclass(frozen=True, eq=False)
class Video(FrameSource):
    """A video file, with the frame times in the file or with times given by the user.

    Attributes:
        times: given time of each frame [s]; None to use `fps` or the times in the file.
        fps: given frame rate from which times are computed [1/s]; None if no rate is given.
    """

    times: Times | None
    fps: float | None

    @classmethod
    def at(cls, path: Path, fps: float | None, times: Times | None) -> "Video":
        """Return the video in a file.

        Raises:
            DataError: OpenCV cannot open the file or cannot decode its first frame.
        """
        if fps is not None:
            even_times(1, fps)
        with closing(Capture(str(path))) as capture:
            first = capture.next_picture()
            if first is None:
                raise DataError(
                    f"{path}: no frame that OpenCV can decode; expected a video (a file that was "
                    "cut off, as by a full disk, may have lost its index)"
                )
            announced = capture.value(cv2.CAP_PROP_FRAME_COUNT)
        count = int(announced) if 0 < announced < 1e9 else None
        if times is not None:
            count = len(times)
        identity = repr((stamp(path), fps, None if times is None else times.tolist()))
        return cls(str(path), size_of(first), count, times is not None, identity, times, fps)

    def frames(self, first: int = 0) -> Iterator[Frame]:
        """Yield the frames, beginning with number `first`; earlier frames are not decoded.

        Raises:
            DataError: times in the file do not increase, or fewer times than frames were given.
        """
        before = -np.inf
        with closing(Capture(self.name)) as capture:
            for k in numbers():
                picture = capture.next_picture(decode=k >= first)
                if picture is None:
                    return
                at = self._time(k, capture)
                if at <= before and k >= first:
                    raise DataError(
                        f"{self.name}: frame {k} has time {at:.4f} s after {before:.4f} s; the "
                        "video's times do not increase: expected --fps, or --times FILE"
                    )
                before = at
                if k >= first:
                    yield Frame(k, at, grey_of(picture))

    def _time(self, k: int, capture: Capture) -> float:
        """Return the time of frame number `k`, which was read last [s]."""
        if self.fps is not None:
            return k / self.fps
        if self.times is None:
            return capture.value(cv2.CAP_PROP_POS_MSEC) / 1000.0
        if k >= len(self.times):
            raise DataError(
                f"{self.name}: more frames than the {len(self.times)} given times; expected one "
                "time for each frame"
            )
        return float(self.times[k])


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
            picture = read_picture(self.paths[k])
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
    if place.isdigit() or place.startswith("/dev/video"):
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
        size = path.stat().st_size
    except (OSError, ValueError):
        expected = "a video or a folder of images"
        raise DataError(f"{path}: no such file or folder; expected {expected}") from None
    given = None if times is None else read_times(times)
    if path.is_dir():
        return PictureFolder.at(path, fps, given)
    if not size:
        raise DataError(f"{path}: the file is empty; expected a video")
    if is_picture(path):
        given = even_times(1, fps or 1.0) if given is None else given
        return PictureFolder.of(path, (path,), given)
    return Video.at(path, fps, given)


def still(path: Path) -> np.ndarray:
    """Return an image, or the pixelwise median of a video's frames, in blue, green, red.

    An object that moves through a video appears in the median only if it stays at one spot for at
    least half of the time.

    Raises:
        DataError: the file is neither an image nor a video.
    """
    if is_picture(path) or not path.is_file() or not path.stat().st_size:
        return read_picture(path)
    with closing(Capture(str(path))) as capture:
        count = int(capture.value(cv2.CAP_PROP_FRAME_COUNT))
        every, kept = max(1, count // MEDIAN_FRAMES), []
        for k in numbers():
            chosen = k % every == 0
            picture = capture.next_picture(decode=chosen)
            if picture is None:
                break
            kept += [picture] if chosen else []
            if len(kept) == 2 * MEDIAN_FRAMES:
                # the video is longer than announced: thin the frames to limit memory
                kept, every = kept[::2], 2 * every
    if not kept:
        raise DataError(f"{path}: no frame that OpenCV can decode; expected an image or a video")
    return np.median(np.stack(kept), axis=0).astype(np.uint8)
