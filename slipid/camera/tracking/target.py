"""Targets to track: bodies with markers, specified by dictionary, number, size and position.

Without a file of targets, a body has a single marker in its middle with the top edge ahead, so that
the heading is the direction from the marker's bottom edge to its top edge, as the dictionary
defines these edges. A file of targets can put several markers, or boards of markers, anywhere on a
body:

    [[target]]
    name = "robot"
    dictionary = "4X4_50"

    [[target.marker]]
    id = 0
    size_m = 0.131
    height_m = 0.25            # above the floor
    place_m = [0.05, 0.0]      # position of its middle on the body, x ahead, y left
    yaw_deg = 90.0             # direction of its top edge, counter-clockwise from ahead

    [[target.board]]           # a grid of markers, numbered along its rows
    first_id = 10
    columns = 3
    rows = 2
    size_m = 0.04
    gap_m = 0.01
    height_m = 0.25
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field

from slipid.camera.opencv import marker_count
from slipid.support.errors import DataError
from slipid.support.quantities import Bounds, Degrees, Height, MarkerEdge
from slipid.support.toml_file import Section, checked, mapping_of, text_of

Aside = Annotated[float, Bounds(-100, 100, "m")]
Id = Annotated[int, Field(ge=0, strict=True)]


@dataclass(frozen=True, eq=False)
class Marker:
    """One marker on a body.

    Attributes:
        id: number of the marker in its dictionary.
        size: edge length of its black square [m].
        corners: x ahead, y left on the body and height above the floor of its corners [m], in
            OpenCV's order: top left, top right, bottom right, bottom left.
    """

    id: int
    size: float
    corners: Float[np.ndarray, "corner 3"]

    @classmethod
    def at(
        cls,
        id: int,
        size: float,
        height: float,
        place: tuple[float, float] = (0.0, 0.0),
        yaw: float = 0.0,
    ) -> "Marker":
        """Return a marker on a body.

        Args:
            id: number of the marker in its dictionary.
            size: edge length of its black square [m].
            height: height above the floor [m].
            place: position of its middle on the body, x ahead and y left [m].
            yaw: direction of its top edge, counter-clockwise from ahead [rad].
        """
        ahead_left = 0.5 * size * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
        c, s = np.cos(yaw), np.sin(yaw)
        flat = ahead_left @ np.array([[c, s], [-s, c]]) + np.asarray(place)
        return cls(id, size, np.column_stack([flat, np.full(4, height)]))


@dataclass(frozen=True, eq=False)
class Target:
    """A body and its markers, all of one dictionary and with different numbers."""

    name: str
    dictionary: str
    markers: tuple[Marker, ...]

    @property
    def ids(self) -> frozenset[int]:
        """Numbers of the body's markers."""
        return frozenset(marker.id for marker in self.markers)

    @property
    def height(self) -> float:
        """Mean height of the body's markers above the floor [m]."""
        return float(np.mean([marker.corners[:, 2] for marker in self.markers]))

    def below(self, camera_m: float) -> None:
        """Raise `DataError` unless all markers are lower than the camera's height `camera_m` [m].

        Raises:
            DataError: a marker is as high as the camera, or higher.
        """
        for marker in self.markers:
            if (height := float(marker.corners[:, 2].max())) >= camera_m:
                raise DataError(
                    f"{self.name}: marker {marker.id} is {height:g} m above the floor, but the "
                    f"camera only {camera_m:g} m; expected a marker height in metres, below the "
                    "camera"
                )


class _Placed(Section):
    """Size, position and direction of a marker or a board on the body."""

    size_m: MarkerEdge
    height_m: Height
    place_m: tuple[Aside, Aside] = (0.0, 0.0)
    yaw_deg: Degrees = 0.0


class _Single(_Placed):
    """A single marker."""

    id: Id


class _Board(_Placed):
    """A grid of markers whose middle is at `place_m` and whose first row is ahead."""

    first_id: Id
    columns: Annotated[int, Field(ge=1, le=100)]
    rows: Annotated[int, Field(ge=1, le=100)]
    gap_m: MarkerEdge

    def markers(self) -> list[Marker]:
        """Return the board's markers row by row, beginning ahead on the left."""
        pitch, yaw = self.size_m + self.gap_m, np.radians(self.yaw_deg)
        c, s = np.cos(yaw), np.sin(yaw)
        out = []
        for k in range(self.rows * self.columns):
            row, column = divmod(k, self.columns)
            ahead = pitch * (0.5 * (self.rows - 1) - row)
            left = pitch * (0.5 * (self.columns - 1) - column)
            place = (self.place_m[0] + c * ahead - s * left, self.place_m[1] + s * ahead + c * left)
            out.append(Marker.at(self.first_id + k, self.size_m, self.height_m, place, yaw))
        return out


class _Target(Section):
    """A body and its markers."""

    name: Annotated[str, Field(pattern="^[A-Za-z0-9_-]+$", max_length=60)] = "robot"
    dictionary: str = "4X4_50"
    marker: list[_Single] = Field(default_factory=list)
    board: list[_Board] = Field(default_factory=list)


class _TargetsFile(Section):
    """Keys of a file of targets."""

    schema_: Literal["slipid.targets/1"] = Field("slipid.targets/1", alias="schema")
    target: list[_Target] = Field(min_length=1)


def read_targets(path: Path) -> tuple[Target, ...]:
    """Return the targets in a TOML file.

    Raises:
        DataError: the file is unreadable or has wrong keys or values, a target has no marker, a
            marker or a name occurs twice, or dictionaries differ.
    """
    given = checked(path, mapping_of(path, text_of(path, "targets to track")), _TargetsFile)
    targets = tuple(_target(one, f"{path}: target '{one.name}'") for one in given.target)
    _check_distinct(targets, str(path))
    return targets


def _target(given: _Target, where: str) -> Target:
    markers = [
        Marker.at(m.id, m.size_m, m.height_m, m.place_m, float(np.radians(m.yaw_deg)))
        for m in given.marker
    ]
    markers += [marker for board in given.board for marker in board.markers()]
    if not markers:
        raise DataError(f"{where}: no marker; expected [[target.marker]] or [[target.board]]")
    try:
        most = marker_count(given.dictionary)
    except DataError as error:
        raise DataError(f"{where}: {error}") from error
    for marker in markers:
        if marker.id >= most:
            raise DataError(
                f"{where}: marker {marker.id}; expected 0 to {most - 1} in {given.dictionary}"
            )
    return Target(given.name, given.dictionary, tuple(markers))


def _check_distinct(targets: Sequence[Target], where: str) -> None:
    """Raise `DataError` if a marker or a name occurs twice, or dictionaries differ."""
    if len({target.name for target in targets}) < len(targets):
        raise DataError(f"{where}: two targets have the same name; expected different names")
    if len({target.dictionary for target in targets}) > 1:
        raise DataError(
            f"{where}: targets with several dictionaries; expected the same dictionary in all"
        )
    ids = [marker.id for target in targets for marker in target.markers]
    for k, number in enumerate(ids):
        if number in ids[:k]:
            raise DataError(f"{where}: marker {number} occurs twice; expected every number once")
