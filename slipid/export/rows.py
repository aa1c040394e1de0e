"""The numbers of an identified robot one by one, with all that is known of each.

Sentences on the origin of a controller's gains and limits.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from slipid.export.text import one_line
from slipid.parameter import Entry
from slipid.robot.deployed import DeployedRobot
from slipid.robot.record import RecordedNumber
from slipid.robot.record import Pair
from slipid.robot.record import Provenance
from slipid.robot.record import Verdict
from slipid.robot.robot_file import declared_numbers

VERDICTS: Mapping[Verdict, str] = {
    "identified": "the logs decide it; use it",
    "weak": "the logs narrow it, yet what was assumed before still counts: mind its interval",
    "disputed": "floors disagree about it: use it where it was seen, and not beyond",
    "not_identified": "the logs say next to nothing of it: the value is what was assumed before, "
    "no measurement. Do not build on it without measuring it otherwise",
    "at_bound": "the logs push it to an end of what is possible: the value is that end. The model, "
    "or a number that was held fixed, may be wrong",
    "fixed": "it was given and not fitted: as good as who gave it",
}
PROVENANCES: Mapping[Provenance, str] = {
    "measured": "the logs decide",
    "borrowed": "what was assumed before decides: a default, a data sheet, a prior",
    "override": "it was held at a chosen value",
}
WARNED_VERDICTS: tuple[Verdict, ...] = ("not_identified", "at_bound", "disputed")
"""Verdicts of numbers of which a user must be warned."""


@dataclass(frozen=True)
class NumberRow:
    """One number of a robot.

    Attributes:
        path: of robot.json; entry: "wheel 2", empty for a number of the whole robot.
        symbol, about: as equations and people call it.
        value: [unit]; interval90: equal-tailed, None where it was fixed.
    """

    path: str
    entry: str
    symbol: str
    about: str
    unit: str
    value: float
    interval90: Pair | None
    verdict: Verdict
    provenance: Provenance

    @property
    def name(self) -> str:
        """Path and entry together."""
        return f"{self.path}, {self.entry}" if self.entry else self.path

    @property
    def verdict_text(self) -> str:
        """The verdict as people read it."""
        return verdict_text(self.verdict)


def verdict_text(verdict: Verdict) -> str:
    """A verdict as people read it, in capitals where they must be warned."""
    words = verdict.replace("_", " ")
    return words.upper() if verdict in WARNED_VERDICTS else words


def values_of(number: RecordedNumber) -> tuple[float, ...]:
    """Its values, one or as many as wheels."""
    return number.value if isinstance(number.value, tuple) else (number.value,)


def number_rows(robot: DeployedRobot) -> tuple[NumberRow, ...]:
    """Every number of a robot, those per wheel one by one."""
    known = robot.record.parameters
    numbers = declared_numbers(robot.record)
    return tuple(row for e in numbers for row in _of_entry(e, known[e.path]))


def paths_with_verdict(robot: DeployedRobot, verdict: Verdict) -> tuple[str, ...]:
    """Paths of the numbers with a verdict."""
    known = robot.record.parameters
    numbers = declared_numbers(robot.record)
    return tuple(e.path for e in numbers if known[e.path].verdict == verdict)


def _of_entry(e: Entry, number: RecordedNumber) -> tuple[NumberRow, ...]:
    ends = np.reshape([] if number.interval90 is None else number.interval90, (-1, 2))
    d, rows = e.declaration, []
    for k, value in enumerate(values_of(number)):
        pair = (float(ends[k][0]), float(ends[k][1])) if len(ends) else None
        name = f"wheel {k + 1}" if isinstance(number.value, tuple) else ""
        about, sure = (d.symbol, d.doc, d.unit), (number.verdict, number.provenance)
        rows.append(NumberRow(e.path, name, *about, value, pair, *sure))
    return tuple(rows)


LIMITS: Mapping[str, tuple[str, str]] = {
    "wheel_speed": ("rad/s", "largest speed of a wheel"),
    "acceleration": ("rad/s^2", "largest change of a wheel's speed"),
    "voltage": ("V", "of the supply"),
    "twist": ("m/s", "largest speed asked of the body"),
}
"""Unit and meaning of every field of `slipid.robot.controller.Limits`."""


def gains_origin(robot: DeployedRobot) -> str:
    """Where the gains of a robot come from, and that limits were not identified, as sentences."""
    limits = "Limits are the defaults of slipid: put in those of your motors and supply."
    tuned = robot.record.gains
    if tuned is None:
        return f"Gains set by hand. {limits}"
    if tuned.load != robot.load_setup:
        load = one_line(tuned.load)
        return f"Gains set by hand; those tuned are for the load set-up {load}. {limits}"
    if not tuned.is_better:
        return f"Gains set by hand; those tuned are {tuned.verdict}. {limits}"
    loss = f"loss {tuned.loss.tuned:.1f} mm, by hand {tuned.loss.hand:.1f} mm"
    gyro = "with a gyro" if tuned.gyro else "without a gyro"
    return f"Gains tuned on the twin {gyro}: better than by hand in rehearsals ({loss}). {limits}"
