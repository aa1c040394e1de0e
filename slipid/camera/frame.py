"""Video frames with their pixels and times, and the interface of sources that supply them."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.camera.csv_rows import csv_rows
from slipid.camera.opencv import Grey, cv2
from slipid.support.errors import DataError, bad_data
from slipid.support.quantities import FrameRate, limits_of

LOST_SHARE = 0.02
"""Largest fraction of a file's announced frames that may be missing without a message [1]; some
file formats only estimate how many frames they contain."""
UNEVEN_RATE = 0.2
"""Largest relative difference of an interval between frames from the median interval for which the
frame rate still counts as even [1]."""
READ_AHEAD = 8
"""Number of frames that are decoded in advance."""
LARGEST_TIME = 1e10
"""Largest size of a frame's time [s]; seconds since 1970 are below 2e9."""
Times = Float[np.ndarray, " frame"]
"""Times of frames [s]."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a frame source, such as a video.

    Attributes:
        index: number of the frame, from 0.
        time: time at which the frame was taken [s].
        grey: grey levels of the frame's pixels, from 0 to 255.
    """

    index: int
    time: float
    grey: Grey


@dataclass(frozen=True, eq=False)
class FrameSource(ABC):
    """A video, a folder of images or a device that supplies frames.

    Attributes:
        name: name of the source in messages.
        image_px: width and height of every frame [pixel].
        count: expected number of frames; None if it is not known.
        exact: True if `count` must be met exactly, because a time is given for each frame.
        identity: text that changes when the frames change, such as name, size and date of a file.
        notes: sentences for the user about the source, such as an orientation flag; they are
            complete once all frames have been read.
        faults: sentences about damage that ended the frames too early; complete as `notes`.
    """

    name: str
    image_px: tuple[int, int]
    count: int | None
    exact: bool
    identity: str
    notes: list[str] = field(default_factory=list, kw_only=True)
    faults: list[str] = field(default_factory=list, kw_only=True)

    @abstractmethod
    def frames(self, first: int = 0) -> Iterator[Frame]:
        """Yield the frames in order, beginning with number `first`."""


def cut_off(source: FrameSource, count: int) -> str | None:
    """Return a sentence for the user if a source gave a wrong number of frames, else None.

    Up to `LOST_SHARE` of an estimated number of frames may be missing. The result is also None if
    the source has reported its damage itself.
    """
    if source.count is None or count == source.count or source.faults:
        return None
    if source.exact:
        return (
            f"{source.name}: {count} frames, but {source.count} times; expected one time for each "
            "frame"
        )
    if count >= (1 - LOST_SHARE) * source.count - 1:
        return None
    return (
        f"{source.name}: the frames end after {count} of {source.count}; the file was cut off or "
        "is damaged there"
    )


def stamp(path: Path) -> tuple[str, int, int]:
    """Return name, size and date of a file, which show whether its content has changed."""
    status = path.stat()
    return path.name, status.st_size, status.st_mtime_ns


def grey_of(picture: np.ndarray) -> Grey:
    """Return the grey levels of an image whose channels are blue, green, red or already grey."""
    if picture.ndim == 2 or picture.shape[2] == 1:
        return np.asarray(picture).reshape(picture.shape[:2])
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))


def read_times(path: Path) -> Times:
    """Return the times [s] of frames 0, 1, 2, ... from a CSV file with columns frame and time.

    Raises:
        DataError: the file is unreadable, its first columns are not frame and time, frames are
            missing, or times do not increase.
    """
    rows = csv_rows(path, "times of frames, in the columns frame, time [s]")
    if not rows or rows[0][1][:2] != ["frame", "time"]:
        raise bad_data(
            path, "first columns other than frame and time", "the columns frame, time [s]", row=1
        )
    times: list[float] = []
    for line, row in rows[1:]:
        try:
            number, at = int(row[0]), float(row[1])
        except (ValueError, IndexError):
            raise bad_data(
                path, f"{','.join(row)!r}", "a frame number and its time in seconds", row=line
            ) from None
        if number != len(times):
            raise bad_data(path, f"frame {number}", f"frame {len(times)}", row=line)
        if not abs(at) <= LARGEST_TIME or (times and at <= times[-1]):
            expected = f"finite times that increase, of size {LARGEST_TIME:g} s at most"
            raise bad_data(path, f"time {at:g}", expected, row=line)
        times.append(at)
    return np.array(times)


def even_times(count: int, fps: float) -> Times:
    """Return the times [s] of frames at a constant rate `fps` [1/s], beginning at 0.

    Raises:
        DataError: the rate is not a positive number, or far from that of any camera.
    """
    if not limits_of(FrameRate).holds(fps):
        raise DataError(f"--fps {fps:g}; expected a number {limits_of(FrameRate)}")
    return np.arange(count) / fps


def uneven(times: Sequence[float] | Times) -> str | None:
    """Return a sentence for the user if frame times [s] are not evenly spaced; None otherwise."""
    steps = np.diff(np.asarray(times, float))
    if len(steps) < 2:
        return None
    usual, least, most = np.median(steps), steps.min(), steps.max()
    if most <= (1 + UNEVEN_RATE) * usual and least >= (1 - UNEVEN_RATE) * usual:
        return None
    return (
        f"frames come every {1e3 * least:.0f} to {1e3 * most:.0f} ms, mostly {1e3 * usual:.0f}: "
        "the frame rate varies, so each pose has the time of its own frame"
    )


def read_ahead(frames: Iterator[Frame]) -> Generator[Frame]:
    """Yield the given frames unchanged, decoded in advance in a thread.

    Errors of the thread are raised here. Decoding ends with the last frame, or when this generator
    is closed.
    """
    with ThreadPoolExecutor(1) as thread:
        decoded = deque(thread.submit(next, frames, None) for _ in range(READ_AHEAD))
        try:
            while (frame := decoded.popleft().result()) is not None:
                decoded.append(thread.submit(next, frames, None))
                yield frame
        finally:
            for waiting in decoded:
                waiting.cancel()
