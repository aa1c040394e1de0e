"""An open bag with its topics and messages; any damage is reported as a `DataError`."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from slipid.data.reading.bag.definitions import MessageType, definition_of
from slipid.data.reading.bag.shape import MessageShape, shape_of
from slipid.data.reading.bag.storage import OPENABLE, BagFiles, RepairedMcap, files_of, repaired
from slipid.data.reading.bag.ulog import UlogConnection, UlogReader, ulog_reader
from slipid.data.reading.bag.unpacking import limit_rosbags
from slipid.support.errors import DataError, bad_data
from slipid.support.extras import require
from slipid.support.files import read_bytes

if TYPE_CHECKING:
    import rosbags.interfaces
    import rosbags.rosbag1
    import rosbags.rosbag2

Reader: TypeAlias = "rosbags.rosbag1.Reader | rosbags.rosbag2.Reader | UlogReader"
Connection: TypeAlias = "rosbags.interfaces.Connection | UlogConnection"
_REMEDY = {
    "rosbag1": "run: rosbag reindex {file}",
    "sqlite3": "save what is left with: sqlite3 {file} .recover | sqlite3 whole.db3",
    "mcap": "save what is left with: mcap recover {file} -o whole.mcap",
    "ulog": "download {file} from the robot again",
}
MOST_METADATA = 2**20
"""Largest size of metadata.yaml, which is read slowly [byte]."""
MOST_REFERENCES = 20
"""Largest number of references in metadata.yaml, which has none if ROS wrote it."""
MOST_NESTED = 50
"""Largest depth of brackets in metadata.yaml, in which ROS writes no more than a few."""
_METADATA = "copy the folder again, or run: ros2 bag reindex {file}"


@dataclass(frozen=True, eq=False)
class BagTopic:
    """A topic of an open bag.

    Attributes:
        bag: the bag.
        name: name of the topic.
        connections: connections of the topic in the package rosbags, one for each publisher, or
            that of a ULog file.
    """

    bag: "OpenBag"
    name: str
    connections: tuple[Connection, ...]

    @cached_property
    def type(self) -> str:
        """Type of the messages, such as `sensor_msgs/msg/Imu`; " and " joins several types."""
        return " and ".join(dict.fromkeys(one.msgtype for one in self.connections))

    @cached_property
    def count(self) -> int:
        """Number of messages."""
        return sum(one.msgcount for one in self.connections)

    @cached_property
    def message(self) -> MessageType:
        """Definition of the messages' type; raises `DataError` if there is none."""
        if isinstance(known := self.connections[0].msgdef, MessageType):
            return known
        carried = [
            one.msgdef for one in self.connections if not isinstance(one.msgdef, MessageType)
        ]
        first = next((one for one in carried if one.format.value), carried[0])
        where = f"{self.bag.files.path} topic '{self.name}'"
        return definition_of(where, self.type, first, self.bag.definitions)

    def messages(self) -> Iterator[tuple[int, bytes]]:
        """Yield the time of receipt [ns] and the bytes of each message of the topic."""
        return ((received, data) for _, received, data in self.bag.messages([self.name]))

    def shape(self, data: bytes, number: int) -> MessageShape:
        """Return the byte layout of a message; raise `DataError` if its bytes contradict its type.

        `number` is the number of the message in the topic, from 1.
        """
        try:
            return shape_of(
                data, self.message, cdr=self.bag.files.storage not in ("rosbag1", "ulog")
            )
        except ValueError as error:
            found = f"the message is no {self.message.name}: {error}"
            expected = "messages that match their definition; is the bag damaged?"
            raise self.error(found, expected, number) from error

    def shapes(self) -> Iterator[MessageShape]:
        """Yield the byte layout of each message."""
        for number, (_, data) in enumerate(self.messages(), start=1):
            yield self.shape(data, number)

    def error(self, found: str, expected: str, number: int | None = None) -> DataError:
        """Return the error about the topic, or about one of its messages, counted from 1."""
        where = f"{self.bag.files.path} topic '{self.name}'"
        return bad_data(where + ("" if number is None else f" message {number}"), found, expected)


@dataclass(frozen=True, eq=False)
class OpenBag:
    """A bag that is open for reading.

    Attributes:
        files: files of the bag.
        readers: readers of the package rosbags, one for each part that is read separately, or that
            of a ULog file.
        notes: defects of the files that were worked around, one sentence each.
        definitions: folder of .msg files, for types whose definition the bag lacks, or None.
    """

    files: BagFiles
    readers: "tuple[Reader, ...]"
    notes: tuple[str, ...]
    definitions: Path | None

    @cached_property
    def topics(self) -> dict[str, BagTopic]:
        """All topics, keyed by name."""
        found: dict[str, list[Connection]] = {}
        for reader in self.readers:
            for connection in reader.connections:
                found.setdefault(connection.topic, []).append(connection)
        return {name: BagTopic(self, name, tuple(same)) for name, same in sorted(found.items())}

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, int, bytes]]:
        """Yield messages of some topics: topic, time of receipt [ns] and bytes.

        Raises:
            DataError: the bag is damaged.
        """
        for reader in self.readers:
            if not (wanted := [c for c in reader.connections if c.topic in topics]):
                continue
            try:
                for connection, received, data in _source(reader)(wanted):
                    if data.__class__ is not bytes:
                        raise TypeError(f"a message of type {type(data).__name__}")
                    if received.__class__ is not int or not 0 <= received < 2**63:
                        raise TypeError(f"a message of the time {received!r:.40}")
                    yield connection.topic, received, data
            except Exception as error:  # rosbags raises many types of errors on damaged bytes
                raise damage_error(self.files, error) from error


def _source(reader: "Reader") -> Callable[..., Iterator[Any]]:
    """Return the function that iterates over the messages of a reader.

    If an MCAP file has no index, `messages` of rosbags refuses messages that are not in order of
    time. Slipid sorts messages itself, so the storage's plain scan is used instead.
    """
    storage = getattr(reader, "storage", None)
    if storage is not None and getattr(storage, "chunks", None) == []:
        return storage.messages_scan
    return reader.messages


@contextmanager
def open_bag(path: Path, definitions: Path | None) -> Iterator[OpenBag]:
    """Return a context manager that opens a bag for reading, and closes it on exit.

    Args:
        path: a .bag, .db3 or .mcap file, the folder of a rosbag2, or the metadata.yaml in it.
        definitions: folder of .msg files, for types whose definition the bag lacks, or None.

    Raises:
        DataError: there is no bag, or it is damaged; the message describes how to repair it.
    """
    files = files_of(path)
    with ExitStack() as stack:
        readers, notes = _readers(files, stack)
        yield OpenBag(files, tuple(readers), tuple(notes), definitions)


def _readers(files: BagFiles, stack: ExitStack) -> "tuple[list[Reader], list[str]]":
    """Return open readers of a bag, and notes on defects that were worked around.

    The readers are closed with the stack.
    """
    notes = [
        f"{part.name}-wal contains messages that are not read; to add them run: sqlite3 {part} "
        "'PRAGMA wal_checkpoint'"
        for part in files.parts
        if (wal := part.with_name(part.name + "-wal")).exists() and wal.stat().st_size
    ]
    if files.metadata is not None:
        try:
            return [_reader(files.path, files, stack)], notes
        except DataError as error:
            if any(part.suffix == ".zstd" for part in files.parts) or files.storage != "mcap":
                raise
            notes.append(
                f"metadata.yaml does not match the files, so they were read without it ({error})"
            )
    elif files.path.is_dir():
        notes.append("the folder has no metadata.yaml: the recording was cut off")
        if packed := [part.name for part in files.parts if part.suffix == ".zstd"]:
            expected = f"the unpacked file; run: zstd -d {packed[0]}"
            raise bad_data(files.path, f"{packed[0]} without metadata.yaml", expected)
    readers = []
    for part in files.parts:
        try:
            readers.append(_reader(part, files, stack))
        except DataError:
            whole = repaired(part) if files.storage == "mcap" else None
            if whole is None:
                raise
            readers.append(_reader(whole, files, stack))
            lost = part.stat().st_size - whole.end
            notes.append(
                f"{part.name} was cut off: it was read up to its last complete record, without "
                f"the last {lost} bytes"
            )
    return readers, notes


def _reader(path: Path | RepairedMcap, files: BagFiles, stack: ExitStack) -> "Reader":
    """Return an open reader of a file or folder; raise `DataError` if it is damaged."""
    if files.storage == "ulog":
        require("pyulog", "ulog", f"{files.path}: a ULog file")
    else:
        require("rosbags", "bags", f"{files.path}: a bag")
    try:
        if files.storage == "ulog":
            return ulog_reader(files.path)
        from rosbags import rosbag1, rosbag2

        limit_rosbags()
        if files.storage == "rosbag1":
            return stack.enter_context(rosbag1.Reader(files.path))
        if files.metadata is not None and path == files.path:
            _check_metadata(files.metadata)
        # `RepairedMcap` has the methods of a path that rosbags calls.
        reader = stack.enter_context(rosbag2.Reader(cast(Path, path)))
        # metadata.yaml may have values of any type; `files`, which slipid does not need, is cleared
        vars(reader.storage)["files"] = []
        for one in reader.connections:
            if (type(one.topic), type(one.msgtype), type(one.msgcount)) != (str, str, int):
                raise TypeError(f"metadata of the topic {one.topic!r:.40} of wrong types")
        return reader
    except Exception as error:  # rosbags and pyulog raise many types on damaged bytes
        raise damage_error(files, error) from error


def _check_metadata(path: Path) -> None:
    """Raise `ValueError` for a metadata.yaml that ROS cannot have written.

    The text of a value with references may be exponential in their number, and the time to read
    brackets in brackets is quadratic in their depth.
    """
    raw = read_bytes(path, "the metadata of a bag", MOST_METADATA)
    if len(re.findall(rb"(?:^|[\s,:\[{-])\*\w", raw)) > MOST_REFERENCES:
        raise ValueError("metadata with many references")
    brackets = re.findall(rb"[\[\]{}]", raw)
    if max(accumulate(1 if one in b"[{" else -1 for one in brackets), default=0) > MOST_NESTED:
        raise ValueError(f"metadata with over {MOST_NESTED} brackets in brackets")


def damage_error(files: BagFiles, error: Exception) -> DataError:
    """Return the error about a bag that rosbags cannot read, with a remedy."""
    text = (str(error).splitlines() or [type(error).__name__])[0][:200]
    file = files.parts[0]
    if "not indexed" in text:
        expected = f"a complete bag; {_REMEDY['rosbag1'].format(file=file)}"
        return bad_data(files.path, "the bag has no index: its recording was cut off", expected)
    if isinstance(error, PermissionError):
        return bad_data(files.path, f"cannot be read ({error.strerror})", OPENABLE)
    if isinstance(error, KeyError) and error.args[0] in ("protobuf", "jsonschema", "flatbuffer"):
        found = f"it contains messages encoded as {error.args[0]}, which cannot be read"
        expected = "ROS messages only; remove all other messages with: mcap filter"
        return bad_data(files.path, found, expected)
    if "Profile is not ros2" in text:
        expected = (
            "an MCAP file recorded by ROS 2 (profile ros2); convert it with: ros2 bag convert"
        )
        return bad_data(files.path, "an MCAP file of another profile", expected)
    remedy = _REMEDY[files.storage].format(file=file)
    if "metadata" in text.lower() or "files are missing" in text:
        remedy = _METADATA.format(file=files.path)
    found = f"the bag is damaged or was cut off ({text})"
    return bad_data(files.path, found, f"a complete bag; {remedy}")
