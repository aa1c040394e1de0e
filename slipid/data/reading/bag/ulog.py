"""Topics and messages of a ULog file (PX4), in the form in which those of bags are read.

A message of a ULog file is packed like a message of ROS 1 whose arrays have fixed lengths, so the
same code finds the numbers in both. The package pyulog reads the file.
"""

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slipid.data.reading.bag.definitions import ArrayType, FieldType, MessageType

_DTYPES = {
    **{f"int{8 * size}_t": f"i{size}" for size in (1, 2, 4, 8)},
    **{f"uint{8 * size}_t": f"u{size}" for size in (1, 2, 4, 8)},
    **{"float": "f4", "double": "f8", "bool": "b1", "char": "u1"},
}
_PADDING = "_padding"
MOST_BYTES = 2**16
"""Limit of the size of a record [byte]."""


@dataclass(frozen=True, eq=False)
class UlogConnection:
    """Messages of one topic; the attributes are those of a connection of rosbags.

    Attributes:
        topic: name of the topic, with `:1` for its second instance.
        msgtype: name of the format of the messages, such as `wheel_encoders`.
        msgdef: type of the messages.
        rows: numbers of the messages, each a row as in the file.
    """

    topic: str
    msgtype: str
    msgdef: MessageType
    rows: np.ndarray

    @property
    def msgcount(self) -> int:
        """Return the number of messages."""
        return len(self.rows)


@dataclass(frozen=True, eq=False)
class UlogReader:
    """All topics of a ULog file; the methods are those of a reader of rosbags."""

    connections: Sequence[UlogConnection]

    def messages(
        self, connections: Sequence[UlogConnection]
    ) -> Iterator[tuple[UlogConnection, int, bytes]]:
        """Yield the connection, the time [ns] and the bytes of each message.

        Times are counted from the start of the robot.
        """
        for one in connections:
            raw, size = one.rows.tobytes(), one.rows.itemsize
            for k, stamp in enumerate(one.rows["timestamp"].tolist()):
                yield one, 1000 * stamp, raw[k * size : (k + 1) * size]


def ulog_reader(path: Path) -> UlogReader:
    """Return the reader of a ULog file; pyulog raises many types of errors on damaged bytes.

    What pyulog prints about damage is not shown.
    """
    import pyulog

    raw = path.read_bytes()
    with redirect_stdout(io.StringIO()):
        formats = pyulog.ULog(_Once(raw), parse_header_only=True).message_formats
        sizes: dict[str, int] = {}
        for name in formats:
            _check_size(name, formats, sizes)
        log = pyulog.ULog(_Once(raw))
    return UlogReader([_connection(one, log.message_formats) for one in log.data_list])


class _Once(io.BytesIO):
    """Bytes of a file that are read a limited number of times: pyulog may go back without end."""

    def __init__(self, raw: bytes) -> None:
        super().__init__(raw)
        self.left = 1000 + 4 * len(raw)

    def read(self, size: int | None = -1, /) -> bytes:
        """Return the next bytes."""
        block = super().read(size)
        self.left -= len(block) + 1
        if self.left < 0:
            raise OSError("damaged records")
        return block


def _check_size(name: str, formats: Mapping[str, Any], sizes: dict[str, int]) -> int:
    """Return the number of bytes of messages with a format, and remember it in `sizes`.

    Raises:
        ValueError: the messages are larger than a record, or contain themselves.
    """

    def size_of(kind: str) -> int:
        if kind in _DTYPES:
            return np.dtype(_DTYPES[kind]).itemsize
        return _check_size(kind, formats, sizes) if kind in formats else 0

    if name not in sizes:
        sizes[name] = MOST_BYTES  # of a format that contains itself
        fields = formats[name].fields
        sizes[name] = sum(max(n, 1) * size_of(kind) for kind, n, _ in fields)
    if sizes[name] >= MOST_BYTES:
        raise ValueError(f"messages '{name}' of over {MOST_BYTES} bytes")
    return sizes[name]


def _connection(one: Any, formats: Mapping[str, Any]) -> UlogConnection:
    """Return the connection of one topic of pyulog."""
    names = [field.field_name for field in one.field_data]
    rows = np.empty(len(one.data["timestamp"]), [(name, one.data[name].dtype) for name in names])
    for name in names:
        rows[name] = one.data[name]
    fields = _type(one.name, formats).fields
    # the file has no padding at the end of a message
    while fields and next(reversed(fields)).startswith(_PADDING):
        fields.popitem()
    topic = one.name if one.multi_id == 0 else f"{one.name}:{one.multi_id}"
    return UlogConnection(topic, one.name, MessageType(one.name, fields), rows)


def _type(name: str, formats: Mapping[str, Any]) -> MessageType:
    """Return the type of messages with a format, with its nested types."""

    def field(kind: str, count: int) -> FieldType:
        element = _DTYPES[kind] if kind in _DTYPES else _type(kind, formats)
        return ArrayType(element, count) if count else element

    return MessageType(name, {key: field(kind, n) for kind, n, key in formats[name].fields})
