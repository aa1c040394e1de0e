"""Reference robots: numbers of well-known robots and motors, identified from public logs.

Each is a file of `configs/robots`, which ships with slipid; `configs/robots/derive.py` made them.
The files have derived numbers only, and name the source and the licence of the logs.
"""

import re
from collections.abc import Iterator
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from slipid.app.logs import packaged_path
from slipid.support.content import Content
from slipid.support.errors import DataError, did_you_mean
from slipid.support.files import read_json
from slipid.support.quantities import NotNegative
from slipid.support.toml_file import CLOSED, checked

SCHEMA = "slipid.reference/1"
ERROR = "trust.held_out_error_over_path"
"""First part of the paths of errors, `ERROR.FLOOR.MODEL`, as they stand in identified.json."""
MULTIPLIERS = "calibration.multipliers"
"""First part of the paths of calibrated over nominal lengths, as they stand in identified.json."""
_SIMILAR = (frozenset({"omni", "mecanum"}), frozenset({"skid", "differential"}))
"""Drives whose robots resemble each other: those that go sideways, and those that cannot."""
Interval = tuple[float, float]
Numeric = float | tuple[float, ...]


@dataclass(frozen=True, config=CLOSED)
class ReferenceNumber:
    """An identified or calibrated number of a reference robot.

    Attributes:
        value: a float, or one per wheel, drive or axis [unit].
        unit: unit of value and interval.
        interval90: equal-tailed 90 % interval (low, high), or one such pair per value [unit].
        verdict: how well the logs determine it; `not_identified` means that the value is that of
            the prior, such as a datasheet.
    """

    value: Numeric
    unit: str
    interval90: Interval | tuple[Interval, ...]
    verdict: Literal["identified", "weak", "disputed", "not_identified", "at_bound"]

    @property
    def is_determined(self) -> bool:
        """True if the logs determine the number, at least weakly."""
        return self.verdict in ("identified", "weak", "disputed")

    @property
    def mean(self) -> tuple[float, Interval]:
        """The value and the ends of its interval, averaged over wheels, drives or axes [unit]."""
        low, high = np.atleast_2d(self.interval90).mean(axis=0).tolist()
        return float(np.mean(self.value)), (low, high)


@dataclass(frozen=True, config=CLOSED)
class ReferenceFloor:
    """A floor on which a reference robot was driven, and how models predict its held-out runs.

    Attributes:
        runs: number of predicted runs.
        held_out: True if the runs were predicted by models that were not fitted to them.
        selected: name of the selected model.
        error_over_path: mean error over the path length, keyed by model [1]; `nominal` has the
            config's lengths, and `selected` is the selected model.
    """

    runs: Annotated[int, Field(ge=1)]
    held_out: bool
    selected: str
    error_over_path: dict[str, NotNegative]


@dataclass(frozen=True, config=CLOSED)
class ReferenceSource:
    """Origin and licence of the logs of a reference robot.

    Attributes:
        title: what the logs are.
        url: address of the logs.
        doi: identifier of the publication on the logs, or on how the robot was driven; None if
            there is none.
        licence: licence of the logs (SPDX identifier).
        data_hash: hash of the names and contents of all log files, as in identified.json.
        runs: number of fitted runs.
    """

    title: str
    url: str
    doi: str | None
    licence: str
    data_hash: str
    runs: int


@dataclass(frozen=True, config=CLOSED)
class ReferenceOrigin:
    """How the file of a reference robot was made: command, config, version of slipid, and date."""

    command: str
    config: str
    slipid: str
    date: str


@dataclass(frozen=True, config=CLOSED)
class ReferenceRobot:
    """A robot, or the motors of a robot on a bench, identified from public logs.

    Attributes:
        schema: version of the file's format.
        name: name in commands, and of the file.
        about: what it is, in a few words.
        drive: type of the wheels, as in a config; `motor` for motors on a bench.
        nominal: sizes that the config has, keyed by option of `slipid new`; empty for motors.
        trust: trust in the fit, with the words of identified.json.
        notes: what to know before using the numbers, one sentence each.
        floors: floors with the errors of held-out runs, keyed by name; empty for motors.
        numbers: identified and calibrated numbers, keyed by the path that they have in
            identified.json.
        source: where the logs come from.
        origin: how the file was made.
    """

    schema: Literal["slipid.reference/1"]
    name: str
    about: str
    drive: str
    nominal: dict[str, float | bool | str | list[float]]
    trust: str
    notes: list[str]
    floors: dict[str, ReferenceFloor]
    numbers: dict[str, ReferenceNumber]
    source: ReferenceSource
    origin: ReferenceOrigin

    def to_json(self) -> Content:
        """Return the content of the file."""
        return asdict(self)

    def multiplier(self, length: str, floor: str) -> float | None:
        """Return a calibrated length on a floor over that of the config [1].

        Args:
            length: `wheel_radius` (mean of the drives), or `track` (effective track or base).
            floor: name of the floor.

        Returns:
            The ratio, or None if the logs do not determine it.
        """
        number = self.numbers.get(f"{MULTIPLIERS}.{floor}.{length}")
        return number.mean[0] if number is not None and number.is_determined else None


def reference_names() -> tuple[str, ...]:
    """Return the names of all reference robots, in alphabetical order."""
    folder = packaged_path("robots")
    return tuple(sorted(path.stem for path in folder.glob("*.json")))


def read_reference(path: Path) -> ReferenceRobot:
    """Return the reference robot in a file.

    Raises:
        DataError: the file is missing or damaged; every mistake is a line of the message.
    """
    content = read_json(path, f"a reference robot ({SCHEMA})")
    return checked(path, content, ReferenceRobot, strict=True)


@cache
def reference_robot(name: str) -> ReferenceRobot:
    """Return the reference robot with this name; raise `DataError` if there is none."""
    known = reference_names()
    if name not in known:
        raise DataError(
            f"no reference robot '{name}'{did_you_mean(name, known)}; "
            f"expected one of {', '.join(known)}"
        )
    return read_reference(packaged_path("robots") / f"{name}.json")


def reference_robots() -> tuple[ReferenceRobot, ...]:
    """Return all reference robots, in alphabetical order."""
    return tuple(map(reference_robot, reference_names()))


@dataclass(frozen=True)
class ReferenceBand:
    """A number of a similar reference robot, beside which that of another robot can be judged.

    Attributes:
        robot: name of the reference robot.
        drive: type of its wheels.
        floor: name of the floor; empty for a number of the whole robot.
        value: the number; a mean over wheels, drives or axes.
        interval90: 90 % interval, averaged likewise; None for an error.
        unit: unit of value and interval.
        verdict: how well the logs determine it, `held-out` or `fitted` for an error.
    """

    robot: str
    drive: str
    floor: str
    value: float
    interval90: Interval | None
    unit: str
    verdict: str


def reference_bands(drive: str, path: str) -> tuple[ReferenceBand, ...]:
    """Return a number of all reference robots that resemble a robot, floor by floor.

    Numbers that the logs of a reference robot do not determine are left out.

    Args:
        drive: type of the robot's wheels, as in a config.
        path: path of the number in identified.json, with `*` for the floor: `surface.*.creep`,
            `calibration.multipliers.*.wheel_radius` (calibrated over nominal radius), or
            `trust.held_out_error_over_path.*.MODEL`, where MODEL may be `selected`.
    """
    similar = next((group for group in _SIMILAR if drive in group), frozenset({drive}))
    before, star, after = path.partition("*")
    pattern = re.compile(f"{re.escape(before)}(.*){re.escape(after)}" if star else re.escape(path))
    return tuple(
        band
        for one in reference_robots()
        if one.drive in similar
        for band in (*_numbers(one, pattern), *_errors(one, pattern))
    )


def _numbers(one: ReferenceRobot, pattern: re.Pattern[str]) -> Iterator[ReferenceBand]:
    """Yield the determined numbers of a robot whose path matches."""
    for path, number in one.numbers.items():
        if number.is_determined and (found := pattern.fullmatch(path)):
            value, interval = number.mean
            floor = "".join(found.groups())
            yield ReferenceBand(
                one.name, one.drive, floor, value, interval, number.unit, number.verdict
            )


def _errors(one: ReferenceRobot, pattern: re.Pattern[str]) -> Iterator[ReferenceBand]:
    """Yield the errors of a robot whose path matches."""
    for name, floor in one.floors.items():
        for model, error in floor.error_over_path.items():
            if pattern.fullmatch(f"{ERROR}.{name}.{model}"):
                word = "held-out" if floor.held_out else "fitted"
                yield ReferenceBand(one.name, one.drive, name, error, None, "1", word)
