"""What is known of a robot that is being described, and how texts are read into it."""

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class Told:
    """What was said of a robot beforehand, as text; None where it was not."""

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
class Answers:
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


def positive(text: str, _: Answers) -> float:
    """A number above 0; this and the others: ValueError where the text is something else."""
    value = number(text)
    if not 0 < value < float("inf"):
        raise ValueError("expected a number above 0")
    return value


def not_negative(text: str, _: Answers) -> float:
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


def count(text: str, _: Answers) -> int:
    """A number of wheels."""
    if not text.strip().isdecimal() or not 3 <= int(text) <= 12:
        raise ValueError("expected a whole number from 3 to 12")
    return int(text)


def yes(text: str, _: Answers) -> bool:
    """Yes or no."""
    word = text.strip().lower()
    if word not in ("y", "yes", "true", "n", "no", "false"):
        raise ValueError("expected yes or no")
    return word in ("y", "yes", "true")


def angles(text: str, known: Answers) -> tuple[float, ...]:
    """An angle for every wheel [deg]."""
    found = tuple(number(part) for part in text.replace(";", ",").split(","))
    if len(found) != known.wheels:
        raise ValueError(f"{len(found)} angles; expected {known.wheels}, one per wheel")
    return found


def places(text: str, _: Answers) -> tuple[tuple[float, ...], ...]:
    """Places of at least two wheels [m]."""
    found = tuple(tuple(number(c) for c in part.split(",")) for part in text.split(";"))
    if len(found) < 2 or any(len(place) != 2 for place in found):
        raise ValueError("expected x, y of each wheel, as in: 0.2, 0.1; 0.2, -0.1; -0.2, 0")
    return found


def rollers(text: str, known: Answers) -> tuple[float | None, ...]:
    """Angle of the rollers of every wheel [deg], None of those without."""
    words = [part.strip().lower() for part in text.replace(";", ",").split(",")]
    if len(words) != known.wheels:
        raise ValueError(f"{len(words)} rollers; expected {known.wheels}, one per wheel")
    return tuple(None if word == "none" else number(word) for word in words)
