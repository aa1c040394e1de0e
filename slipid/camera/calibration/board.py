"""Which pictures a user named: files, folders and globs.

A printed ChArUco board, and its corners in pictures.
"""

import glob
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from slipid.camera.opencv import marker_dictionary, opencv, read_picture
from slipid.support.errors import DataError

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


LARGEST_M = 1.0
"""Of a square; where it is more, millimetres were meant."""
LEAST_CORNERS = 6
"""Of a view: the board's place has six numbers, and each corner tells two."""


@dataclass(frozen=True)
class Board:
    """A chessboard with markers in its white squares, printed flat.

    Its own axes start at the upper left corner of its first square: x right, y down.

    Attributes:
        columns, rows: squares along x and along y.
        square_m, marker_m: edges of a square and of a marker [m].
        dictionary: of its markers, such as `4X4_50`.
        legacy: whether it was made by OpenCV before 4.6, which began boards of an even number of
            rows with a white square.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str = "4X4_50"
    legacy: bool = False

    def __post_init__(self) -> None:
        marker_dictionary(self.dictionary)
        if not (self.columns >= 3 and self.rows >= 3):
            raise DataError(f"a board of {self.size} squares; expected 3x3 or more, such as 7x5")
        if not 0 < self.marker_m < self.square_m <= LARGEST_M:
            raise DataError(
                f"squares of {self.square_m:g} m and markers of {self.marker_m:g} m; expected "
                f"markers smaller than squares, both in metres and of {LARGEST_M:g} m at most"
            )
        there, needed = marker_count(self.dictionary), self.columns * self.rows // 2
        if needed > there:
            raise DataError(
                f"a board of {self.size} squares has {needed} markers, but dictionary "
                f"{self.dictionary} has {there}; expected a larger one, such as 4X4_250"
            )

    @property
    def size(self) -> str:
        """Columns and rows as a user writes them."""
        return f"{self.columns}x{self.rows}"

    def __str__(self) -> str:
        old = ", legacy pattern" if self.legacy else ""
        return (
            f"{self.size} squares of {self.square_m:g} m, markers of {self.marker_m:g} m from "
            f"{self.dictionary}{old}"
        )

    @cached_property
    def pattern(self) -> object:
        """OpenCV's board."""
        size = (self.columns, self.rows)
        words = marker_dictionary(self.dictionary)
        made = opencv().aruco.CharucoBoard(size, self.square_m, self.marker_m, words)
        if self.legacy:
            made.setLegacyPattern(True)
        return made

    @cached_property
    def corners_m(self) -> Float[np.ndarray, "corner 2"]:
        """Inner corners in the board's axes [m], row by row."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        return self.square_m * np.stack([x.ravel(), y.ravel()], 1)

    def on_floor(
        self, board_m: Float[np.ndarray, "corner 2"], height_m: float
    ) -> Float[np.ndarray, "corner 3"]:
        """Places of its corners in a world whose origin is on the floor below its middle.

        x runs along its columns, to the right, y up its rows, z up from the floor.

        Args:
            height_m: of its printed face above the floor.
        """
        middle = 0.5 * self.square_m * np.array([self.columns, self.rows])
        x, y = ((board_m - middle) * [1, -1]).T
        return np.stack([x, y, np.full(len(x), height_m)], 1)


@dataclass(frozen=True, eq=False)
class View:
    """Corners of a board that one picture shows.

    Attributes:
        name: of the picture.
        pixels: where they are seen.
        board_m: where they are on the board [m].
    """

    name: str
    pixels: Float[np.ndarray, "corner 2"]
    board_m: Float[np.ndarray, "corner 2"]

    def only(self, kept: np.ndarray) -> "View":
        """Some of its corners, by a mask or by numbers."""
        return View(self.name, self.pixels[kept], self.board_m[kept])

    @property
    def flat(self) -> bool:
        """Whether its corners are too few, or all near one line, for the board's place."""
        if len(self.pixels) < LEAST_CORNERS:
            return True
        steps = np.unique(np.round(np.diff(np.unique(self.board_m)), 9))
        spread = np.linalg.svd(self.board_m - self.board_m.mean(0), compute_uv=False)
        return bool(spread[1] < 0.4 * steps[steps > 0].min() * np.sqrt(len(self.pixels)))


def board_of(size: str, square_m: float, marker_m: float, dictionary: str, legacy: bool) -> Board:
    """A board whose size is written as `7x5`: columns and rows of squares.

    Raises:
        DataError: there is no such board.
    """
    columns, by, rows = size.lower().partition("x")
    if not (by and columns.strip().isdecimal() and rows.strip().isdecimal()):
        raise DataError(f"--board {size}; expected squares along x and y, such as 7x5")
    return Board(int(columns), int(rows), square_m, marker_m, dictionary, legacy)


def marker_count(dictionary: str) -> int:
    """How many markers a dictionary has."""
    words: Any = marker_dictionary(dictionary)
    return len(words.bytesList)


def view_of(board: Board, picture: Picture) -> View:
    """Corners of the board in a picture; none where it is not seen."""
    detector = opencv().aruco.CharucoDetector(board.pattern)
    pixels, numbers = detector.detectBoard(picture.image)[:2]
    if numbers is None:
        return View(picture.path.name, np.zeros((0, 2)), np.zeros((0, 2)))
    pixels = np.asarray(pixels, float).reshape(-1, 2)
    return View(picture.path.name, pixels, board.corners_m[np.ravel(numbers)])
