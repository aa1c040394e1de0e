"""What is in pictures in which the named board is not: its other dictionaries and sizes.

Which views can be used, and whether they are enough and differ.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from slipid.camera.calibration.board import (
    LEAST_CORNERS,
    Board,
    Picture,
    View,
    marker_count,
    same_size,
    view_of,
)
from slipid.camera.opencv import dictionary_names, marker_dictionary, opencv
from slipid.support.errors import DataError

LOOKED = 3
"""Pictures that are searched for something else: a few are enough, and dictionaries are many."""
NEARLY = 0.8
ENOUGH = 4
"""Markers that are hardly seen by chance."""


def not_found(board: Board, pictures: Sequence[Picture]) -> DataError:
    """What to say where no picture shows the board: what was looked for, and what is there."""
    if len(pictures) == 1:
        where = f"{pictures[0].path}: the board is not found in it"
    else:
        where = f"{pictures[0].path} and {len(pictures) - 1} more: the board is found in none"
    return DataError(f"{where}; looked for {board}; {_instead(board, pictures[:LOOKED])}")


def _instead(board: Board, pictures: Sequence[Picture]) -> str:
    if other := _other(board, board.dictionary, pictures):
        return other
    name, numbers = _dictionary(pictures)
    if other := _other(board, name, pictures):
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


def _other(board: Board, dictionary: str, pictures: Sequence[Picture]) -> str | None:
    """What to say of a board that is easily taken for this one, where one is there."""
    if marker_count(dictionary) < board.columns * board.rows // 2:
        return None
    swapped = replace(board, columns=board.rows, rows=board.columns)
    for size in (board, swapped):
        for legacy in (board.legacy, not board.legacy):
            other = replace(size, legacy=legacy, dictionary=dictionary)
            corners = max(len(view_of(other, picture).pixels) for picture in pictures)
            if corners >= ENOUGH:
                return f"but {corners} corners of this one are: {other}; say {_options(other)}"
    return None


def _options(board: Board) -> str:
    old = " --legacy" if board.legacy else " without --legacy"
    return f"--board {board.size} --dictionary {board.dictionary}{old}"


def _dictionary(pictures: Sequence[Picture]) -> tuple[str, list[int]]:
    """The smallest dictionary with nearly most markers in the pictures, and their numbers."""
    found: dict[str, set[int]] = {
        name: {n for picture in pictures for n in _markers(name, picture)}
        for name in dictionary_names()
    }
    # a large dictionary contains smaller ones, and has a few more by chance
    most = max(len(numbers) for numbers in found.values())
    likely = [name for name, numbers in found.items() if len(numbers) >= NEARLY * most]
    name = min(likely, key=marker_count)
    return name, sorted(found[name])


def _markers(dictionary: str, picture: Picture) -> list[int]:
    detector = opencv().aruco.ArucoDetector(marker_dictionary(dictionary))
    numbers = detector.detectMarkers(picture.image)[1]
    return [] if numbers is None else [int(n) for n in np.ravel(numbers)]


LEAST_VIEWS = 6
SAME = 0.08
"""Of the board's size in the picture: views that differ by less say the same thing twice."""
ACROSS, DOWN = 8, 6
"""Cells over the picture in which corners are looked for."""


@dataclass(frozen=True, eq=False)
class Views:
    """Views of a board that can be used, all of one size, and sentences about the others."""

    image_px: tuple[int, int]
    views: list[View]
    left_out: list[str]


@dataclass(frozen=True, eq=False)
class Coverage:
    """Which part of the picture has corners.

    Attributes:
        visited: cells with corners, from the upper left.
        reach: how far corners get from the middle towards the picture's four corners, the least of
            the four [1].
    """

    visited: Bool[np.ndarray, "down across"]
    reach: float

    @property
    def share(self) -> float:
        """Of cells that have corners [1]."""
        return float(self.visited.mean())


def usable(board: Board, pictures: Sequence[Picture]) -> Views:
    """Views of a board in pictures.

    Raises:
        DataError: the pictures differ in size, or none shows the board, or too few.
    """
    for other in pictures[1:]:
        same_size(pictures[0], other)
    views = [view_of(board, picture) for picture in pictures]
    if not any(len(view.pixels) for view in views):
        raise not_found(board, pictures)
    left_out = [
        f"view {v.name} left out: {len(v.pixels)} corners"
        + (" near one line" if len(v.pixels) >= LEAST_CORNERS else "")
        + f"; expected {LEAST_CORNERS} or more, not all on a line"
        for v in views
        if v.flat
    ]
    good = [v for v in views if not v.flat]
    enough(good)
    return Views(pictures[0].image_px, good, left_out)


def enough(views: Sequence[View]) -> None:
    """Refuse views that are too few, or too many of which are the same.

    Raises:
        DataError: they are.
    """
    if len(views) < LEAST_VIEWS:
        raise DataError(
            f"{len(views)} usable views of the board; expected {LEAST_VIEWS} at the very least, "
            "better 15: take more pictures, at every edge and corner of the picture and tilted"
        )
    distinct: list[View] = []
    for view in views:
        if all(_apart(view, other) > SAME for other in distinct):
            distinct.append(view)
    if len(distinct) < LEAST_VIEWS:
        raise DataError(
            f"only {len(distinct)} of {len(views)} views differ: in the others the board is where "
            f"it was before; expected {LEAST_VIEWS} or more views that differ: move the board over "
            "the whole picture and tilt it"
        )


def coverage(pixels: Float[np.ndarray, "corner 2"], image_px: tuple[int, int]) -> Coverage:
    """Which part of a picture corners cover."""
    size = np.array(image_px)
    cells = np.clip((pixels + 0.5) / size * [ACROSS, DOWN], 0, [ACROSS - 1, DOWN - 1]).astype(int)
    visited = np.zeros((DOWN, ACROSS), bool)
    visited[cells[:, 1], cells[:, 0]] = True
    from_middle = (pixels - (size - 1) / 2) / (size / 2)
    # as far as the nearer of both edges: a corner at the middle of an edge reaches no corner
    ways = ([1, 1], [1, -1], [-1, 1], [-1, -1])
    reach = min(float((from_middle * way).min(1).max()) for way in ways)
    return Coverage(visited, max(reach, 0.0))


def _apart(view: View, other: View) -> float:
    """How far corners are apart that both views have, over their distance from their middle."""
    first, second = (
        {tuple(np.round(b, 6)): p for b, p in zip(v.board_m, v.pixels, strict=True)}
        for v in (view, other)
    )
    common = first.keys() & second.keys()
    if len(common) < LEAST_CORNERS:
        return np.inf
    here, there = (np.array([corners[key] for key in common]) for corners in (first, second))
    return float(np.linalg.norm(here - there) / np.linalg.norm(here - here.mean(0)))
