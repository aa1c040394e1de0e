"""What is asked about a robot, its drive first, and how texts are read as answers."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

from slipid.app.config import (
    DifferentialDrive,
    FourWheelDrive,
    GeneralDrive,
    OmniDrive,
    Wheels,
    geometry,
)
from slipid.support.errors import DataError, did_you_mean

Asker = Callable[[str, str, str], str]
"""Asks people: what is asked, what stands there if they say nothing, and what was wrong with the
last answer; returns their answer, or the default."""


@dataclass(frozen=True, kw_only=True)
class RobotOptions:
    """Options that describe a robot beforehand, as text; None where they are not given."""

    drive: str | None = None
    wheels: str | None = None
    azimuths_deg: str | None = None
    base_radius_m: str | None = None
    wheelbase_m: str | None = None
    track_m: str | None = None
    shared: str | None = None
    places_m: str | None = None
    directions_deg: str | None = None
    rollers_deg: str | None = None
    wheel_radius_m: str | None = None
    gear_ratio: str | None = None
    mass_kg: str | None = None
    ticks_per_revolution: str | None = None


@dataclass(frozen=True)
class RobotAnswers:
    """What is known of a robot, said or taken by default."""

    drive: str = "omni"
    wheels: int = 3
    azimuths_deg: tuple[float, ...] = ()
    base_radius_m: float = 0.15
    wheelbase_m: float = 0.3
    track_m: float = 0.3
    shared: bool = False
    places_m: tuple[tuple[float, ...], ...] = ()
    directions_deg: tuple[float, ...] = ()
    rollers_deg: tuple[float | None, ...] = ()
    wheel_radius_m: float = 0.05
    gear_ratio: float = 1.0
    mass_kg: float = 10.0
    ticks_per_revolution: float = 1000.0
    taken: frozenset[str] = field(default_factory=frozenset)
    """What nobody said: a default stands there."""


def positive(text: str, _: RobotAnswers) -> float:
    """A number above 0; this and the others: ValueError where the text is something else."""
    value = number(text)
    if not 0 < value < float("inf"):
        raise ValueError("expected a number above 0")
    return value


def not_negative(text: str, _: RobotAnswers) -> float:
    """A number above 0, or 0."""
    value = number(text)
    if not 0 <= value < float("inf"):
        raise ValueError("expected a number above 0, or 0 where there is none")
    return value


def number(text: str) -> float:
    """Any number."""
    try:
        return float(text.strip().replace("_", "?"))
    except ValueError:
        comma = " with a decimal point" if "," in text else ""
        raise ValueError(f"expected a number{comma}") from None


def count(text: str, _: RobotAnswers) -> int:
    """A number of wheels."""
    if not text.strip().isdecimal() or not 3 <= int(text) <= 12:
        raise ValueError("expected a whole number from 3 to 12")
    return int(text)


def yes(text: str, _: RobotAnswers) -> bool:
    """Yes or no."""
    word = text.strip().lower()
    if word not in ("y", "yes", "true", "n", "no", "false"):
        raise ValueError("expected yes or no")
    return word in ("y", "yes", "true")


def angles(text: str, known: RobotAnswers) -> tuple[float, ...]:
    """An angle for every wheel [deg]."""
    found = tuple(number(part) for part in text.replace(";", ",").split(","))
    if len(found) != known.wheels:
        raise ValueError(f"{len(found)} angles; expected {known.wheels}, one per wheel")
    return found


def places(text: str, _: RobotAnswers) -> tuple[tuple[float, ...], ...]:
    """Places of at least two wheels [m]."""
    found = tuple(tuple(number(c) for c in part.split(",")) for part in text.split(";"))
    if len(found) < 2 or any(len(place) != 2 for place in found):
        raise ValueError("expected x, y of each wheel, as in: 0.2, 0.1; 0.2, -0.1; -0.2, 0")
    return found


def rollers(text: str, known: RobotAnswers) -> tuple[float | None, ...]:
    """Angle of the rollers of every wheel [deg], None of those without."""
    words = [part.strip().lower() for part in text.replace(";", ",").split(",")]
    if len(words) != known.wheels:
        raise ValueError(f"{len(words)} rollers; expected {known.wheels}, one per wheel")
    return tuple(None if word == "none" else number(word) for word in words)


@dataclass(frozen=True)
class RobotQuestion:
    """One thing to know.

    Attributes:
        about: attribute of `Told` and `Answers`.
        asks: what people are asked.
        default: answer if nobody gives another, perhaps by what is known so far.
        read: from a text to the value; ValueError says what was expected.
    """

    about: str
    asks: str
    default: str | Callable[[RobotAnswers], str]
    read: Callable[[str, RobotAnswers], Any]

    @property
    def option(self) -> str:
        """How it is said on the command line."""
        return "--" + self.about.replace("_", "-")


def _drive(text: str, _: RobotAnswers) -> str:
    word = text.strip().lower()
    if word == "motor":
        raise ValueError("a motor on a bench needs no config; expected its log: slipid motor FILE")
    if word not in DRIVES:
        raise ValueError(
            f"no such drive{did_you_mean(word, DRIVES)}; expected one of {', '.join(DRIVES)}"
        )
    return word


def _even_azimuths(known: RobotAnswers) -> str:
    """Azimuths of wheels evenly around, none straight ahead."""
    return ", ".join(f"{(k + 0.5) * 360 / known.wheels:g}" for k in range(known.wheels))


def _per_wheel(text: str) -> Callable[[RobotAnswers], str]:
    return lambda known: ", ".join([text] * known.wheels)


DRIVE = RobotQuestion(
    "drive",
    "drive: omni (wheels with rollers, around the middle), mecanum (four, tilted rollers),\n"
    "  skid (four ordinary wheels), differential (two and casters), general (any wheels)",
    "omni",
    _drive,
)
_WHEELS = RobotQuestion("wheels", "number of wheels", "3", count)
_AZIMUTHS = RobotQuestion(
    "azimuths_deg",
    "where the wheels stand, counter-clockwise from ahead, in the order of your columns [deg]",
    _even_azimuths,
    angles,
)
_BASE = RobotQuestion("base_radius_m", "from the middle to the wheel centres [m]", "0.15", positive)
_WHEELBASE = RobotQuestion("wheelbase_m", "wheelbase, front to rear axle [m]", "0.3", positive)
_TRACK = RobotQuestion(
    "track_m", "track, between the middles of left and right wheels [m]", "0.3", positive
)
_SHARED = RobotQuestion(
    "shared", "does one motor turn both wheels of a side (yes or no)", "no", yes
)
_PLACES = RobotQuestion(
    "places_m",
    "centres of the wheels, x ahead and y left: x, y; x, y; ... [m]",
    "0.2, 0.15; 0.2, -0.15; -0.2, 0",
    places,
)
_DIRECTIONS = RobotQuestion(
    "directions_deg",
    "directions in which the wheels roll, from ahead [deg]",
    _per_wheel("0"),
    angles,
)
_ROLLERS = RobotQuestion(
    "rollers_deg",
    "angles of the rollers to them [deg], none without rollers",
    _per_wheel("none"),
    rollers,
)
COMMON = (
    RobotQuestion("wheel_radius_m", "wheel radius [m]", "0.05", positive),
    RobotQuestion("gear_ratio", "motor turns per wheel turn", "1", positive),
    RobotQuestion("mass_kg", "mass of the robot [kg]", "10", positive),
    RobotQuestion(
        "ticks_per_revolution",
        "encoder ticks per motor turn (0: no ticks are logged)",
        "1000",
        not_negative,
    ),
)
DRIVES: dict[str, tuple[RobotQuestion, ...]] = {
    "omni": (_WHEELS, _AZIMUTHS, _BASE),
    "mecanum": (_WHEELBASE, _TRACK, _SHARED),
    "skid": (_WHEELBASE, _TRACK, _SHARED),
    "differential": (_TRACK,),
    "general": (_PLACES, _DIRECTIONS, _ROLLERS),
}
"""What each drive needs to be asked, in this order; COMMON comes after it."""


def ask(options: RobotOptions, asker: Asker | None, drive: str = "omni") -> RobotAnswers:
    """Everything the drive needs: from an option, else asked for, else a default.

    Args:
        options: what needs no question.
        asker: asks people, again where an answer is wrong; None takes defaults.
        drive: taken where nobody says which.

    Raises:
        DataError: an option is no answer to its question, or belongs to another drive.
    """
    known = _with_question(RobotAnswers(drive=drive), replace(DRIVE, default=drive), options, asker)
    questions = (*DRIVES[known.drive], *COMMON)
    _refuse_other_drives(options, known.drive, questions)
    for question in questions:
        if question is _WHEELS and options.azimuths_deg is not None and options.wheels is None:
            known = replace(known, wheels=len(options.azimuths_deg.replace(";", ",").split(",")))
            continue
        known = _with_question(known, question, options, asker)
        if question is _PLACES:
            known = replace(known, wheels=len(known.places_m))
    if known.drive in ("mecanum", "skid"):
        known = replace(known, wheels=4)
    return replace(known, wheels=2) if known.drive == "differential" else known


def _refuse_other_drives(
    options: RobotOptions, drive: str, questions: tuple[RobotQuestion, ...]
) -> None:
    """Refuse what this drive is not asked for: it would be lost without a word."""
    wanted = {"drive", *(question.about for question in questions)}
    for one in fields(options):
        if getattr(options, one.name) is not None and one.name not in wanted:
            expected = ", ".join(question.option for question in questions)
            raise DataError(
                f"--{one.name.replace('_', '-')}: not of drive {drive}; expected some of {expected}"
            )


def _with_question(
    known: RobotAnswers, question: RobotQuestion, options: RobotOptions, asker: Asker | None
) -> RobotAnswers:
    """What is known with the answer to one more question."""
    text = getattr(options, question.about)
    if text is not None:
        try:
            return _with_answer(known, question, text)
        except ValueError as error:
            raise DataError(f"{question.option} '{text}': {error}") from None
    default = question.default if isinstance(question.default, str) else question.default(known)
    if asker is None:
        known = replace(known, taken=known.taken | {question.about})
        return _with_answer(known, question, default)
    wrong = ""
    while True:
        text = asker(question.asks, default, wrong)
        try:
            return _with_answer(known, question, text)
        except ValueError as error:
            wrong = f"'{text}': {error}"


def _with_answer(known: RobotAnswers, question: RobotQuestion, text: str) -> RobotAnswers:
    """What is known with a text as the answer to a question; ValueError where it is none."""
    more: dict[str, Any] = {question.about: question.read(text, known)}
    return replace(known, **more)


def robot_of(known: RobotAnswers) -> Wheels:
    """The `[robot]` section; DataError where the answers make no robot."""
    sizes = {
        "drive": known.drive,
        "wheel_radius_m": known.wheel_radius_m,
        "gear_ratio": known.gear_ratio,
        "mass_kg": known.mass_kg,
    }
    try:
        robot = _section(known, sizes)
        geometry(robot)
    except ValueError as error:
        raise DataError(f"drive {known.drive}: {error}") from None
    return robot


def _section(known: RobotAnswers, sizes: dict[str, object]) -> Wheels:
    if known.drive == "omni":
        azimuths = list(known.azimuths_deg)
        own = {"wheel_azimuths_deg": azimuths, "base_radius_m": known.base_radius_m}
        return OmniDrive.model_validate({**sizes, **own})
    if known.drive == "differential":
        return DifferentialDrive.model_validate({**sizes, "track_m": known.track_m})
    if known.drive == "general":
        rollers = ["none" if angle is None else angle for angle in known.rollers_deg]
        own = {
            "wheel_places_m": [list(place) for place in known.places_m],
            "drive_directions_deg": list(known.directions_deg),
        }
        return GeneralDrive.model_validate({**sizes, **own, "roller_angles_deg": rollers})
    half = {"half_length_m": known.wheelbase_m / 2, "half_width_m": known.track_m / 2}
    shared = {"drives": [[1, 3], [2, 4]]} if known.shared else {}
    return FourWheelDrive.model_validate({**sizes, **half, **shared})
