"""What is asked about a robot: its drive first, then only what that drive needs."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

from slipid.job.config import Box, Differential, General, Omni, Wheels, geometry
from slipid.job.new.answers import (
    Answers,
    Told,
    angles,
    count,
    not_negative,
    places,
    positive,
    rollers,
    yes,
)
from slipid.support.errors import DataError, near

Asker = Callable[[str, str, str], str]
"""Asks people: what is asked, what stands there if they say nothing, and what was wrong with the
last answer; returns their answer, or the default."""


@dataclass(frozen=True)
class Question:
    """One thing to know.

    Attributes:
        about: attribute of `Told` and `Answers`.
        asks: what people are asked.
        default: what stands there if nobody says, given what is known so far.
        read: from a text to the value; ValueError says what was expected.
    """

    about: str
    asks: str
    default: Callable[[Answers], str]
    read: Callable[[str, Answers], Any]

    @property
    def option(self) -> str:
        """How it is said on the command line."""
        return "--" + self.about.replace("_", "-")


def _drive(text: str, _: Answers) -> str:
    word = text.strip().lower()
    if word == "motor":
        raise ValueError("a motor on a bench needs no config; expected its log: slipid motor FILE")
    if word not in DRIVES:
        raise ValueError(f"no such drive{near(word, DRIVES)}; expected one of {', '.join(DRIVES)}")
    return word


def _evenly(known: Answers) -> str:
    """Azimuths of wheels evenly around, none straight ahead."""
    return ", ".join(f"{(k + 0.5) * 360 / known.wheels:g}" for k in range(known.wheels))


def _always(text: str) -> Callable[[Answers], str]:
    return lambda _: text


def _each(text: str) -> Callable[[Answers], str]:
    return lambda known: ", ".join([text] * known.wheels)


DRIVE = Question(
    "drive",
    "drive: omni (wheels with rollers, around the middle), mecanum (four, tilted rollers),\n"
    "  skid (four ordinary wheels), differential (two and casters), general (any wheels)",
    _always("omni"),
    _drive,
)
_WHEELS = Question("wheels", "number of wheels", _always("3"), count)
_AZIMUTHS = Question(
    "azimuths_deg",
    "where the wheels stand, counter-clockwise from ahead, in the order of your columns [deg]",
    _evenly,
    angles,
)
_BASE = Question(
    "base_radius_m", "from the middle to the wheel centres [m]", _always("0.15"), positive
)
_WHEELBASE = Question("wheelbase_m", "wheelbase, front to rear axle [m]", _always("0.3"), positive)
_TRACK = Question(
    "track_m", "track, between the middles of left and right wheels [m]", _always("0.3"), positive
)
_SHARED = Question(
    "shared", "does one motor turn both wheels of a side (yes or no)", _always("no"), yes
)
_PLACES = Question(
    "places_m",
    "centres of the wheels, x ahead and y left: x, y; x, y; ... [m]",
    _always("0.2, 0.15; 0.2, -0.15; -0.2, 0"),
    places,
)
_DIRECTIONS = Question(
    "directions_deg", "directions in which the wheels roll, from ahead [deg]", _each("0"), angles
)
_ROLLERS = Question(
    "rollers_deg",
    "angles of the rollers to them [deg], none without rollers",
    _each("none"),
    rollers,
)
COMMON = (
    Question("wheel_radius_m", "wheel radius [m]", _always("0.05"), positive),
    Question("gear_ratio", "motor turns per wheel turn", _always("1"), positive),
    Question("mass_kg", "mass of the robot [kg]", _always("10"), positive),
    Question(
        "ticks_per_revolution",
        "encoder ticks per motor turn (0: no ticks are logged)",
        _always("1000"),
        not_negative,
    ),
)
DRIVES: dict[str, tuple[Question, ...]] = {
    "omni": (_WHEELS, _AZIMUTHS, _BASE),
    "mecanum": (_WHEELBASE, _TRACK, _SHARED),
    "skid": (_WHEELBASE, _TRACK, _SHARED),
    "differential": (_TRACK,),
    "general": (_PLACES, _DIRECTIONS, _ROLLERS),
}
"""What each drive needs to be asked, in this order; COMMON comes after it."""


def ask(told: Told, asker: Asker | None, drive: str = "omni") -> Answers:
    """Everything the drive needs: as told, else asked for, else a default.

    Args:
        told: what needs no question.
        asker: asks people, again where an answer is wrong; None takes defaults.
        drive: taken where nobody says which.

    Raises:
        DataError: something told is no answer to its question, or belongs to another drive.
    """
    known = _answered(Answers(drive=drive), replace(DRIVE, default=_always(drive)), told, asker)
    questions = (*DRIVES[known.drive], *COMMON)
    _belongs(told, known.drive, questions)
    for question in questions:
        if question is _WHEELS and told.azimuths_deg is not None and told.wheels is None:
            known = replace(known, wheels=len(told.azimuths_deg.replace(";", ",").split(",")))
            continue
        known = _answered(known, question, told, asker)
        if question is _PLACES:
            known = replace(known, wheels=len(known.places_m))
    if known.drive in ("mecanum", "skid"):
        known = replace(known, wheels=4)
    return replace(known, wheels=2) if known.drive == "differential" else known


def _belongs(told: Told, drive: str, questions: tuple[Question, ...]) -> None:
    """Refuse what this drive is not asked for: it would be lost without a word."""
    wanted = {"drive", *(question.about for question in questions)}
    for one in fields(told):
        if getattr(told, one.name) is not None and one.name not in wanted:
            options = ", ".join(question.option for question in questions)
            raise DataError(
                f"--{one.name.replace('_', '-')}: not of drive {drive}; expected some of {options}"
            )


def _answered(known: Answers, question: Question, told: Told, asker: Asker | None) -> Answers:
    """What is known with the answer to one more question."""
    text = getattr(told, question.about)
    if text is not None:
        try:
            return _with(known, question, text)
        except ValueError as error:
            raise DataError(f"{question.option} '{text}': {error}") from None
    default = question.default(known)
    if asker is None:
        known = replace(known, taken=known.taken | {question.about})
        return _with(known, question, default)
    wrong = ""
    while True:
        text = asker(question.asks, default, wrong)
        try:
            return _with(known, question, text)
        except ValueError as error:
            wrong = f"'{text}': {error}"


def _with(known: Answers, question: Question, text: str) -> Answers:
    """What is known with a text as the answer to a question; ValueError where it is none."""
    more: dict[str, Any] = {question.about: question.read(text, known)}
    return replace(known, **more)


def robot_of(known: Answers) -> Wheels:
    """The `[robot]` section; DataError where the answers make no robot."""
    sizes = {
        "drive": known.drive,
        "wheel_radius_m": known.wheel_radius_m,
        "gear_ratio": known.gear_ratio,
        "mass_kg": known.mass_kg,
    }
    try:
        robot = _model(known, sizes)
        geometry(robot)
    except ValueError as error:
        raise DataError(f"drive {known.drive}: {error}") from None
    return robot


def _model(known: Answers, sizes: dict[str, object]) -> Wheels:
    if known.drive == "omni":
        azimuths = list(known.azimuths_deg)
        own = {"wheel_azimuths_deg": azimuths, "base_radius_m": known.base_radius_m}
        return Omni.model_validate({**sizes, **own})
    if known.drive == "differential":
        return Differential.model_validate({**sizes, "track_m": known.track_m})
    if known.drive == "general":
        rollers = ["none" if angle is None else angle for angle in known.rollers_deg]
        own = {
            "wheel_places_m": [list(place) for place in known.places_m],
            "drive_directions_deg": list(known.directions_deg),
        }
        return General.model_validate({**sizes, **own, "roller_angles_deg": rollers})
    half = {"half_length_m": known.wheelbase_m / 2, "half_width_m": known.track_m / 2}
    shared = {"drives": [[1, 3], [2, 4]]} if known.shared else {}
    return Box.model_validate({**sizes, **half, **shared})
