"""One frame, and what every source of frames offers.

Times of frames: given in a file, or even.

Frames decoded ahead, in a thread of their own.
"""

import csv
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from slipid.camera.opencv import opencv
from slipid.support.errors import DataError, bad_data

LOST = 0.02
"""Part of the frames a file may announce and not have: some formats only estimate how many."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture of a video.

    Attributes:
        index: its number, from 0.
        time: when it was taken [s].
        grey: its pixels, from 0 to 255.
    """

    index: int
    time: float
    grey: UInt8[np.ndarray, "row column"]


@runtime_checkable
class Source(Protocol):
    """Where frames come from."""

    @property
    def name(self) -> str:
        """What messages call it."""

    @property
    def image_px(self) -> tuple[int, int]:
        """Width and height of every frame."""

    @property
    def count(self) -> int | None:
        """How many frames there should be; None where nobody knows."""

    @property
    def exact(self) -> bool:
        """Whether there are just so many, as where each has a time of its own."""

    @property
    def identity(self) -> str:
        """What tells it from others: name, size and date."""

    def frames(self, first: int = 0) -> Iterator[Frame]:
        """Frames from a number on, in order."""


def cut_off(source: Source, found: int) -> str | None:
    """A sentence where a source ended before it should have."""
    if source.count is None or found == source.count:
        return None
    if source.exact:
        return f"{source.name}: {found} frames, but {source.count} times; expected a time for each"
    if found >= (1 - LOST) * source.count - 1:
        return None
    return (
        f"{source.name}: ends after frame {found} of {source.count}; the file was cut off or is "
        "damaged there"
    )


def stamp(path: Path) -> tuple[str, int, int]:
    """Name, size and date of a file, which change when it does."""
    status = path.stat()
    return path.name, status.st_size, status.st_mtime_ns


def grey_of(picture: np.ndarray) -> UInt8[np.ndarray, "row column"]:
    """Grey levels of a picture in blue, green and red, or of one that is grey already."""
    cv2 = opencv()
    if picture.ndim == 2 or picture.shape[2] == 1:
        return np.asarray(picture).reshape(picture.shape[:2])
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))


UNEVEN = 0.2
"""Part by which times between frames may differ from their median and still count as even."""


def read_times(path: Path) -> Float[np.ndarray, " frame"]:
    """Times [s] of frames 0, 1, 2, ... from a CSV file with the columns frame and time.

    Raises:
        DataError: unreadable, other columns, frames left out, or times that do not increase.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; expected times of frames") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path}: no CSV text; expected the columns frame, time") from error
    if not rows or [cell.strip() for cell in rows[0][:2]] != ["frame", "time"]:
        raise bad_data(path, "other columns", "the columns frame, time [s]", row=1)
    out: list[float] = []
    for line, row in enumerate(rows[1:], 2):
        try:
            number, at = int(row[0]), float(row[1])
        except (ValueError, IndexError):
            raise bad_data(path, f"{','.join(row)!r}", "a frame and its time", row=line) from None
        if number != len(out):
            raise bad_data(path, f"frame {number}", f"frame {len(out)}", row=line)
        if not np.isfinite(at) or (out and at <= out[-1]):
            raise bad_data(path, f"time {at:g}", "times that increase", row=line)
        out.append(at)
    return np.array(out)


def even_times(count: int, fps: float) -> Float[np.ndarray, " frame"]:
    """Times [s] of frames that come evenly from 0 on; DataError where the rate is none."""
    if not 0 < fps < np.inf:
        raise DataError(f"--fps {fps:g}; expected frames per second")
    return np.arange(count) / fps


def uneven(times: Sequence[float] | Float[np.ndarray, " frame"]) -> str | None:
    """A sentence where frames do not come evenly, for a person to know."""
    steps = np.diff(np.asarray(times, float))
    if len(steps) < 2:
        return None
    usual, least, most = np.median(steps), steps.min(), steps.max()
    if most <= (1 + UNEVEN) * usual and least >= (1 - UNEVEN) * usual:
        return None
    return (
        f"frames come every {1e3 * least:.0f} to {1e3 * most:.0f} ms, mostly {1e3 * usual:.0f}: a "
        "variable frame rate; times are those of the frames themselves"
    )


DEPTH = 8
"""Frames that are decoded ahead."""


def ahead(frames: Iterator[Frame]) -> Generator[Frame]:
    """The same frames, decoded in a thread of their own; its errors are raised where they are used.

    Decoding ends with the frames, or when nobody wants more.
    """
    with ThreadPoolExecutor(1) as thread:
        decoded = deque(thread.submit(next, frames, None) for _ in range(DEPTH))
        try:
            while (frame := decoded.popleft().result()) is not None:
                decoded.append(thread.submit(next, frames, None))
                yield frame
        finally:
            for waiting in decoded:
                waiting.cancel()
