"""Selection of usable views of a board, and advice if images do not show it."""

import glob
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from slipid.camera.calibration.board import (
    LEAST_CORNERS,
    Board,
    Chessboard,
    Picture,
    PrintedBoard,
    View,
    view_of,
)
from slipid.camera.opencv import marker_count
from slipid.camera.picture_file import pictures_in
from slipid.camera.search import MIRRORED, VisibleMarkers, small, visible_markers
from slipid.support.errors import DataError
from slipid.support.progress import Reporter, Tell, silent

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


def usable(
    board: PrintedBoard, pictures: Iterable[Picture], report: Reporter | None = None
) -> tuple[list[View], list[str], tuple[int, int]]:
    """Return the usable views of a board, sentences on unusable views, and the images' size.

    Args:
        board: the board.
        pictures: images of one size; only the first ones are kept.
        report: receives the progress of a search for other boards; None for no progress.

    Raises:
        DataError: the images differ in size, or the board is detected in too few of them.
    """
    views: list[View] = []
    first: list[Picture] = []
    for picture in pictures:
        if first and picture.image_px != first[0].image_px:
            (w, h), (width, height) = first[0].image_px, picture.image_px
            raise DataError(
                f"{picture.path}: {width} x {height} pixels, but {first[0].path} has {w} x {h}; "
                "expected images of one camera at one resolution"
            )
        views.append(view_of(board, picture))
        first += [picture] if len(first) < SEARCHED_PICTURES else []
    if not any(len(view.pixels) for view in views):
        if report is not None:
            report.stage("searching for other boards")
        raise not_detected(board, first, len(views), report.steps if report else silent)
    left_out = [
        f"view {v.name} left out: {len(v.pixels)} corners"
        + (" near one line" if len(v.pixels) >= LEAST_CORNERS else "")
        + f"; expected {LEAST_CORNERS} corners or more, not all on a line"
        for v in views
        if v.flat
    ]
    good = [v for v in views if not v.flat]
    check_enough(good)
    return good, left_out, first[0].image_px


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


def not_detected(
    board: PrintedBoard, pictures: Sequence[Picture], count: int, tell: Tell = silent
) -> DataError:
    """Return the error to raise if none of `count` images shows the board, with advice."""
    where = f"{pictures[0].path}: the board is not found in it"
    if count > 1:
        where = f"{pictures[0].path} and {count - 1} more: the board is in none of them"
    return DataError(f"{where}; looked for {board}; {_advice(board, pictures, tell)}")


def _advice(board: PrintedBoard, pictures: Sequence[Picture], tell: Tell) -> str:
    """Return a sentence on what images show instead of the board, with a remedy."""
    for picture in pictures:
        copy = Picture(picture.path, small(picture.image))
        visible = visible_markers([picture.image], tell)
        if len(visible.numbers) >= ENOUGH_DETECTIONS:
            return _board_with(board, copy, visible)
        plain = Chessboard(board.columns, board.rows, board.square_m)
        if isinstance(board, Board) and len(view_of(plain, copy).pixels):
            return f"but found a chessboard without markers: use --chessboard {plain.inner}"
    if isinstance(board, Chessboard):
        return (
            "expected the whole board in view, sharp and evenly lit, and the numbers of its inner "
            "corners, which are those of its squares less one"
        )
    return (
        "and found no markers of any dictionary: expected a board that is sharp, evenly lit, and "
        "so large that a marker is 20 pixels wide or more"
    )


def _board_with(board: PrintedBoard, picture: Picture, visible: VisibleMarkers) -> str:
    """Return a sentence on a board with visible markers, which is not the given board."""
    first, last, dictionary = visible.numbers[0], visible.numbers[-1], visible.dictionary
    found = f"but found {len(visible.numbers)} markers of {dictionary}"
    if visible.mirrored:
        return f"{found}, which {MIRRORED}"
    if isinstance(board, Chessboard):
        return f"{found}: a board with markers needs --board and --marker, not --chessboard"
    assert isinstance(board, Board)
    if other := _similar_board(board, dictionary, picture):
        return other
    remedy = f"use --dictionary {dictionary} and the board's true size"
    if dictionary == board.dictionary:
        remedy = (
            f"expected another --board size, or a board whose markers are numbered from 0 to "
            f"{board.columns * board.rows // 2 - 1}"
        )
    return f"{found} with numbers from {first} to {last}: {remedy}"


def _similar_board(board: Board, dictionary: str, picture: Picture) -> str | None:
    """Return advice if an image shows a similar board with this dictionary's markers, else None.

    A similar board may have rows and columns swapped, the other value of `legacy`, or both.
    """
    if marker_count(dictionary) < board.columns * board.rows // 2:
        return None
    swapped = replace(board, columns=board.rows, rows=board.columns)
    for size, legacy in product((board, swapped), (board.legacy, not board.legacy)):
        other = replace(size, legacy=legacy, dictionary=dictionary)
        corners = len(view_of(other, picture).pixels)
        if corners >= ENOUGH_DETECTIONS:
            option = "--legacy" if legacy else "without --legacy"
            return (
                f"but found {corners} corners of a board of {other}; use --board {other.size} "
                f"--dictionary {dictionary} {option}"
            )
    return None
