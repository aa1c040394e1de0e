"""Definitions of message types: from the bag, from a folder of .msg files, or the standard ones."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, cast

from slipid.data.reading.bag.messages.kinds import Field, Kind, Many, Message, Number, Text
from slipid.support.errors import DataError, bad_data

if TYPE_CHECKING:
    import rosbags.interfaces
    import rosbags.interfaces.typing

_DTYPES = {
    **{f"int{8 * size}": f"i{size}" for size in (1, 2, 4, 8)},
    **{f"uint{8 * size}": f"u{size}" for size in (1, 2, 4, 8)},
    **{"float32": "f4", "float64": "f8", "bool": "b1", "byte": "i1", "char": "u1"},
}
_SEPARATOR = "=" * 80 + "\n"


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
        found = (Field(key, self._kind(description)) for key, description in fields[1])
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


def _plain(base: str) -> Number | Text:
    """A number or a text by the name of its type."""
    if base == "string":
        return Text()
    if base not in _DTYPES:
        raise NoDefinition(base)
    return Number(_DTYPES[base])


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
