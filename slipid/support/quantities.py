"""Kinds of numbers and paths in configs, layouts and maps, each with the bounds that it may have.

The bounds hold every robot, from a toy of 1 cm to a mining truck, with decades to spare. A value
beyond them is a typing error or has a different unit, and would overflow in later computations.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, get_args

from slipid.support.errors import shown

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler
    from pydantic_core import CoreSchema

LONGEST_PATH = 300
"""Largest number of characters of a path or glob in a config."""
LONGEST_NAME = 240
"""Largest number of bytes of the name of a file or folder; file systems have 255."""


@dataclass(frozen=True)
class Bounds:
    """Bounds of a number, as metadata of its type: `Annotated[float, Bounds(0.1, 1e3, "m")]`.

    Attributes:
        low: lowest value [unit].
        high: highest value [unit].
        unit: unit, for messages and the reference; empty for pure numbers.
        of_size: True if the bounds are those of the absolute value.
    """

    low: float | int
    high: float | int
    unit: str = ""
    of_size: bool = False

    def __get_pydantic_core_schema__(
        self, source: type, handler: "GetCoreSchemaHandler"
    ) -> "CoreSchema":
        """Return the schema by which pydantic checks such a number."""
        # options of the command line have bounds, too, and their help has no need of pydantic
        from pydantic_core import core_schema

        kind = int if source is int else float
        return core_schema.no_info_before_validator_function(
            lambda value: self.checked(value, kind), handler(source)
        )

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        sign = ", of either sign" if self.of_size else ""
        ends = (str(end) if isinstance(end, int) else f"{end:g}" for end in (self.low, self.high))
        return f"from {' to '.join(ends)}{unit}{sign}"

    def holds(self, value: float | int) -> bool:
        """Return True if a number is within the bounds; NaN is not."""
        return bool(self.low <= (abs(value) if self.of_size else value) <= self.high)

    def checked(self, value: Any, kind: type[int] | type[float] = float) -> float | int:
        """Return a number within the bounds; raise `ValueError` for anything else."""
        number = isinstance(value, int if kind is int else int | float)
        if number and not isinstance(value, bool) and self.holds(value):
            return kind(value)
        what = "a whole number" if kind is int else "a number"
        raise ValueError(f"{shown(value)}; expected {what} {self}")


def bounds_of(kind: object) -> Bounds | None:
    """Return the bounds in the annotation of a type, such as `Length | None`, if it has any."""
    if isinstance(kind, Bounds):
        return kind
    return next(filter(None, map(bounds_of, get_args(kind))), None)


def limits_of(kind: object) -> Bounds:
    """Return the bounds of a kind of number; raise `TypeError` if it has none."""
    bounds = bounds_of(kind)
    if bounds is None:
        raise TypeError(f"{kind} has no bounds")
    return bounds


Number = Annotated[float, Bounds(-1e12, 1e12)]
"""Number of any sign, such as the value of a parameter in SI units."""
Positive = Annotated[float, Bounds(1e-12, 1e12)]
"""Positive number, such as a standard deviation or the inertia of a rotor."""
NotNegative = Annotated[float, Bounds(0, 1e12)]
"""Positive number, or 0."""
Length = Annotated[float, Bounds(1e-4, 1e3, "m")]
"""Length of a part of a robot [m]."""
Coordinate = Annotated[float, Bounds(-1e8, 1e8, "m")]
"""Coordinate of a place on a floor, such as an easting of UTM [m]."""
Height = Annotated[float, Bounds(0, 1e4, "m")]
"""Height of a camera or a marker above the floor [m]."""
MarkerEdge = Annotated[float, Bounds(1e-4, 10, "m")]
"""Edge length of a marker [m]."""
SquareEdge = Annotated[float, Bounds(1e-4, 1, "m")]
"""Edge length of a square or a marker of a printed board [m]."""
CellLength = Annotated[float, Bounds(1e-5, 1, "m")]
"""Edge length of a cell of a map, or of a pixel on a floor [m]."""
Degrees = Annotated[float, Bounds(-3600, 3600, "deg")]
"""Angle [deg]."""
Mass = Annotated[float, Bounds(1e-6, 1e7, "kg")]
"""Mass of a robot, or of a part of it [kg]."""
Speed = Annotated[float, Bounds(1e-4, 100, "m/s")]
"""Speed of a robot [m/s]."""
Seconds = Annotated[float, Bounds(1e-6, 1e6, "s")]
"""Duration [s]."""
FrameRate = Annotated[float, Bounds(1e-5, 1e6, "frames per second")]
"""Frame rate of a video or a camera [1/s]."""
GearRatio = Annotated[float, Bounds(1e-3, 1e5)]
"""Turns of the motor per turn of the wheel [1]."""
PolePairs = Annotated[float, Bounds(1, 1000)]
"""Pole pairs of a motor, electrical turns per turn of its shaft [1]."""
TicksPerTurn = Annotated[float, Bounds(0.1, 1e9)]
"""Ticks of an encoder per turn [1]."""
Scale = Annotated[float, Bounds(1e-18, 1e18, of_size=True)]
"""Factor on the numbers of a column, of either sign [1]."""
Offset = Annotated[float, Bounds(-1e20, 1e20)]
"""Number that is added to those of a column, such as nanoseconds since 1970."""
Seed = Annotated[int, Bounds(0, 2**63 - 1)]
"""Seed of random numbers."""


@dataclass(frozen=True)
class Checked:
    """Check of a text, as metadata of its type; `check` returns the text or raises `ValueError`."""

    check: Callable[[str], str]

    def __get_pydantic_core_schema__(
        self, source: type, handler: "GetCoreSchemaHandler"
    ) -> "CoreSchema":
        """Return the schema by which pydantic checks such a text."""
        from pydantic_core import core_schema

        return core_schema.no_info_after_validator_function(self.check, handler(source))


LONGEST_LABEL = 100
"""Largest number of characters of a name in a config."""


def path_text(text: str) -> str:
    """Return a path in a config; raise `ValueError` if no file can have this path."""
    names = text.replace("\\", "/").split("/")
    if not 0 < len(text) <= LONGEST_PATH or not text.isprintable():
        raise ValueError(f"{text!r}; expected a path of 1 to {LONGEST_PATH} printable characters")
    if max(len(name.encode()) for name in names) > LONGEST_NAME:
        raise ValueError(f"{text!r}; expected names of at most {LONGEST_NAME} bytes")
    return text


def inside(text: str) -> str:
    """Return a path, or a glob, relative to a folder; raise `ValueError` if it leaves the folder.

    Links that were made inside the folder may lead elsewhere.
    """
    parts = path_text(text).replace("\\", "/").split("/")
    if parts[0] in ("", "~") or parts[0].endswith(":") or ".." in parts:
        raise ValueError(
            f"{text!r} leaves its folder; expected a path inside the folder: make a link in it, or "
            "give a higher folder (for logs, with --data)"
        )
    if set(parts) <= {"", "."}:
        raise ValueError(f"{text!r} is the folder itself; expected files inside it")
    return text


def label(text: str) -> str:
    """Return a name in a config; raise `ValueError` if it is empty, long or not printable."""
    if not 0 < len(text) <= LONGEST_LABEL or not text.isprintable():
        raise ValueError(f"{text!r}; expected a name of 1 to {LONGEST_LABEL} printable characters")
    return text


Label = Annotated[str, Checked(label)]
"""Name of a floor, load set-up, session or layout."""
PathText = Annotated[str, Checked(path_text)]
"""Path of a file, relative or absolute."""
InsidePath = Annotated[str, Checked(inside)]
"""Path of a file inside a folder, relative to it."""
