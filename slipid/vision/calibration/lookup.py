"""What is in pictures in which the named board is not: its other dictionaries and sizes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slipid.support.errors import DataError
from slipid.vision.calibration.board import Board, marker_count, view_of
from slipid.vision.calibration.pictures import Picture
from slipid.vision.opencv import dictionary_names, marker_dictionary, opencv

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
