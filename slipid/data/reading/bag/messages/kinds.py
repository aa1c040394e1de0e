"""What a message is made of: its fields, resolved down to numbers and texts."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Union

Kind = Union["Number", "Text", "Many", "Message"]
"""Of a field: one number, one text, several of a kind, or a message of its own."""


@dataclass(frozen=True)
class Number:
    """A number: its numpy type without byte order, such as `f8`."""

    dtype: str

    @property
    def size(self) -> int:
        """Bytes that it takes."""
        return int(self.dtype[1:])


@dataclass(frozen=True)
class Text:
    """A text in UTF-8."""


@dataclass(frozen=True)
class Many:
    """Several of a kind: `count` of them, or None where each message says how many."""

    element: Kind
    count: int | None


@dataclass(frozen=True)
class Field:
    """A field of a message by name."""

    name: str
    kind: Kind


@dataclass(frozen=True)
class Message:
    """A type of message: its name, as `sensor_msgs/msg/Imu`, and its fields in order."""

    name: str
    fields: tuple[Field, ...]

    @property
    def paths(self) -> dict[str, str]:
        """Dotted path of every number and text in it, and what is there: `float64[]`, `text`."""
        return dict(_below(self, ""))


def _below(kind: Kind, path: str) -> Iterator[tuple[str, str]]:
    """Paths at and below a field."""
    if isinstance(kind, Number):
        yield path, _NAMES.get(kind.dtype, kind.dtype)
    elif isinstance(kind, Text):
        yield path, "text"
    elif isinstance(kind, Many):
        count = "" if kind.count is None else str(kind.count)
        for below, what in _below(kind.element, path):
            # arrays in messages of an array: the brackets stand behind the name of the number
            yield below, f"{what}[{count}]"
    else:
        for field in kind.fields:
            yield from _below(field.kind, f"{path}.{field.name}" if path else field.name)


_NAMES = {
    **{f"i{size}": f"int{8 * size}" for size in (1, 2, 4, 8)},
    **{f"u{size}": f"uint{8 * size}" for size in (1, 2, 4, 8)},
    **{f"f{size}": f"float{8 * size}" for size in (4, 8)},
    "b1": "bool",
}
