"""Frames from the file, folder or device that a user names, and one still picture of a floor."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import count as numbers
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.camera.frames.frame import Frame, FrameSource, even_times, grey_of, read_times, stamp
from slipid.camera.frames.video import Capture, Device, Video
from slipid.camera.opencv import opencv, read_picture
from slipid.support.errors import DataError

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
MEDIAN_FRAMES = 25
"""Number of frames of a video from which a still picture is made."""


@dataclass(frozen=True, eq=False)
class PictureFolder:
    """Pictures in the order of their names, all of one size.

    Attributes:
        paths: files of the pictures.
        times: time of each [s].
        image_px: width and height of each.
        exact: True, since there is one frame for each time.
    """

    paths: tuple[Path, ...]
    times: Float[np.ndarray, " frame"]
    image_px: tuple[int, int]
    exact: bool = True

    @classmethod
    def at(
        cls, folder: Path, fps: float | None, times: Float[np.ndarray, " frame"] | None
    ) -> "PictureFolder":
        """Return every picture in a folder, at a rate or at given times.

        Raises:
            DataError: there is no picture, or not one time for each.
        """
        paths = sorted(p for p in folder.iterdir() if is_picture(p))
        if not paths:
            raise DataError(f"{folder}: no picture; expected {', '.join(PICTURES)}")
        if times is None:
            if fps is None:
                raise DataError(f"{folder}: pictures have no times; expected --fps or --times FILE")
            times = even_times(len(paths), fps)
        if len(times) != len(paths):
            raise DataError(
                f"{folder}: {len(paths)} pictures and {len(times)} times; expected one each"
            )
        return cls.of(paths, times)

    @classmethod
    def of(cls, paths: Sequence[Path], times: Float[np.ndarray, " frame"]) -> "PictureFolder":
        """Return pictures of the first one's size; DataError where the first is no picture."""
        rows, columns = read_picture(paths[0]).shape[:2]
        return cls(tuple(paths), times, (columns, rows))

    @property
    def name(self) -> str:
        """The folder, or the picture where there is only one."""
        return str(self.paths[0] if len(self.paths) == 1 else self.paths[0].parent)

    @property
    def count(self) -> int:
        """Number of pictures."""
        return len(self.paths)

    @property
    def identity(self) -> str:
        """Names, sizes and dates of the pictures."""
        return repr([stamp(path) for path in self.paths])

    def frames(self, first: int = 0) -> Iterator[Frame]:
        """Yield the pictures from a number on; DataError where one has another size."""
        for k in range(first, len(self.paths)):
            picture = read_picture(self.paths[k])
            if (picture.shape[1], picture.shape[0]) != self.image_px:
                raise DataError(
                    f"{self.paths[k]}: {picture.shape[1]} x {picture.shape[0]} pixels; expected "
                    f"{self.image_px[0]} x {self.image_px[1]} as {self.paths[0].name}"
                )
            yield Frame(k, float(self.times[k]), grey_of(picture))


def open_source(
    place: str,
    fps: float | None = None,
    times: Path | None = None,
    seconds: float | None = None,
) -> FrameSource:
    """Return the frames of a video file, a folder of pictures or a device.

    Args:
        place: a file, a folder, or a device: its number, or its path such as /dev/video0.
        fps: frames per second where times are not to be taken from the source.
        times: CSV file with the columns frame and time [s], instead.
        seconds: how long to record from a device, which has no end.

    Raises:
        DataError: nothing there that can be read, or no times.
    """
    if fps is not None and times is not None:
        raise DataError("--fps and --times at once; expected one of them")
    path = Path(place)
    if place.isdigit() or place.startswith("/dev/video"):
        if seconds is None or not 0 < seconds < float("inf"):
            raise DataError(f"device {place}: it has no end; expected --seconds")
        if fps is not None or times is not None:
            raise DataError(f"device {place}: its times are this computer's; no --fps, no --times")
        return Device.at(place, seconds)
    if seconds is not None:
        raise DataError(f"--seconds is for devices, not for {place}; a video is read to its end")
    try:
        size = path.stat().st_size
    except (OSError, ValueError):
        expected = "a video or a folder of pictures"
        raise DataError(f"{path}: no such file or folder; expected {expected}") from None
    given = None if times is None else read_times(times)
    if path.is_dir():
        return PictureFolder.at(path, fps, given)
    if not size:
        raise DataError(f"{path}: the file is empty; expected a video")
    if is_picture(path):
        return PictureFolder.of((path,), even_times(1, fps or 1.0) if given is None else given)
    return Video.at(path, fps, given)


def is_picture(path: Path) -> bool:
    """Return whether a file is a picture, by the end of its name."""
    return path.suffix.lower() in PICTURES


def still(path: Path) -> np.ndarray:
    """Return a picture, or the median of a video's frames, as rows, columns and blue, green, red.

    An object that moves through a video is not in the median, unless it stands in one place half of
    the time.

    Raises:
        DataError: the file is neither a picture nor a video.
    """
    if is_picture(path) or not path.is_file() or not path.stat().st_size:
        return read_picture(path)
    with closing(Capture(str(path))) as capture:
        count = int(capture.value(opencv().CAP_PROP_FRAME_COUNT))
        every, kept = max(1, count // MEDIAN_FRAMES), []
        for k in numbers():
            chosen = k % every == 0
            picture = capture.next_picture(decode=chosen)
            if picture is None:
                break
            kept += [picture] if chosen else []
            if len(kept) == 2 * MEDIAN_FRAMES:  # of a video that does not know its length
                kept, every = kept[::2], 2 * every
    if not kept:
        raise DataError(f"{path}: no frame that OpenCV can decode; expected a picture or a video")
    return np.median(np.stack(kept), axis=0).astype(np.uint8)
