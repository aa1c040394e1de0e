"""Definitions of message types: the numbers and strings in a message of each type.

Definitions are taken from the bag, else from .msg files, else from the standard types of ROS.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Union, cast

from slipid.support.errors import DataError, bad_data, refused_as

if TYPE_CHECKING:
    import rosbags.interfaces
    import rosbags.interfaces.typing

FieldType = Union[str, "ArrayType", "MessageType"]
"""Type of a field: the numpy type of a number without byte order (such as `f8`), `TEXT`, an array,
or another message."""
TEXT = "text"
"""Type of a UTF-8 string."""
_DTYPES = {
    **{f"int{8 * size}": f"i{size}" for size in (1, 2, 4, 8)},
    **{f"uint{8 * size}": f"u{size}" for size in (1, 2, 4, 8)},
    **{"float32": "f4", "float64": "f8", "bool": "b1", "byte": "i1", "char": "u1"},
}
_NAMES = {dtype: name for name, dtype in reversed(_DTYPES.items())}
_SEPARATOR = "=" * 80 + "\n"


@dataclass(frozen=True)
class ArrayType:
    """Type of an array of `count` elements; `count` is None if it differs between messages."""

    element: FieldType
    count: int | None


@dataclass(frozen=True, eq=False)
class MessageType:
    """A message type.

    Attributes:
        name: name of the type, such as `sensor_msgs/msg/Imu`.
        fields: type of each field, in their order in a message.
    """

    name: str
    fields: dict[str, FieldType]

    @cached_property
    def paths(self) -> dict[str, str]:
        """Type, such as `float64[]` or `text`, of every number and string, keyed by its path.

        A path has the names of nested fields, separated by dots.
        """
        return dict(_below(self, ""))


def _below(kind: FieldType, path: str) -> Iterator[tuple[str, str]]:
    """Yield the path and the type of every number and string in a field."""
    if isinstance(kind, str):
        yield path, _NAMES.get(kind, kind)
    elif isinstance(kind, ArrayType):
        count = "" if kind.count is None else str(kind.count)
        for below, what in _below(kind.element, path):
            # An array of messages is an array of each number in them, so its brackets follow the
            # type of the number.
            yield below, f"{what}[{count}]"
    else:
        for name, inner in kind.fields.items():
            yield from _below(inner, f"{path}.{name}" if path else name)


class NoDefinition(ValueError):
    """Error about a message type without definition; its argument is the name of the type."""


def definition_of(
    where: str, name: str, carried: "rosbags.interfaces.MessageDefinition", folder: Path | None
) -> MessageType:
    """Return the definition of a topic's message type.

    Args:
        where: bag and topic, for error messages.
        name: name of the type, such as `robotino_msgs/msg/MotorReadings`.
        carried: definition in the bag; it may be empty.
        folder: folder of .msg files that are used if the bag has no definition, or None.

    Raises:
        DataError: the type is defined nowhere, or its definition cannot be read.
    """
    try:
        return _message(where, name, _parsed(where, name, carried), folder)
    except NoDefinition as error:
        missing = error.args[0]
        also = "" if missing == name else f", which {name} contains"
        nor = f"{folder} has no {missing.rsplit('/', 1)[-1]}.msg; " if folder else ""
        raise DataError(
            f"{where}: no definition of {missing}{also} in the bag; {nor}expected one: name a "
            'folder of its .msg files in the layout (definitions = "FOLDER")'
        ) from None


def _message(
    where: str,
    name: str,
    own: "rosbags.interfaces.typing.Typesdict",
    folder: Path | None,
    above: tuple[str, ...] = (),
) -> MessageType:
    """Return a message type with all nested types; raise `NoDefinition` if one is not found.

    Args:
        where: bag and topic, for error messages.
        name: name of the type.
        own: definitions in the bag itself, as rosbags parsed them.
        folder: folder of .msg files, in which types that `own` lacks are searched, or None.
        above: names of the types that contain this one.

    Raises:
        DataError: a definition in the folder cannot be read, or a type contains itself.
    """
    from rosbags.interfaces import Nodetype

    if name in above:
        raise bad_data(where, f"the type {name} contains itself", "a type that ends")

    def field_type(description: "rosbags.interfaces.typing.FieldDesc") -> FieldType:
        what, detail = description
        if what == Nodetype.NAME:
            return _message(where, str(detail), own, folder, (*above, name))
        if what == Nodetype.BASE:
            base = str(detail[0])
            if base != "string" and base not in _DTYPES:
                raise NoDefinition(base)
            return _DTYPES.get(base, TEXT)
        element, count = cast("tuple[rosbags.interfaces.typing.FieldDesc, int]", detail)
        return ArrayType(field_type(element), count if what == Nodetype.ARRAY else None)

    found = own.get(name) or _from_folder(folder, name) or _standard().get(name)
    if found is None:
        raise NoDefinition(name)
    return MessageType(name, {key: field_type(description) for key, description in found[1]})


def _parsed(
    where: str, name: str, carried: "rosbags.interfaces.MessageDefinition"
) -> "rosbags.interfaces.typing.Typesdict":
    """Return the types in the text of a definition; empty if the bag has no definition."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if carried.format == MessageDefinitionFormat.NONE:
        return {}
    with refused_as(where, f"the definition of {name}; is the bag damaged?"):
        if carried.format == MessageDefinitionFormat.MSG:
            return get_types_from_msg(carried.data, name)
        types: rosbags.interfaces.typing.Typesdict = {}
        for part in carried.data.split(_SEPARATOR):
            if part.strip():
                text = part.partition("\n")[2] if part.startswith("IDL: ") else part
                types.update(get_types_from_idl(text))
    return types


def _from_folder(
    folder: Path | None, name: str
) -> "tuple[rosbags.interfaces.typing.Constdefs, rosbags.interfaces.typing.Fielddefs] | None":
    """Return the definition in a .msg file of the folder, or None if there is no such file.

    A file below a folder with the name of the type's package is preferred.
    """
    if folder is None:
        return None
    from rosbags.typesys import get_types_from_msg

    package, short = name.split("/", 1)[0], name.rsplit("/", 1)[-1]
    files = sorted(folder.rglob(f"{short}.msg"), key=lambda path: package not in path.parts)
    if not files:
        return None
    with refused_as(files[0], f"the definition of {name}"):
        return get_types_from_msg(files[0].read_text("utf-8"), name)[name]


@lru_cache(maxsize=1)
def _standard() -> "rosbags.interfaces.typing.Typesdict":
    """Return the standard types of ROS 2 Humble; bags of later versions contain definitions."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE).fielddefs
