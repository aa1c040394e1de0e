"""What a user names as the source of frames: a file, a folder or a device."""

from pathlib import Path

from slipid.support.errors import DataError
from slipid.vision.tracking.frames.frame import Source
from slipid.vision.tracking.frames.pictures import PICTURES, PictureFolder
from slipid.vision.tracking.frames.times import even_times, read_times
from slipid.vision.tracking.frames.video import Device, Video


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
