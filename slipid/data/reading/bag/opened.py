"""A bag opened for reading: its topics, their messages, and one error for all that is broken."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, cast

from slipid.data.reading.bag.storage import BagFiles, MendedMcap, files_of, mended
from slipid.support.errors import DataError, bad_data

if TYPE_CHECKING:
    import rosbags.interfaces
    import rosbags.rosbag1
    import rosbags.rosbag2

Reader: TypeAlias = "rosbags.rosbag1.Reader | rosbags.rosbag2.Reader"
_BATCH_BYTES = 1 << 20
_REMEDY = {
    "rosbag1": "run: rosbag reindex {file}",
    "sqlite3": "save what is left with: sqlite3 {file} .recover | sqlite3 whole.db3",
    "mcap": "save what is left with: mcap recover {file} -o whole.mcap",
}
_METADATA = "copy the folder again, or run: ros2 bag reindex {file}"


class Raw(NamedTuple):
    """A message as it is stored: its topic, when it was received [ns], its bytes."""

    topic: str
    received: int
    data: bytes


@dataclass(frozen=True, eq=False)
class MessageBatch:
    """Messages of one topic that follow each other in it.

    Attributes:
        topic: its name.
        received: when the recorder had each of them [ns].
        data: their bytes.
    """

    topic: str
    received: list[int]
    data: list[bytes]


@dataclass(frozen=True, eq=False)
class StoredTopic:
    """A topic of a bag.

    Attributes:
        name: of the topic.
        type: of its messages, as `sensor_msgs/msg/Imu`; where they are of several, all of them.
        count: how many messages.
        carried: definition of the type as the bag carries it, perhaps none.
    """

    name: str
    type: str
    count: int
    carried: "rosbags.interfaces.MessageDefinition"


@dataclass(frozen=True, eq=False)
class OpenBag:
    """A bag while it is open.

    Attributes:
        files: what it is made of.
        readers: rosbags' readers, one for each part that is read for itself.
        notes: what was amiss and could be helped, one sentence each.
    """

    files: BagFiles
    readers: "tuple[Reader, ...]"
    notes: tuple[str, ...]

    @property
    def path(self) -> Path:
        """What the bag is called in messages."""
        return self.files.path

    @property
    def cdr(self) -> bool:
        """Whether messages are serialised as in ROS 2."""
        return self.files.storage != "rosbag1"

    @cached_property
    def topics(self) -> dict[str, StoredTopic]:
        """Every topic by name."""
        found: dict[str, list[rosbags.interfaces.Connection]] = {}
        for reader in self.readers:
            for connection in reader.connections:
                found.setdefault(connection.topic, []).append(connection)
        return {name: _topic(name, same) for name, same in sorted(found.items())}

    @property
    def end(self) -> int:
        """Time of the last message [ns]."""
        return max(reader.end_time for reader in self.readers)

    def messages(self, topics: Sequence[str], start: int | None = None) -> Iterator[Raw]:
        """Messages of some topics in the order in which they were received.

        Args:
            topics: their names.
            start: leave out what was received before [ns].

        Raises:
            DataError: the bag is damaged.
        """
        for reader in self.readers:
            wanted = [c for c in reader.connections if c.topic in topics]
            if not wanted:
                continue
            try:
                for connection, received, data in _source(reader)(wanted, start):
                    if data.__class__ is not bytes:
                        raise TypeError(f"a message of type {type(data).__name__}")
                    yield Raw(connection.topic, received, data)
            except Exception as error:  # rosbags meets any bytes, and fails on them in many ways
                raise damaged(self.files, error) from error

    def batches(self, topics: Sequence[str]) -> Iterator[MessageBatch]:
        """The same messages topic by topic, about a megabyte at a time.

        What is done for each message is done here, in one loop: on a big bag that is the work.

        Raises:
            DataError: the bag is damaged.
        """
        waiting = {topic: MessageBatch(topic, [], []) for topic in topics}
        room = dict.fromkeys(topics, _BATCH_BYTES)
        for reader in self.readers:
            wanted = [c for c in reader.connections if c.topic in waiting]
            if not wanted:
                continue
            try:
                for connection, received, data in _source(reader)(wanted, None):
                    topic = connection.topic
                    batch = waiting[topic]
                    batch.received.append(received)
                    batch.data.append(data)
                    room[topic] -= len(data)
                    if room[topic] < 0:
                        yield batch
                        waiting[topic], room[topic] = MessageBatch(topic, [], []), _BATCH_BYTES
            except Exception as error:  # rosbags meets any bytes, and fails on them in many ways
                raise damaged(self.files, error) from error
        yield from (batch for batch in waiting.values() if batch.data)


def _source(reader: "Reader") -> Callable[..., Iterator[Any]]:
    """The function that iterates over messages.

    Where an MCAP file has no index, rosbags refuses messages out of order, which we sort ourselves:
    its scan underneath is asked.
    """
    storage = getattr(reader, "storage", None)
    if storage is not None and getattr(storage, "chunks", None) == []:
        return storage.messages_scan
    return reader.messages


@contextmanager
def open_bag(path: Path) -> Iterator[OpenBag]:
    """Open a bag for reading, and close it.

    Raises:
        DataError: there is none, or it is damaged; the message says how to mend it.
    """
    files = files_of(path)
    with ExitStack() as stack:
        readers, notes = _opened(files, stack)
        yield OpenBag(files, tuple(readers), tuple(notes))


def _opened(files: BagFiles, stack: ExitStack) -> "tuple[list[Reader], list[str]]":
    """Readers of a bag, entered into a stack, and notes on what is amiss with it."""
    notes = [
        f"{part.name}-wal lies beside the bag: messages in it are not read; "
        f"to add them run: sqlite3 {part} 'PRAGMA wal_checkpoint'"
        for part in files.parts
        if (wal := part.with_name(part.name + "-wal")).exists() and wal.stat().st_size
    ]
    if files.metadata is not None:
        try:
            return [_entered(files.path, files, stack)], notes
        except DataError as error:
            if any(part.suffix == ".zstd" for part in files.parts) or files.storage != "mcap":
                raise
            notes.append(
                f"metadata.yaml does not fit the files, which were read without it ({error})"
            )
    elif files.path.is_dir():
        notes.append("the folder has no metadata.yaml: the recording was cut off")
        if packed := [part.name for part in files.parts if part.suffix == ".zstd"]:
            expected = f"it unpacked; run: zstd -d {packed[0]}"
            raise bad_data(files.path, f"{packed[0]} without metadata.yaml", expected)
    readers = []
    for part in files.parts:
        try:
            readers.append(_entered(part, files, stack))
        except DataError:
            whole = mended(part) if files.storage == "mcap" else None
            if whole is None:
                raise
            readers.append(_entered(whole, files, stack))
            lost = part.stat().st_size - whole.end
            notes.append(
                f"{part.name} was cut off: it was read up to its last whole record, "
                f"without the last {lost} bytes"
            )
    return readers, notes


def _entered(path: Path | MendedMcap, files: BagFiles, stack: ExitStack) -> "Reader":
    """A reader of a file or folder, open until the stack is left; DataError where it cannot be."""
    from rosbags import rosbag1, rosbag2

    try:
        if files.storage == "rosbag1":
            return stack.enter_context(rosbag1.Reader(files.path))
        # a mended file has as much of a path as rosbags asks of one file
        return stack.enter_context(rosbag2.Reader(cast(Path, path)))
    except Exception as error:  # rosbags meets any bytes, and fails on them in many ways
        raise damaged(files, error) from error


def _topic(name: str, same: "list[rosbags.interfaces.Connection]") -> StoredTopic:
    types = dict.fromkeys(connection.msgtype for connection in same)
    carried = [c.msgdef for c in same if c.msgdef.format.value] or [same[0].msgdef]
    count = sum(connection.msgcount for connection in same)
    return StoredTopic(name, " and ".join(types), count, carried[0])


def damaged(files: BagFiles, error: Exception) -> DataError:
    """The error about a bag that rosbags cannot read."""
    said = (str(error).splitlines() or [type(error).__name__])[0][:200]
    file = files.parts[0]
    if "not indexed" in said:
        expected = f"a whole bag; {_REMEDY['rosbag1'].format(file=file)}"
        return bad_data(files.path, "the bag has no index: its recording was cut off", expected)
    if isinstance(error, PermissionError):
        return bad_data(files.path, f"cannot be read ({error.strerror})", "a readable bag")
    if isinstance(error, KeyError) and error.args[0] in ("protobuf", "jsonschema", "flatbuffer"):
        found = f"it holds messages encoded as {error.args[0]}, which are not read"
        expected = "ROS messages only; filter them out with: mcap filter"
        return bad_data(files.path, found, expected)
    if "Profile is not ros2" in said:
        expected = "one that ROS 2 recorded (profile ros2); write it again with: ros2 bag convert"
        return bad_data(files.path, "an MCAP file of another profile", expected)
    remedy = _REMEDY[files.storage].format(file=file)
    if "metadata" in said.lower() or "files are missing" in said:
        remedy = _METADATA.format(file=files.path)
    found = f"the bag is damaged or was cut off ({said})"
    return bad_data(files.path, found, f"a whole one; {remedy}")
