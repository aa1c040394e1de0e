"""Which pictures a user named: files, folders and globs."""

import glob
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slipid.support.errors import DataError
from slipid.vision.opencv import read_picture

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
"""Names of pictures in a folder; a file that is named itself may have any."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture and where it came from."""

    path: Path
    image: np.ndarray

    @property
    def image_px(self) -> tuple[int, int]:
        """Width and height [pixel]."""
        return int(self.image.shape[1]), int(self.image.shape[0])


def read_named(path: Path) -> Picture:
    """A picture of a file.

    Raises:
        DataError: the file is absent, empty or no picture.
    """
    return Picture(path, read_picture(path))


def named_pictures(words: Sequence[str]) -> list[Path]:
    """Files of pictures that words name, each once, in their order.

    Raises:
        DataError: a word names none.
    """
    found: dict[Path, None] = {}
    for word in words:
        path = Path(word)
        if path.is_dir():
            files = sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES)
            if not files:
                raise DataError(
                    f"{word}: a folder without pictures; expected files {', '.join(SUFFIXES)}"
                )
        elif path.exists() or not glob.has_magic(word):
            files = [path]
        else:
            files = sorted(Path(p) for p in glob.glob(word, recursive=True) if Path(p).is_file())
            if not files:
                raise DataError(f"{word}: no file has such a name; expected pictures")
        found.update(dict.fromkeys(files))
    return list(found)


def same_size(first: Picture, other: Picture) -> None:
    """Refuse two pictures that differ in size.

    Raises:
        DataError: they do, and it names both.
    """
    if first.image_px != other.image_px:
        (w, h), (width, height) = first.image_px, other.image_px
        raise DataError(
            f"{other.path}: {width} x {height} pixels, but {first.path} has {w} x {h}; expected "
            "pictures of one camera at one resolution"
        )
