"""Printed boards, with markers or without, and their corners in images."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.camera.frame import grey_of
from slipid.camera.opencv import Grey, cv2, marker_count, marker_dictionary, size_of
from slipid.camera.search import small
from slipid.support.errors import DataError

LARGEST_M = 1.0
"""Largest edge of a square [m]; a larger number was probably meant in millimetres."""
LEAST_CORNERS = 6
"""Smallest number of corners in a usable view. A pose has six unknowns and each corner gives two
equations, so three corners would leave no equation for the lens."""
REFINED_SHARE = 0.4
"""Half the width of the window in which a corner of a plain chessboard is refined, relative to the
smallest distance between neighbouring corners [1]; a wider one would contain other corners."""
IRREGULAR = 0.5
"""Change of the step between corners from one step to the next, relative to the larger one [1],
above which corners are none of a chessboard: no perspective or lens bends a grid so much. In
real pictures of chessboards it was 0.13 at most."""
Corners = tuple[Float[np.ndarray, "corner 2"], Float[np.ndarray, "corner 2"]]
"""Pixels of detected corners, and their positions in the board's axes [m]."""


@dataclass(frozen=True, eq=False)
class Picture:
    """An image, and the file that it was read from."""

    path: Path
    image: np.ndarray

    @property
    def image_px(self) -> tuple[int, int]:
        """Width and height [pixel]."""
        return size_of(self.image)


@dataclass(frozen=True)
class PrintedBoard(ABC):
    """A chessboard that is printed flat.

    The board's axes start at the upper left corner of its first square: x right, y down.

    Attributes:
        columns, rows: number of squares along x and along y.
        square_m: edge length of a square [m].
    """

    columns: int
    rows: int
    square_m: float

    def check_squares(self) -> None:
        """Raise `DataError` if there are too few squares, or if they are too large."""
        if not (self.columns >= 3 and self.rows >= 3):
            raise DataError(f"a board of {self.size} squares; expected 3x3 or more, such as 7x5")
        if not 0 < self.square_m <= LARGEST_M:
            raise DataError(
                f"squares of {self.square_m:g} m; expected metres, and {LARGEST_M:g} m at most"
            )

    @property
    def size(self) -> str:
        """Columns and rows as a user writes them, such as `7x5`."""
        return f"{self.columns}x{self.rows}"

    @cached_property
    def corners_m(self) -> Float[np.ndarray, "corner 2"]:
        """Inner corners in the board's axes [m], row by row."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        return self.square_m * np.stack([x.ravel(), y.ravel()], 1)

    def on_floor(
        self, board_m: Float[np.ndarray, "corner 2"], height_m: float
    ) -> Float[np.ndarray, "corner 3"]:
        """Return positions of corners in a world whose origin is below the board's middle [m].

        The origin is on the floor. With the board seen from above, x points to its right, y to its
        upper edge, and z up.

        Args:
            board_m: corners in the board's axes [m].
            height_m: height of the board's printed face above the floor [m].
        """
        middle = 0.5 * self.square_m * np.array([self.columns, self.rows])
        x, y = ((board_m - middle) * [1, -1]).T
        return np.stack([x, y, np.full(len(x), height_m)], 1)

    @abstractmethod
    def detected(self, grey: Grey) -> Corners:
        """Return the corners in an image; no corners if the board is not detected."""


@dataclass(frozen=True)
class Board(PrintedBoard):
    """A ChArUco board: a chessboard with markers in its white squares.

    Attributes:
        marker_m: edge length of a marker [m].
        dictionary: dictionary of its markers, such as `4X4_50`.
        legacy: True if the board was drawn by OpenCV before 4.6, which began boards with an even
            number of rows with a white square.
    """

    marker_m: float
    dictionary: str = "4X4_50"
    legacy: bool = False

    def __post_init__(self) -> None:
        marker_dictionary(self.dictionary)
        self.check_squares()
        if not 0 < self.marker_m < self.square_m:
            raise DataError(
                f"squares of {self.square_m:g} m and markers of {self.marker_m:g} m; expected "
                "markers smaller than squares, both in metres"
            )
        available, needed = marker_count(self.dictionary), self.columns * self.rows // 2
        if needed > available:
            raise DataError(
                f"a board of {self.size} squares has {needed} markers, but dictionary "
                f"{self.dictionary} has {available}; expected a larger dictionary, such as 4X4_250"
            )

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
        board = cv2.aruco.CharucoBoard(size, self.square_m, self.marker_m, dictionary)
        if self.legacy:
            board.setLegacyPattern(True)
        return board

    def detected(self, grey: Grey) -> Corners:
        """Return the corners in an image; no corners if the board is not detected."""
        pixels, numbers = cv2.aruco.CharucoDetector(self.pattern).detectBoard(grey)[:2]
        if numbers is None:
            return np.zeros((0, 2)), np.zeros((0, 2))
        return np.asarray(pixels, float).reshape(-1, 2), self.corners_m[np.ravel(numbers)]


@dataclass(frozen=True)
class Chessboard(PrintedBoard):
    """A chessboard without markers, detected only where all its inner corners are in view.

    A board cannot be distinguished from the same board after half a turn, so its corners determine
    a lens but not the axes of a floor.
    """

    def __post_init__(self) -> None:
        self.check_squares()

    @property
    def inner(self) -> str:
        """Number of inner corners along x and y as a user writes them, such as `9x6`."""
        return f"{self.columns - 1}x{self.rows - 1}"

    def __str__(self) -> str:
        return f"a chessboard with {self.inner} inner corners, squares of {self.square_m:g} m"

    def detected(self, grey: Grey) -> Corners:
        """Return the corners in an image; no corners if the board is not detected."""
        copy = small(grey)
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        shape = (self.columns - 1, self.rows - 1)
        found, rough = cv2.findChessboardCornersSB(copy, shape, flags=flags)
        if not found or not _regular(np.asarray(rough, float).reshape(*shape[::-1], 2)):
            return np.zeros((0, 2)), np.zeros((0, 2))
        scale = np.array(size_of(grey)) / size_of(copy)
        pixels = ((np.asarray(rough, float).reshape(-1, 2) + 0.5) * scale - 0.5).astype(np.float32)
        grid = pixels.reshape(*shape[::-1], 2)
        steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
        reach = max(2, int(REFINED_SHARE * min(steps)))
        until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
        fine = cv2.cornerSubPix(grey, pixels.reshape(-1, 1, 2), (reach, reach), (-1, -1), until)
        return np.asarray(fine, float).reshape(-1, 2), self.corners_m


def _regular(grid: Float[np.ndarray, "row column 2"]) -> bool:
    """Return True if the steps of a grid of corners change little from each to the next.

    OpenCV also returns grids of what is no chessboard, such as the keys of a keyboard.
    """
    for axis, across in ((0, 0), (0, 1), (1, 1)):
        steps = np.moveaxis(np.diff(grid, axis=axis), across, 0)
        before, after = steps[:-1], steps[1:]
        larger = np.maximum(*(np.linalg.norm(one, axis=-1) for one in (before, after)))
        if (np.linalg.norm(after - before, axis=-1) > IRREGULAR * larger).any():
            return False
    return True


@dataclass(frozen=True, eq=False)
class View:
    """Corners of a board detected in one image.

    Attributes:
        name: name of the image.
        pixels: x and y of the corners in the image [pixel].
        board_m: x and y of the same corners in the board's axes [m].
        inverted: True if the board is printed white on black.
    """

    name: str
    pixels: Float[np.ndarray, "corner 2"]
    board_m: Float[np.ndarray, "corner 2"]
    inverted: bool = False

    def only(self, kept: np.ndarray) -> "View":
        """Return the view with only the corners that a mask or indices select."""
        return replace(self, pixels=self.pixels[kept], board_m=self.board_m[kept])

    @property
    def flat(self) -> bool:
        """True if the corners do not determine the board's pose: too few, or all near one line."""
        if len(self.pixels) < LEAST_CORNERS:
            return True
        steps = np.unique(np.round(np.diff(np.unique(self.board_m)), 9))
        spread = np.linalg.svd(self.board_m - self.board_m.mean(0), compute_uv=False)
        # with half of the corners on each of two neighbouring lines, the factor would be 0.5
        return bool(spread[1] < 0.4 * steps[steps > 0].min() * np.sqrt(len(self.pixels)))


def board_of(size: str, square_m: float, marker_m: float, dictionary: str, legacy: bool) -> Board:
    """Return a board whose size is given as a string such as `7x5`: columns x rows of squares.

    Raises:
        DataError: the string does not have this form, or no board can have these sizes.
    """
    columns, rows = _numbers("--board", size, "squares along x and y, as in 7x5")
    return Board(columns, rows, square_m, marker_m, dictionary, legacy)


def chessboard_of(inner: str, square_m: float) -> Chessboard:
    """Return a board whose inner corners are given as a string such as `9x6`: columns x rows.

    Raises:
        DataError: the string does not have this form, or no board can have these sizes.
    """
    columns, rows = _numbers("--chessboard", inner, "inner corners along x and y, as in 9x6")
    return Chessboard(columns + 1, rows + 1, square_m)


def _numbers(option: str, text: str, what: str) -> tuple[int, int]:
    """Return the two numbers in a text such as `7x5`, each of three digits at most."""
    columns, by, rows = (part.strip() for part in text.lower().partition("x"))
    if not (by and columns.isdecimal() and rows.isdecimal() and max(len(columns), len(rows)) < 4):
        raise DataError(f"{option} {text}; expected the numbers of {what}")
    return int(columns), int(rows)


def view_of(board: PrintedBoard, picture: Picture) -> View:
    """Return the corners of a board in an image; an empty view if the board is not detected.

    If it is not detected, a board printed white on black is looked for.
    """
    grey = grey_of(picture.image)
    view = View(picture.path.name, *board.detected(grey))
    if len(view.pixels) or not isinstance(board, Board):
        return view
    return View(picture.path.name, *board.detected(255 - grey), inverted=True)
