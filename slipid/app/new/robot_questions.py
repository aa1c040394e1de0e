"""Questions about a robot, of which the type of drive is the first."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any

from pydantic import Field

from slipid.app.config import Wheels, geometry
from slipid.app.new.from_reference import (
    OPTION,
    reference_options,
    wheeled_names,
    with_reference,
)
from slipid.app.new.robot_answers import (
    FROM_LOGS,
    RobotAnswers,
    RobotOptions,
    angles,
    axle,
    count,
    limit,
    one_or_two,
    parts,
    places,
    rollers,
    ticks,
    within,
    yes,
)
from slipid.support.errors import DataError, did_you_mean
from slipid.support.quantities import GearRatio, Length, Mass
from slipid.support.toml_file import Section, checked

Asker = Callable[[str, str, str], str]
"""Function that asks the user, and returns the answer or the default.

Its arguments are the question, the default, and a message about what was wrong with the previous
answer (empty at first).
"""


class _RobotTable(Section):
    """A config that has no more than a robot."""

    robot: Annotated[Wheels, Field(discriminator="drive")]


@dataclass(frozen=True)
class RobotQuestion:
    """One question about a robot.

    Attributes:
        name: name of the option, and of the attribute of `RobotAnswers`, for the answer.
        text: text of the question.
        default: default answer, or a function that returns it from the earlier answers.
        read: function that parses an answer; its `ValueError` says what is expected.
    """

    name: str
    text: str
    default: str | Callable[[RobotAnswers], str]
    read: Callable[[str, RobotAnswers], Any]

    @property
    def option(self) -> str:
        """Return the command-line option that answers the question."""
        return "--" + self.name.replace("_", "-")


def _drive(text: str, _: RobotAnswers) -> str:
    word = text.strip().lower()
    if word == "motor":
        raise ValueError("a motor on a bench needs no config; expected its log: slipid motor FILE")
    if word not in DRIVES:
        raise ValueError(
            f"no such drive{did_you_mean(word, DRIVES)}; expected one of {', '.join(DRIVES)}"
        )
    return word


def _drive_or_robot(text: str, answers: RobotAnswers) -> str:
    return word if (word := text.strip().lower()) in wheeled_names() else _drive(text, answers)


def _even_azimuths(answers: RobotAnswers) -> str:
    """Return the azimuths [deg] of evenly spread wheels, none straight ahead, as an answer."""
    return ", ".join(f"{(k + 0.5) * 360 / answers.wheels:g}" for k in range(answers.wheels))


def _per_wheel(text: str) -> Callable[[RobotAnswers], str]:
    return lambda answers: ", ".join([text] * answers.wheels)


DRIVE = RobotQuestion(
    "drive",
    "drive: omni (wheels with rollers, around the middle), mecanum (four, tilted rollers),\n"
    "  skid (four ordinary wheels), differential (two and casters),\n"
    "  steered (bicycle, tricycle, car), general (any wheels)",
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
_BASE = RobotQuestion(
    "base_radius_m", "from the middle to the wheel centres [m]", "0.15", within(Length)
)
_WHEELBASE = RobotQuestion(
    "wheelbase_m", "wheelbase, front to rear axle [m]", "0.3", within(Length)
)
_TRACK = RobotQuestion(
    "track_m", "track, between the middles of left and right wheels [m]", "0.3", within(Length)
)
_SHARED = RobotQuestion(
    "shared", "does one motor turn both wheels of a side (yes or no)", "no", yes
)
_DRIVEN = RobotQuestion("driven", "axle with the encoders, rear or front", "rear", axle)
_ENCODERS = RobotQuestion("encoders", "number of encoders on this axle, 1 or 2", "1", one_or_two)
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
    "angles from the free-rolling direction of the rollers to these directions [deg], or none",
    _per_wheel("none"),
    rollers,
)
COMMON = (
    RobotQuestion("wheel_radius_m", "wheel radius [m]", "0.05", within(Length)),
    RobotQuestion("gear_ratio", "motor turns per wheel turn", "1", within(GearRatio)),
    RobotQuestion("mass_kg", "mass of the robot [kg]", "10", within(Mass)),
    RobotQuestion(
        "ticks_per_revolution",
        "encoder ticks per motor turn (0: no ticks are logged)",
        "1000",
        ticks,
    ),
)
LIMITS = (
    RobotQuestion(
        "speed_m_s", "highest speed a controller may demand [m/s]", FROM_LOGS, limit("speed_m_s")
    ),
    RobotQuestion(
        "yaw_rate_rad_s",
        "highest yaw rate it may demand [rad/s]",
        FROM_LOGS,
        limit("yaw_rate_rad_s"),
    ),
    RobotQuestion(
        "acceleration_m_s2",
        "highest acceleration of a wheel's rim [m/s^2]",
        FROM_LOGS,
        limit("acceleration_m_s2"),
    ),
    RobotQuestion(
        "wheel_speed_rad_s",
        "highest speed of a wheel [rad/s]",
        FROM_LOGS,
        limit("wheel_speed_rad_s"),
    ),
    RobotQuestion("voltage_v", "voltage of the supply [V]", FROM_LOGS, limit("voltage_v")),
)
"""Questions about the limits of a controller, asked last; wheels that are steered have none."""
_OPTIONAL = frozenset(question.name for question in (_WHEELS, *LIMITS))
"""Names of the questions that need no answer where options answer all others."""
DRIVES: dict[str, tuple[RobotQuestion, ...]] = {
    "omni": (_WHEELS, _AZIMUTHS, _BASE),
    "mecanum": (_WHEELBASE, _TRACK, _SHARED),
    "skid": (_WHEELBASE, _TRACK, _SHARED),
    "differential": (_TRACK,),
    "steered": (_WHEELBASE, _DRIVEN, _ENCODERS),
    "general": (_PLACES, _DIRECTIONS, _ROLLERS),
}
"""Questions for each type of drive, in the order in which they are asked; those in `COMMON`, for
all types, are asked after them."""


def ask(options: RobotOptions, asker: Asker | None, drive: str = "omni") -> RobotAnswers:
    """Return all answers about a robot.

    Each answer comes from an option, else from the user, else it is the default.

    Args:
        options: answers given on the command line.
        asker: function that asks the user, again after a wrong answer; None to use the defaults.
        drive: default type of drive.

    Raises:
        DataError: an option is not a valid answer, or belongs to another type of drive.
    """
    options = with_reference(options)
    answers = RobotAnswers(robot=options.get(OPTION, ""), drive=drive)
    answers = _with_question(answers, replace(_asked_drive(options), default=drive), options, asker)
    suggested: RobotOptions = {}
    if answers.drive not in DRIVES:
        suggested = reference_options(answers.drive)
        answers = replace(answers, robot=answers.drive, drive=suggested["drive"])
    counts = {"mecanum": 4, "skid": 4, "differential": 2}
    answers = replace(answers, wheels=counts.get(answers.drive, answers.wheels))
    limits = () if answers.drive == "steered" else LIMITS
    questions = (*DRIVES[answers.drive], *COMMON, *limits)
    _refuse_other_drives(options, answers.drive, questions)
    if options.keys() >= {question.name for question in (DRIVE, *questions)} - _OPTIONAL:
        asker = None  # options alone describe the robot, and the logs show its limits
    for question in questions:
        if question is _WHEELS and "azimuths_deg" in options and "wheels" not in options:
            answers = replace(answers, wheels=len(parts(options["azimuths_deg"])))
            continue
        default = suggested.get(question.name)
        answers = _with_question(answers, question, options, asker, default)
        if question is _PLACES:
            answers = replace(answers, wheels=len(answers.places_m))
    return answers


def _asked_drive(options: RobotOptions) -> RobotQuestion:
    """Return the question about the drive; a reference robot answers it as well, if it is asked."""
    if "drive" in options:
        return DRIVE
    names = ", ".join(wheeled_names())
    return replace(
        DRIVE, text=f"{DRIVE.text},\n  or a robot to start from: {names}", read=_drive_or_robot
    )


def _refuse_other_drives(
    options: RobotOptions, drive: str, questions: tuple[RobotQuestion, ...]
) -> None:
    """Raise `DataError` for an option that this type of drive would ignore."""
    for name in options.keys() - {OPTION, "drive", *(question.name for question in questions)}:
        expected = ", ".join(question.option for question in questions)
        raise DataError(
            f"--{name.replace('_', '-')}: not an option for drive {drive}; known: {expected}"
        )


def _with_question(
    answers: RobotAnswers,
    question: RobotQuestion,
    options: RobotOptions,
    asker: Asker | None,
    default: str | None = None,
) -> RobotAnswers:
    """Return the answers, with the answer to one more question added.

    The answer comes from the options; else from `asker`, which is called until the answer is valid;
    or it is the default if `asker` is None. `default` replaces the default of the question.
    """

    def read(text: str) -> RobotAnswers:
        more: dict[str, Any] = {question.name: question.read(text, answers)}
        return replace(answers, **more)

    if (text := options.get(question.name)) is not None:
        try:
            return read(text)
        except ValueError as error:
            raise DataError(f"{question.option} '{text}': {error}") from None
    if default is None:
        usual = question.default
        default = usual if isinstance(usual, str) else usual(answers)
    if asker is None:
        answers = replace(answers, defaults=answers.defaults | {question.name})
        return read(default)
    wrong = ""
    while True:
        text = asker(question.text, default, wrong)
        try:
            return read(text)
        except ValueError as error:
            wrong = f"'{text}': {error}"


def robot_of(answers: RobotAnswers) -> Wheels:
    """Return the section `[robot]`; raise `DataError` if the answers describe no possible robot."""
    own: dict[str, object]
    if answers.drive == "omni":
        own = {"wheel_azimuths_deg": answers.azimuths_deg, "base_radius_m": answers.base_radius_m}
    elif answers.drive == "differential":
        own = {"track_m": answers.track_m}
    elif answers.drive == "steered":
        own = {key: getattr(answers, key) for key in ("wheelbase_m", "driven", "encoders")}
    elif answers.drive == "general":
        own = {
            "wheel_places_m": answers.places_m,
            "drive_directions_deg": answers.directions_deg,
            "roller_angles_deg": ["none" if a is None else a for a in answers.rollers_deg],
        }
    else:
        own = {"half_length_m": answers.wheelbase_m / 2, "half_width_m": answers.track_m / 2}
        own |= {"drives": [[1, 3], [2, 4]]} if answers.shared else {}
    for key in ("drive", "wheel_radius_m", "gear_ratio", "mass_kg"):
        own[key] = getattr(answers, key)
    own["limits"] = {question.name: getattr(answers, question.name) for question in LIMITS}
    robot = checked(f"drive {answers.drive}", {"robot": own}, _RobotTable).robot
    try:
        geometry(robot)
    except ValueError as error:
        raise DataError(f"drive {answers.drive}: {error}") from None
    return robot
