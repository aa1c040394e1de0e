"""A folder of pictures as frames."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.support.errors import DataError
from slipid.vision.opencv import read_picture
from slipid.vision.tracking.frames.frame import Frame, grey_of, stamp
from slipid.vision.tracking.frames.times import even_times

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
