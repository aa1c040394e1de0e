"""One frame, and what every source of frames offers."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from slipid.vision.opencv import opencv

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
