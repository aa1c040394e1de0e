"""Messages of a topic as arrays that grow batch by batch; no message is kept."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from slipid.data.reading.bag.messages.kinds import Message
from slipid.data.reading.bag.messages.picks import Located, Pick
from slipid.data.reading.bag.messages.shape import Shape, shape_of
from slipid.support.errors import DataError, bad_data

BATCH_BYTES = 1 << 20
"""Of messages that wait until they are turned into numbers together."""
MAX_SHAPES = 256
"""Shapes of a topic that are remembered; with more of them the oldest are found anew."""
FEW_SHAPES = 16
"""Shapes in a batch that are looked for in all of it; beyond them each message is its own."""


@dataclass(frozen=True, eq=False)
class Stream:
    """Rows of numbers from the messages of a topic, in the order in which they were received.

    Attributes:
        path: the bag; `topic`: the topic.
        columns: name of each number of a row.
        stamp: the messages' own time [ns], or None where they have none.
        received: when the recorder had them [ns].
        number: of the message in its topic, from 1.
        values: the numbers, as they are in the messages.
        absent: numbers that the message did not have, such as other joints.
    """

    path: Path
    topic: str
    columns: tuple[str, ...]
    stamp: Int[np.ndarray, " row"] | None
    received: Int[np.ndarray, " row"]
    number: Int[np.ndarray, " row"]
    values: Float[np.ndarray, "row column"]
    absent: Bool[np.ndarray, "row column"]

    def error(self, found: str, expected: str, row: int | None = None) -> DataError:
        """The error about a row (counted from 0), or about the topic."""
        message = None if row is None else int(self.number[row])
        return topic_error(self.path, self.topic, found, expected, message)

    def part(self, which: Int[np.ndarray, " part"] | Bool[np.ndarray, " row"]) -> "Stream":
        """Some of the rows."""
        return replace(
            self,
            stamp=None if self.stamp is None else self.stamp[which],
            received=self.received[which],
            number=self.number[which],
            values=self.values[which],
            absent=self.absent[which],
        )


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows of one pick in one batch, as in `Stream`."""

    stamp: Int[np.ndarray, " row"] | None
    received: Int[np.ndarray, " row"]
    number: Int[np.ndarray, " row"]
    values: Float[np.ndarray, "row column"]
    absent: Bool[np.ndarray, "row column"]


class TopicStreams:
    """Takes the messages of a topic and keeps the numbers that some picks want of them."""

    def __init__(
        self, path: Path, topic: str, message: Message, picks: Sequence[Pick], *, cdr: bool
    ) -> None:
        self.path, self.topic, self.message, self.cdr = path, topic, message, cdr
        self.picks = tuple(picks)
        self.count = 0
        self._raw: list[bytes] = []
        self._received: list[int] = []
        self._room = BATCH_BYTES
        self._rows: list[list[_Rows]] = [[] for _ in self.picks]
        self._shapes: dict[int, list[tuple[Shape, list[tuple[Located, ...]]]]] = {}

    def add(self, received: int, raw: bytes) -> None:
        """Take one message, received at a time [ns]."""
        self._raw.append(raw)
        self._received.append(received)
        self._room -= len(raw) + 64
        if self._room < 0:
            self.flush()

    def flush(self) -> None:
        """Turn the messages that wait into numbers."""
        received = np.array(self._received, dtype=np.int64)
        numbers = self.count + 1 + np.arange(len(received))
        for which, block, places in self._blocks():
            for rows, located in zip(self._rows, places, strict=True):
                rows += [_taken(block, received[which], numbers[which], row) for row in located]
        self.count += len(self._raw)
        self._raw, self._received, self._room = [], [], BATCH_BYTES

    def stream(self, pick: Pick) -> Stream:
        """Every row of one of the picks."""
        self.flush()
        parts = self._rows[self.picks.index(pick)]
        widths = {part.values.shape[1] for part in parts}
        if len(widths) > 1:
            first = parts[0]
            other = next(p for p in parts if p.values.shape[1] != first.values.shape[1])
            found = f"{other.values.shape[1]} numbers, and {first.values.shape[1]} of them before"
            expected = "as many in every message; name one by its index, such as [0]?"
            raise topic_error(self.path, self.topic, found, expected, int(other.number[0]))
        if not parts:
            none = np.zeros(0, dtype=np.int64)
            width = len(pick.columns)
            empty = np.zeros((0, width))
            return Stream(
                self.path, self.topic, pick.columns, None, none, none, empty, empty.astype(bool)
            )
        number = np.concatenate([part.number for part in parts])
        order = np.argsort(number, kind="stable")
        stamps = [part.stamp for part in parts if part.stamp is not None]
        return Stream(
            path=self.path,
            topic=self.topic,
            columns=pick.columns,
            stamp=np.concatenate(stamps)[order] if len(stamps) == len(parts) else None,
            received=np.concatenate([part.received for part in parts])[order],
            number=number[order],
            values=np.concatenate([part.values for part in parts])[order],
            absent=np.concatenate([part.absent for part in parts])[order],
        )

    def _blocks(
        self,
    ) -> Iterator[
        tuple[
            Int[np.ndarray, " message"],
            UInt8[np.ndarray, "message byte"],
            list[tuple[Located, ...]],
        ]
    ]:
        """Messages of one shape: which they are, their bytes, and where each pick's numbers are."""
        lengths = np.fromiter(map(len, self._raw), np.int64, len(self._raw))
        for length in np.unique(lengths):
            left = np.flatnonzero(lengths == length)
            joined = b"".join([self._raw[k] for k in left])
            block = np.frombuffer(joined, np.uint8).reshape(len(left), int(length))
            seen = 0
            for shape, places in self._shapes.get(int(length), []):
                same = shape.fits(block)
                if same.any():
                    yield left[same], block[same], places
                    left, block = left[~same], block[~same]
            while len(left):
                shape, places = self._shape(int(left[0]))
                seen += 1
                same = shape.fits(block) if seen <= FEW_SHAPES else np.arange(len(left)) == 0
                yield left[same], block[same], places
                left, block = left[~same], block[~same]

    def _shape(self, k: int) -> tuple[Shape, list[tuple[Located, ...]]]:
        """Shape of the k-th message that waits, which is a new one."""
        try:
            shape = shape_of(self._raw[k], self.message, cdr=self.cdr)
        except ValueError as error:
            found = f"it is no {self.message.name}: {error}"
            expected = "messages as their definition says; is the bag damaged?"
            number = self.count + k + 1
            raise topic_error(self.path, self.topic, found, expected, number) from error
        if sum(map(len, self._shapes.values())) >= MAX_SHAPES:
            self._shapes.clear()
        known = shape, [pick.located(shape) for pick in self.picks]
        self._shapes.setdefault(shape.size, []).append(known)
        return known


def topic_error(
    path: Path, topic: str, found: str, expected: str, message: int | None = None
) -> DataError:
    """The error about a topic, or about one of its messages, counted from 1."""
    where = f"{path} topic '{topic}'" + ("" if message is None else f" message {message}")
    return bad_data(where, found, expected)


def _taken(
    block: UInt8[np.ndarray, "message byte"],
    received: Int[np.ndarray, " message"],
    number: Int[np.ndarray, " message"],
    located: Located,
) -> _Rows:
    """The wanted numbers of some messages of one shape."""
    columns = [np.zeros(len(block)) if p is None else p.of(block) for p in located.numbers]
    absent = np.tile([place is None for place in located.numbers], (len(block), 1))
    stamp = None
    if located.seconds is not None and located.nanoseconds is not None:
        stamp = located.seconds.whole(block) * 10**9 + located.nanoseconds.whole(block)
    return _Rows(stamp, received, number, np.column_stack(columns), absent)
