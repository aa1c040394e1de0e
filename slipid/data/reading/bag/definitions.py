"""Types of messages: resolved to numbers and texts, from the bag, .msg files or the standard."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Union, cast

from slipid.support.errors import DataError, bad_data

if TYPE_CHECKING:
    import rosbags.interfaces
    import rosbags.interfaces.typing

Kind = Union["NumberType", "Text", "Many", "Message"]
"""Of a field: one number, one text, several of a kind, or a message of its own."""
_DTYPES = {
    **{f"int{8 * size}": f"i{size}" for size in (1, 2, 4, 8)},
    **{f"uint{8 * size}": f"u{size}" for size in (1, 2, 4, 8)},
    **{"float32": "f4", "float64": "f8", "bool": "b1", "byte": "i1", "char": "u1"},
}
_NAMES = {dtype: name for name, dtype in reversed(_DTYPES.items())}
_SEPARATOR = "=" * 80 + "\n"


@dataclass(frozen=True)
class NumberType:
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
class MessageField:
    """A field of a message by name."""

    name: str
    kind: Kind


@dataclass(frozen=True)
class Message:
    """A type of message: its name, as `sensor_msgs/msg/Imu`, and its fields in order."""

    name: str
    fields: tuple[MessageField, ...]

    @property
    def paths(self) -> dict[str, str]:
        """Dotted path of every number and text in it, and what is there: `float64[]`, `text`."""
        return dict(_below(self, ""))


def _below(kind: Kind, path: str) -> Iterator[tuple[str, str]]:
    """Paths at and below a field."""
    if isinstance(kind, NumberType):
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


class NoDefinition(ValueError):
    """A type that is defined nowhere; its argument is the name."""


@dataclass(frozen=True, eq=False)
class Definitions:
    """Where the definitions of a bag's message types are looked up, nearest first.

    Attributes:
        own: types that the bag itself defines, as rosbags parsed them.
        folder: folder of .msg files, or None.
    """

    own: "rosbags.interfaces.typing.Typesdict"
    folder: Path | None

    def message(self, name: str) -> Message:
        """A message type with everything in it resolved; NoDefinition where something is not."""
        fields = self.own.get(name) or _from_folder(self.folder, name) or _standard().get(name)
        if fields is None:
            raise NoDefinition(name)
        found = (MessageField(key, self._kind(description)) for key, description in fields[1])
        return Message(name, tuple(found))

    def _kind(self, description: "rosbags.interfaces.typing.FieldDesc") -> Kind:
        from rosbags.interfaces import Nodetype

        what = description[0]
        if what == Nodetype.NAME:
            return self.message(str(description[1]))
        if what == Nodetype.BASE:
            return _plain(str(description[1][0]))
        element, count = cast("tuple[rosbags.interfaces.typing.FieldDesc, int]", description[1])
        return Many(self._kind(element), count if what == Nodetype.ARRAY else None)


def _plain(base: str) -> NumberType | Text:
    """A number or a text by the name of its type."""
    if base == "string":
        return Text()
    if base not in _DTYPES:
        raise NoDefinition(base)
    return NumberType(_DTYPES[base])


def definition_of(
    path: Path,
    topic: str,
    name: str,
    carried: "rosbags.interfaces.MessageDefinition",
    folder: Path | None,
) -> Message:
    """Definition of a topic's message type.

    Args:
        path: the bag, for messages.
        topic: the topic, for messages.
        name: of the type, as `robotino_msgs/msg/MotorReadings`.
        carried: what the bag says of the type, perhaps nothing.
        folder: folder of .msg files that are asked where the bag says nothing, or None.

    Raises:
        DataError: it is defined nowhere, or the definition cannot be read.
    """
    where = f"{path} topic '{topic}'"
    try:
        own = _parsed(name, carried)
        return Definitions(own, folder).message(name)
    except NoDefinition as error:
        missing = error.args[0]
        also = "" if missing == name else f", which {name} is made of"
        asked = (
            f"{folder} has no {missing.rsplit('/', 1)[-1]}.msg; expected" if folder else "expected"
        )
        raise DataError(
            f"{where}: no definition of {missing}{also} in the bag; {asked} one: name a folder of "
            'its .msg files in the layout (definitions = "FOLDER")'
        ) from None
    except DataError:
        raise
    except Exception as error:  # the parser meets any bytes, and fails on them in many ways
        found = f"the definition of {name} cannot be read ({error})"
        expected = "the text of a .msg file; is the bag damaged?"
        raise bad_data(where, found, expected) from error


def _parsed(
    name: str, carried: "rosbags.interfaces.MessageDefinition"
) -> "rosbags.interfaces.typing.Typesdict":
    """Types in the text of a definition; empty where the bag carries none."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if carried.format == MessageDefinitionFormat.MSG:
        return get_types_from_msg(carried.data, name)
    if carried.format == MessageDefinitionFormat.NONE:
        return {}
    types: rosbags.interfaces.typing.Typesdict = {}
    for part in carried.data.split(_SEPARATOR):
        if part.strip():
            text = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
            types.update(get_types_from_idl(text))
    return types


def _from_folder(
    folder: Path | None, name: str
) -> "tuple[rosbags.interfaces.typing.Constdefs, rosbags.interfaces.typing.Fielddefs] | None":
    """Definition by a .msg file, rather one below a folder of the package's name; None without."""
    if folder is None:
        return None
    from rosbags.typesys import get_types_from_msg

    package, short = name.split("/", 1)[0], name.rsplit("/", 1)[-1]
    files = sorted(folder.rglob(f"{short}.msg"))
    named = [path for path in files if package in path.parts]
    if not (named or files):
        return None
    text = (named or files)[0].read_text(encoding="utf-8")
    return get_types_from_msg(text, name)[name]


@lru_cache(maxsize=1)
def _standard() -> "rosbags.interfaces.typing.Typesdict":
    """Standard types as ROS 2 Humble has them: bags of Iron and later carry their own."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE).fielddefs
