"""A printed ChArUco board, its corners in images, and the selection of usable views."""

import glob
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.camera.opencv import (
    cv2,
    marker_count,
    marker_dictionary,
    pictures_in,
    size_of,
    visible_markers,
)
from slipid.support.errors import DataError

LARGEST_M = 1.0
"""Largest edge of a square [m]; a larger number was probably meant in millimetres."""
LEAST_CORNERS = 6
"""Smallest number of corners in a usable view. A pose has six unknowns and each corner gives two
equations, so three corners would leave no equation for the lens."""
SEARCHED_PICTURES = 3
"""Number of images that are searched for other boards if the given board is not detected; few,
because every dictionary is tried on each image."""
ENOUGH_DETECTIONS = 4
"""Smallest number of detected markers or corners with which a board counts as present; so many
false detections at once are unlikely."""
LEAST_VIEWS = 6
"""Smallest number of usable views; as many must also differ from each other."""
SAME_VIEW = 0.08
"""Distance between common corners, relative to the board's size in the image, up to which two views
count as the same [1], see `_difference`."""


@dataclass(frozen=True, eq=False)
class Picture:
    """An image, and the file that it was read from."""

    path: Path
    image: np.ndarray

    @property
    def image_px(self) -> tuple[int, int]:
        """Width and height [pixel]."""
        return size_of(self.image)


def named_pictures(words: Sequence[str]) -> list[Path]:
    """Return the image files given by command-line words, each once, in the words' order.

    Args:
        words: files, folders and glob patterns.

    Raises:
        DataError: a folder contains no image, or no file matches a pattern.
    """
    named: dict[Path, None] = {}
    for word in words:
        path = Path(word)
        if path.is_dir():
            files = pictures_in(path)
        elif path.exists() or not glob.has_magic(word):
            files = [path]
        else:
            files = sorted(Path(p) for p in glob.glob(word, recursive=True) if Path(p).is_file())
            if not files:
                raise DataError(f"{word}: no file matches this pattern; expected image files")
        named.update(dict.fromkeys(files))
    return list(named)


@dataclass(frozen=True)
class Board:
    """A chessboard with markers in its white squares, printed flat.

    The board's axes start at the upper left corner of its first square: x right, y down.

    Attributes:
        columns, rows: number of squares along x and along y.
        square_m, marker_m: edge length of a square and of a marker [m].
        dictionary: dictionary of its markers, such as `4X4_50`.
        legacy: True if the board was drawn by OpenCV before 4.6, which began boards with an even
            number of rows with a white square.
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
                f"{self.dictionary} has {available}; expected a larger dictionary, such as 4X4_250"
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
        board = cv2.aruco.CharucoBoard(size, self.square_m, self.marker_m, dictionary)
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


@dataclass(frozen=True, eq=False)
class View:
    """Corners of a board detected in one image.

    Attributes:
        name: name of the image.
        pixels: x and y of the corners in the image [pixel].
        board_m: x and y of the same corners in the board's axes [m].
    """

    name: str
    pixels: Float[np.ndarray, "corner 2"]
    board_m: Float[np.ndarray, "corner 2"]

    def only(self, kept: np.ndarray) -> "View":
        """Return the view with only the corners that a mask or indices select."""
        return View(self.name, self.pixels[kept], self.board_m[kept])

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
    columns, by, rows = size.lower().partition("x")
    if not (by and columns.strip().isdecimal() and rows.strip().isdecimal()):
        raise DataError(f"--board {size}; expected the numbers of squares along x and y, as in 7x5")
    return Board(int(columns), int(rows), square_m, marker_m, dictionary, legacy)


def view_of(board: Board, picture: Picture) -> View:
    """Return the corners of the board in an image; an empty view if the board is not detected."""
    detector = cv2.aruco.CharucoDetector(board.pattern)
    pixels, numbers = detector.detectBoard(picture.image)[:2]
    if numbers is None:
        return View(picture.path.name, np.zeros((0, 2)), np.zeros((0, 2)))
    pixels = np.asarray(pixels, float).reshape(-1, 2)
    return View(picture.path.name, pixels, board.corners_m[np.ravel(numbers)])


def usable(board: Board, pictures: Sequence[Picture]) -> tuple[list[View], list[str]]:
    """Return the usable views of a board in images of one size, and sentences on unusable views.

    Raises:
        DataError: the images differ in size, or the board is detected in too few of them.
    """
    for other in pictures[1:]:
        if other.image_px != pictures[0].image_px:
            (w, h), (width, height) = pictures[0].image_px, other.image_px
            raise DataError(
                f"{other.path}: {width} x {height} pixels, but {pictures[0].path} has {w} x {h}; "
                "expected images of one camera at one resolution"
            )
    views = [view_of(board, picture) for picture in pictures]
    if not any(len(view.pixels) for view in views):
        raise not_detected(board, pictures)
    left_out = [
        f"view {v.name} left out: {len(v.pixels)} corners"
        + (" near one line" if len(v.pixels) >= LEAST_CORNERS else "")
        + f"; expected {LEAST_CORNERS} corners or more, not all on a line"
        for v in views
        if v.flat
    ]
    good = [v for v in views if not v.flat]
    check_enough(good)
    return good, left_out


def check_enough(views: Sequence[View]) -> None:
    """Check that there are enough views, and enough that differ from each other.

    Raises:
        DataError: there are too few views, or too few that differ from each other.
    """
    if len(views) < LEAST_VIEWS:
        raise DataError(
            f"{len(views)} usable views of the board; expected {LEAST_VIEWS} at the very least, "
            "better 15: take more images, at every edge and corner of the image and tilted"
        )
    distinct: list[View] = []
    for view in views:
        if all(_difference(view, other) > SAME_VIEW for other in distinct):
            distinct.append(view)
    if len(distinct) < LEAST_VIEWS:
        raise DataError(
            f"only {len(distinct)} of {len(views)} views differ: the others show the board where "
            f"another view shows it; expected {LEAST_VIEWS} or more views that differ: move the "
            "board over the whole image and tilt it"
        )


def _difference(view: View, other: View) -> float:
    """Return how far common corners of two views lie apart, relative to the corners' spread [1].

    Distance and spread are root mean squares over the common corners [pixel]; the spread is about
    the corners' middle. The difference is infinite if the views have too few common corners.
    """
    first, second = (np.round(v.board_m, 6) @ [1, 1j] for v in (view, other))
    common, in_view, in_other = np.intersect1d(first, second, return_indices=True)
    if len(common) < LEAST_CORNERS:
        return np.inf
    here, there = view.pixels[in_view], other.pixels[in_other]
    return float(np.linalg.norm(here - there) / np.linalg.norm(here - here.mean(0)))


def not_detected(board: Board, pictures: Sequence[Picture]) -> DataError:
    """Return the error to raise if no image shows the board, with advice by `_advice`."""
    if len(pictures) == 1:
        where = f"{pictures[0].path}: the board is not found in it"
    else:
        where = f"{pictures[0].path} and {len(pictures) - 1} more: the board is in none of them"
    return DataError(f"{where}; looked for {board}; {_advice(board, pictures[:SEARCHED_PICTURES])}")


def _advice(board: Board, pictures: Sequence[Picture]) -> str:
    """Return a sentence on the markers that images show instead of the board, with a remedy."""
    if other := _other_board(board, board.dictionary, pictures):
        return other
    name, numbers = visible_markers([picture.image for picture in pictures])
    if other := _other_board(board, name, pictures):
        return other
    if len(numbers) < ENOUGH_DETECTIONS:
        return (
            "and found no markers of any dictionary: expected a board that is sharp, evenly lit, "
            "not mirrored, and so large that a marker is 20 pixels wide or more"
        )
    remedy = f"use --dictionary {name} and the board's true size"
    if name == board.dictionary:
        remedy = (
            f"expected another --board size, or a board whose markers are numbered from 0 to "
            f"{board.columns * board.rows // 2 - 1}"
        )
    return (
        f"but found {len(numbers)} markers of {name} with numbers from {numbers[0]} to "
        f"{numbers[-1]}: {remedy}"
    )


def _other_board(board: Board, dictionary: str, pictures: Sequence[Picture]) -> str | None:
    """Return advice if images show a similar board with this dictionary's markers, else None.

    A similar board may have rows and columns swapped, the other value of `legacy`, or both.
    """
    if marker_count(dictionary) < board.columns * board.rows // 2:
        return None
    swapped = replace(board, columns=board.rows, rows=board.columns)
    for size, legacy in product((board, swapped), (board.legacy, not board.legacy)):
        other = replace(size, legacy=legacy, dictionary=dictionary)
        corners = max(len(view_of(other, picture).pixels) for picture in pictures)
        if corners >= ENOUGH_DETECTIONS:
            option = "--legacy" if legacy else "without --legacy"
            return (
                f"but found {corners} corners of a board of {other}; use --board {other.size} "
                f"--dictionary {dictionary} {option}"
            )
    return None
