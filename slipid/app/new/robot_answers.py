"""Answers about a robot, and parsing of their texts."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import get_type_hints

from slipid.app.config import LimitsSection, Place
from slipid.support.quantities import Degrees, TicksPerTurn, limits_of

RobotOptions = Mapping[str, str]
"""Values of the command-line options that describe a robot, keyed by attribute of `RobotAnswers`.
"""


@dataclass(frozen=True)
class RobotAnswers:
    """Answers about a robot, from the user or by default; units are in the names."""

    robot: str = ""
    """Name of the reference robot that gave answers; empty without one."""
    drive: str = "omni"
    wheels: int = 3
    azimuths_deg: tuple[float, ...] = ()
    base_radius_m: float = 0.15
    wheelbase_m: float = 0.3
    track_m: float = 0.3
    shared: bool = False
    driven: str = "rear"
    encoders: int = 1
    places_m: tuple[tuple[float, ...], ...] = ()
    directions_deg: tuple[float, ...] = ()
    rollers_deg: tuple[float | None, ...] = ()
    wheel_radius_m: float = 0.05
    gear_ratio: float = 1.0
    mass_kg: float = 10.0
    ticks_per_revolution: float = 1000.0
    speed_m_s: float | None = None
    yaw_rate_rad_s: float | None = None
    acceleration_m_s2: float | None = None
    wheel_speed_rad_s: float | None = None
    voltage_v: float | None = None
    defaults: frozenset[str] = field(default_factory=frozenset)
    """Names of the attributes that have a default value because there was no answer."""


def within(kind: object) -> Callable[[str, RobotAnswers], float]:
    """Return a parser of numbers of a kind that has bounds, such as `Length`.

    Like all parsers below, it raises `ValueError` for any other answer.
    """
    return lambda text, _: number(text, kind)


def ticks(text: str, _: RobotAnswers) -> float:
    """Return the ticks per turn in an answer; 0 where no ticks are logged."""
    return 0.0 if text.strip() in ("0", "0.0") else number(text, TicksPerTurn)


FROM_LOGS = "from the logs"
"""Answer to a question about a limit that the logs are to show; an empty answer says the same."""


def limit(name: str) -> Callable[[str, RobotAnswers], float | None]:
    """Return a parser of a limit of the config; it returns None if the logs are to show it."""
    kind = get_type_hints(LimitsSection, include_extras=True)[name]
    return lambda text, _: None if text.strip() in ("", FROM_LOGS) else number(text, kind)


def number(text: str, kind: object) -> float:
    """Return the number of a kind in a string."""
    try:
        value = float(text.strip().replace("_", "?"))
    except ValueError:
        comma = " with a decimal point" if "," in text else ""
        raise ValueError(f"expected a number{comma}") from None
    bounds = limits_of(kind)
    if not bounds.holds(value):
        raise ValueError(f"expected a number {bounds}")
    return value


def count(text: str, _: RobotAnswers) -> int:
    """Return the number of wheels, from 3 to 12, in an answer."""
    if text.strip() not in map(str, range(3, 13)):
        raise ValueError("expected a whole number from 3 to 12")
    return int(text)


def axle(text: str, _: RobotAnswers) -> str:
    """Return the driven axle, rear or front, in an answer."""
    word = text.strip().lower()
    if word not in ("rear", "front"):
        raise ValueError("expected rear or front")
    return word


def one_or_two(text: str, _: RobotAnswers) -> int:
    """Return the number of encoders, 1 or 2, in an answer."""
    if text.strip() not in ("1", "2"):
        raise ValueError("expected 1 or 2")
    return int(text)


def yes(text: str, _: RobotAnswers) -> bool:
    """Return True for the answer yes and False for no."""
    word = text.strip().lower()
    if word not in ("y", "yes", "true", "n", "no", "false"):
        raise ValueError("expected yes or no")
    return word in ("y", "yes", "true")


def parts(text: str) -> list[str]:
    """Return the parts of an answer between commas or semicolons."""
    return text.replace(";", ",").split(",")


def angles(text: str, answers: RobotAnswers) -> tuple[float, ...]:
    """Return an angle for every wheel [deg] from an answer with numbers separated by commas.

    Semicolons are accepted as well.
    """
    found = tuple(number(part, Degrees) for part in parts(text))
    if len(found) != answers.wheels:
        raise ValueError(f"{len(found)} angles; expected {answers.wheels}, one per wheel")
    return found


def places(text: str, _: RobotAnswers) -> tuple[tuple[float, ...], ...]:
    """Return the centres x, y of two or more wheels [m], written like `0.2,0.1; 0.2,-0.1`."""
    found = tuple(tuple(number(c, Place) for c in part.split(",")) for part in text.split(";"))
    if len(found) < 2 or any(len(place) != 2 for place in found):
        raise ValueError("expected x, y of each wheel, as in: 0.2, 0.1; 0.2, -0.1; -0.2, 0")
    return found


def rollers(text: str, answers: RobotAnswers) -> tuple[float | None, ...]:
    """Return the roller angle of every wheel [deg] from an answer such as `45,none`.

    The angle is None for a wheel without rollers.
    """
    words = [part.strip().lower() for part in parts(text)]
    if len(words) != answers.wheels:
        raise ValueError(f"{len(words)} rollers; expected {answers.wheels}, one per wheel")
    return tuple(None if word == "none" else number(word, Degrees) for word in words)
