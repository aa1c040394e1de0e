"""A printed ChArUco board and its corners in pictures, which a user names as files or globs."""

import glob
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.camera.opencv import marker_count, marker_dictionary, opencv, size_of
from slipid.support.errors import DataError

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
"""Suffixes of pictures in a folder; a file that is named itself may have any."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture, and the file that it was read from."""

    path: Path
    image: np.ndarray

    @property
    def image_px(self) -> tuple[int, int]:
        """Width and height [pixel]."""
        return size_of(self.image)


def named_pictures(words: Sequence[str]) -> list[Path]:
    """Return the picture files named by words, each once, in their order.

    Args:
        words: files, folders and glob patterns.

    Raises:
        DataError: a word names no picture.
    """
    named: dict[Path, None] = {}
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
        named.update(dict.fromkeys(files))
    return list(named)


LARGEST_M = 1.0
"""Largest edge of a square [m]; a larger number was probably meant in millimetres."""
LEAST_CORNERS = 6
"""Smallest number of corners in a view: a pose has six numbers, and each corner gives two."""


@dataclass(frozen=True)
class Board:
    """A chessboard with markers in its white squares, printed flat.

    Its own axes start at the upper left corner of its first square: x right, y down.

    Attributes:
        columns, rows: number of squares along x and along y.
        square_m, marker_m: edges of a square and of a marker [m].
        dictionary: dictionary of its markers, such as `4X4_50`.
        legacy: whether it was drawn by OpenCV before 4.6, which began boards of an even number of
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
        available, needed = marker_count(self.dictionary), self.columns * self.rows // 2
        if needed > available:
            raise DataError(
                f"a board of {self.size} squares has {needed} markers, but dictionary "
                f"{self.dictionary} has {available}; expected a larger one, such as 4X4_250"
            )

    @property
    def size(self) -> str:
        """Columns and rows as a user writes them, such as `7x5`."""
        return f"{self.columns}x{self.rows}"

    def __str__(self) -> str:
        old = ", legacy pattern" if self.legacy else ""
        return (
            f"{self.size} squares of {self.square_m:g} m, markers of {self.marker_m:g} m from "
            f"{self.dictionary}{old}"
        )

    @cached_property
    def pattern(self) -> object:
        """The board as an object of OpenCV."""
        size, dictionary = (self.columns, self.rows), marker_dictionary(self.dictionary)
        board = opencv().aruco.CharucoBoard(size, self.square_m, self.marker_m, dictionary)
        if self.legacy:
            board.setLegacyPattern(True)
        return board

    @cached_property
    def corners_m(self) -> Float[np.ndarray, "corner 2"]:
        """Inner corners in the board's axes [m], row by row."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        return self.square_m * np.stack([x.ravel(), y.ravel()], 1)

    def on_floor(
        self, board_m: Float[np.ndarray, "corner 2"], height_m: float
    ) -> Float[np.ndarray, "corner 3"]:
        """Return places of corners in a world whose origin is the floor below the board's middle.

        x runs along its columns, to the right, y up its rows, z up from the floor.

        Args:
            board_m: corners in the board's own axes [m].
            height_m: height of its printed face above the floor.
        """
        middle = 0.5 * self.square_m * np.array([self.columns, self.rows])
        x, y = ((board_m - middle) * [1, -1]).T
        return np.stack([x, y, np.full(len(x), height_m)], 1)


@dataclass(frozen=True, eq=False)
class View:
    """Corners of a board detected in one picture.

    Attributes:
        name: name of the picture.
        pixels: their places in the picture.
        board_m: their places on the board [m].
    """

    name: str
    pixels: Float[np.ndarray, "corner 2"]
    board_m: Float[np.ndarray, "corner 2"]

    def only(self, kept: np.ndarray) -> "View":
        """Return a view of some of the corners, by a mask or by indices."""
        return View(self.name, self.pixels[kept], self.board_m[kept])

    @property
    def flat(self) -> bool:
        """Whether its corners do not determine the board's pose: too few, or all near one line."""
        if len(self.pixels) < LEAST_CORNERS:
            return True
        steps = np.unique(np.round(np.diff(np.unique(self.board_m)), 9))
        spread = np.linalg.svd(self.board_m - self.board_m.mean(0), compute_uv=False)
        return bool(spread[1] < 0.4 * steps[steps > 0].min() * np.sqrt(len(self.pixels)))


def board_of(size: str, square_m: float, marker_m: float, dictionary: str, legacy: bool) -> Board:
    """Return a board whose size is written as `7x5`: columns and rows of squares.

    Raises:
        DataError: the size is not written so, or no such board is possible.
    """
    columns, by, rows = size.lower().partition("x")
    if not (by and columns.strip().isdecimal() and rows.strip().isdecimal()):
        raise DataError(f"--board {size}; expected squares along x and y, such as 7x5")
    return Board(int(columns), int(rows), square_m, marker_m, dictionary, legacy)


def view_of(board: Board, picture: Picture) -> View:
    """Return the corners of the board in a picture; none where it is not detected."""
    detector = opencv().aruco.CharucoDetector(board.pattern)
    pixels, numbers = detector.detectBoard(picture.image)[:2]
    if numbers is None:
        return View(picture.path.name, np.zeros((0, 2)), np.zeros((0, 2)))
    pixels = np.asarray(pixels, float).reshape(-1, 2)
    return View(picture.path.name, pixels, board.corners_m[np.ravel(numbers)])
