"""Views of the board in pictures: which are usable, and what else a picture shows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slipid.camera.calibration.board import (
    LEAST_CORNERS,
    Board,
    Picture,
    View,
    view_of,
)
from slipid.camera.opencv import marker_count, visible_markers
from slipid.support.errors import DataError

SEARCHED = 3
"""Number of pictures searched for another board: a few suffice, and there are many dictionaries."""
ENOUGH = 4
"""Number of markers that are hardly detected by chance."""
LEAST_VIEWS = 6
"""Smallest number of usable views that differ."""
SAME = 0.08
"""Difference, relative to the board's size in the picture, below which two views are the same."""


@dataclass(frozen=True, eq=False)
class UsableViews:
    """Usable views of a board, all of one size [pixel], and sentences about the others."""

    image_px: tuple[int, int]
    views: list[View]
    left_out: list[str]


def usable(board: Board, pictures: Sequence[Picture]) -> UsableViews:
    """Return the usable views of a board in pictures.

    Raises:
        DataError: the pictures differ in size, or none shows the board, or too few.
    """
    for other in pictures[1:]:
        if other.image_px != pictures[0].image_px:
            (w, h), (width, height) = pictures[0].image_px, other.image_px
            raise DataError(
                f"{other.path}: {width} x {height} pixels, but {pictures[0].path} has {w} x {h}; "
                "expected pictures of one camera at one resolution"
            )
    views = [view_of(board, picture) for picture in pictures]
    if not any(len(view.pixels) for view in views):
        raise not_detected(board, pictures)
    left_out = [
        f"view {v.name} left out: {len(v.pixels)} corners"
        + (" near one line" if len(v.pixels) >= LEAST_CORNERS else "")
        + f"; expected {LEAST_CORNERS} or more, not all on a line"
        for v in views
        if v.flat
    ]
    good = [v for v in views if not v.flat]
    check_enough(good)
    return UsableViews(pictures[0].image_px, good, left_out)


def check_enough(views: Sequence[View]) -> None:
    """Check that there are enough views that differ.

    Raises:
        DataError: there are too few, or too many of them are the same.
    """
    if len(views) < LEAST_VIEWS:
        raise DataError(
            f"{len(views)} usable views of the board; expected {LEAST_VIEWS} at the very least, "
            "better 15: take more pictures, at every edge and corner of the picture and tilted"
        )
    distinct: list[View] = []
    for view in views:
        if all(_difference(view, other) > SAME for other in distinct):
            distinct.append(view)
    if len(distinct) < LEAST_VIEWS:
        raise DataError(
            f"only {len(distinct)} of {len(views)} views differ: in the others the board is where "
            f"it was before; expected {LEAST_VIEWS} or more views that differ: move the board over "
            "the whole picture and tilt it"
        )


def _difference(view: View, other: View) -> float:
    """Return the distance of common corners in two views, relative to that from their middle."""
    first, second = (
        {tuple(np.round(b, 6)): p for b, p in zip(v.board_m, v.pixels, strict=True)}
        for v in (view, other)
    )
    common = first.keys() & second.keys()
    if len(common) < LEAST_CORNERS:
        return np.inf
    here, there = (np.array([corners[key] for key in common]) for corners in (first, second))
    return float(np.linalg.norm(here - there) / np.linalg.norm(here - here.mean(0)))


def not_detected(board: Board, pictures: Sequence[Picture]) -> DataError:
    """Return the error to raise where no picture shows the board; it says what they show."""
    if len(pictures) == 1:
        where = f"{pictures[0].path}: the board is not found in it"
    else:
        where = f"{pictures[0].path} and {len(pictures) - 1} more: the board is found in none"
    return DataError(f"{where}; looked for {board}; {_instead(board, pictures[:SEARCHED])}")


def _instead(board: Board, pictures: Sequence[Picture]) -> str:
    """Return what pictures show instead of the board, and what to do."""
    if other := _other_board(board, board.dictionary, pictures):
        return other
    markers = visible_markers([picture.image for picture in pictures])
    name, numbers = markers.dictionary, markers.numbers
    if other := _other_board(board, name, pictures):
        return other
    if len(numbers) < ENOUGH:
        return (
            "and found no markers of any dictionary: expected a board that is sharp, evenly lit, "
            "not mirrored, and large enough that a marker has 20 pixels or more"
        )
    if name == board.dictionary:
        return (
            f"but {len(numbers)} markers of {name} are there, numbers {numbers[0]} to "
            f"{numbers[-1]}: expected another size in squares, or a board of other numbers"
        )
    return (
        f"but {len(numbers)} markers of dictionary {name} are there, numbers {numbers[0]} to "
        f"{numbers[-1]}: say --dictionary {name} and the board's true size"
    )


def _other_board(board: Board, dictionary: str, pictures: Sequence[Picture]) -> str | None:
    """Return advice where pictures show a board that is easily mistaken for this one, else None."""
    if marker_count(dictionary) < board.columns * board.rows // 2:
        return None
    swapped = replace(board, columns=board.rows, rows=board.columns)
    for size in (board, swapped):
        for legacy in (board.legacy, not board.legacy):
            other = replace(size, legacy=legacy, dictionary=dictionary)
            corners = max(len(view_of(other, picture).pixels) for picture in pictures)
            if corners >= ENOUGH:
                option = "--legacy" if legacy else "without --legacy"
                return (
                    f"but {corners} corners of this one are: {other}; say --board {other.size} "
                    f"--dictionary {dictionary} {option}"
                )
    return None
