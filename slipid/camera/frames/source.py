"""A folder of pictures as frames.

What a user names as the source of frames: a file, a folder or a device.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.camera.frames.frame import Frame, Source, even_times, grey_of, read_times, stamp
from slipid.camera.frames.video import Device, Video
from slipid.camera.opencv import read_picture
from slipid.support.errors import DataError

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


@dataclass(frozen=True, eq=False)
class PictureFolder:
    """Pictures in the order of their names, all of one size."""

    paths: tuple[Path, ...]
    times: Float[np.ndarray, " frame"]
    image_px: tuple[int, int]
    exact: bool = True

    @classmethod
    def at(
        cls, folder: Path, fps: float | None, times: Float[np.ndarray, " frame"] | None
    ) -> "PictureFolder":
        """Every picture in a folder, which have the size of the first.

        Raises:
            DataError: there is none, or no time for each.
        """
        found = sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES)
        if not found:
            raise DataError(f"{folder}: no picture; expected {', '.join(PICTURES)}")
        if times is None:
            if fps is None:
                raise DataError(f"{folder}: pictures have no times; expected --fps or --times FILE")
            times = even_times(len(found), fps)
        if len(times) != len(found):
            raise DataError(
                f"{folder}: {len(found)} pictures and {len(times)} times; expected one each"
            )
        return cls.of(found, times)

    @classmethod
    def of(cls, paths: Sequence[Path], times: Float[np.ndarray, " frame"]) -> "PictureFolder":
        """Some pictures; DataError where the first is none."""
        rows, columns = read_picture(paths[0]).shape[:2]
        return cls(tuple(paths), times, (columns, rows))

    @property
    def name(self) -> str:
        """The folder, or the picture where there is one alone."""
        return str(self.paths[0] if len(self.paths) == 1 else self.paths[0].parent)

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.paths)

    @property
    def identity(self) -> str:
        """Names, sizes and dates."""
        return repr([stamp(path) for path in self.paths])

    def frames(self, first: int = 0) -> Iterator[Frame]:
        """Pictures from a number on."""
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
) -> Source:
    """Frames of a video file, a folder of pictures or a device.

    Args:
        place: a file, a folder, or a device: its number, or its path such as /dev/video0.
        fps: frames per second where times are not to be taken from the source.
        times: CSV file with the columns frame and time [s], instead.
        seconds: how long to watch a device, which has no end.

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
        what = "a video or a folder of pictures"
        raise DataError(f"{path}: no such file or folder; expected {what}") from None
    known = None if times is None else read_times(times)
    if path.is_dir():
        return PictureFolder.at(path, fps, known)
    if not size:
        raise DataError(f"{path}: the file is empty; expected a video")
    if path.suffix.lower() in PICTURES:
        return PictureFolder.of((path,), even_times(1, fps or 1.0) if known is None else known)
    return Video.at(path, fps, known)
