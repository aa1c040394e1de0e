"""Collection of the picked numbers of a topic's messages, batch by batch, in arrays.

The messages themselves are not kept in memory.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from slipid.data.reading.bag.definitions import MessageType
from slipid.data.reading.bag.opened import MessageBatch
from slipid.data.reading.bag.shape import Located, MessageShape, Pick, shape_of
from slipid.support.errors import DataError, bad_data

MAX_SHAPES = 256
"""Largest number of known shapes of a topic; when it is reached, all are forgotten, to save memory
and time."""
FEW_SHAPES = 16
"""Number of new shapes in a batch with which all its messages are compared; after these, every
message is decoded on its own."""


@dataclass(frozen=True, eq=False)
class Stream:
    """Rows of numbers from the messages of a topic, in the order of receipt.

    Attributes:
        path: path of the bag.
        topic: name of the topic.
        columns: name of each number in a row.
        stamp: the messages' own times [ns], or None if they have none.
        received: times at which the recorder received the messages [ns].
        number: number of the row's message in its topic, from 1.
        values: numbers as in the messages, 0 where absent.
        absent: True for numbers that the message does not have, such as those of other joints.
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
        """Return the error about a row, counted from 0, or (None) about the topic."""
        message = None if row is None else int(self.number[row])
        return topic_error(self.path, self.topic, found, expected, message)

    def part(self, which: Int[np.ndarray, " part"] | Bool[np.ndarray, " row"]) -> "Stream":
        """Return the selected rows."""
        return replace(
            self,
            stamp=None if self.stamp is None else self.stamp[which],
            received=self.received[which],
            number=self.number[which],
            values=self.values[which],
            absent=self.absent[which],
        )


@dataclass(frozen=True, eq=False)
class _KnownShape:
    """A shape that has occurred before, and for each pick the places of its rows of numbers."""

    shape: MessageShape
    places: tuple[tuple[Located, ...], ...]


@dataclass(frozen=True, eq=False)
class _SameShape:
    """Messages of one shape in a batch.

    Attributes:
        which: indices of the messages in the batch.
        block: bytes of the messages.
        places: for each pick the places of its rows of numbers.
    """

    which: Int[np.ndarray, " message"]
    block: UInt8[np.ndarray, "message byte"]
    places: tuple[tuple[Located, ...], ...]


class TopicStreams:
    """Collector of the picked numbers in the messages of one topic."""

    def __init__(
        self, path: Path, topic: str, message: MessageType, picks: Sequence[Pick], *, cdr: bool
    ) -> None:
        self.path, self.topic, self.message, self.cdr = path, topic, message, cdr
        self.picks = tuple(picks)
        self.count = 0
        self._rows: list[list[Stream]] = [[] for _ in self.picks]
        self._shapes: dict[int, list[_KnownShape]] = {}

    def add(self, batch: MessageBatch) -> None:
        """Add the numbers in the next messages of the topic."""
        if set(map(type, batch.data)) != {bytes}:
            raise topic_error(self.path, self.topic, "a message that is no bytes", "a whole bag")
        received = np.array(batch.received, dtype=np.int64)
        numbers = self.count + 1 + np.arange(len(received))
        for same in self._by_shape(batch.data):
            when, number = received[same.which], numbers[same.which]
            for pick, rows, located in zip(self.picks, self._rows, same.places, strict=True):
                rows += [self._taken(pick, same.block, when, number, place) for place in located]
        self.count += len(received)

    def stream(self, pick: Pick) -> Stream:
        """Return all rows collected so far for one of the picks."""
        parts = self._rows[self.picks.index(pick)]
        widths = {part.values.shape[1] for part in parts}
        if len(widths) > 1:
            first = parts[0]
            other = next(p for p in parts if p.values.shape[1] != first.values.shape[1])
            found = f"{other.values.shape[1]} numbers, and {first.values.shape[1]} of them before"
            expected = "as many in every message; name one by its index, such as [0]?"
            raise topic_error(self.path, self.topic, found, expected, int(other.number[0]))
        number = _concatenated([part.number for part in parts], np.zeros(0, dtype=np.int64))
        stamps = [part.stamp for part in parts if part.stamp is not None]
        empty = np.zeros((0, len(pick.columns)))
        stream = Stream(
            path=self.path,
            topic=self.topic,
            columns=pick.columns,
            stamp=np.concatenate(stamps) if stamps and len(stamps) == len(parts) else None,
            received=_concatenated([part.received for part in parts], number),
            number=number,
            values=_concatenated([part.values for part in parts], empty),
            absent=_concatenated([part.absent for part in parts], empty.astype(bool)),
        )
        # Rows were appended shape by shape, and transform by transform, not in order of messages.
        in_order = (np.diff(number) >= 0).all()
        return stream if in_order else stream.part(np.argsort(number, kind="stable"))

    def _by_shape(self, data: Sequence[bytes]) -> Iterator[_SameShape]:
        """Yield the messages of a batch, grouped by their shape."""
        lengths = np.fromiter(map(len, data), np.int64, len(data))
        for length in np.unique(lengths).tolist():
            rest = np.flatnonzero(lengths == length)
            joined = b"".join(data if len(rest) == len(data) else [data[int(k)] for k in rest])
            block = np.frombuffer(joined, np.uint8).reshape(len(rest), length)
            known, new = list(self._shapes.get(length, ())), 0
            while len(rest):
                if known:
                    one = known.pop(0)
                else:
                    row = int(rest[0])
                    one, new = self._known(data[row], self.count + row + 1), new + 1
                same = one.shape.fits(block) if new <= FEW_SHAPES else np.arange(len(rest)) == 0
                if same.all():
                    yield _SameShape(rest, block, one.places)
                    break
                if same.any():
                    yield _SameShape(rest[same], block[same], one.places)
                    rest, block = rest[~same], block[~same]

    def _known(self, data: bytes, number: int) -> _KnownShape:
        """Return the shape of a message, and add it to the known shapes.

        `number` is the number of the message in its topic, for errors.
        """
        try:
            shape = shape_of(data, self.message, cdr=self.cdr)
        except ValueError as error:
            found = f"it is no {self.message.name}: {error}"
            expected = "messages as their definition says; is the bag damaged?"
            raise topic_error(self.path, self.topic, found, expected, number) from error
        if sum(map(len, self._shapes.values())) >= MAX_SHAPES:
            self._shapes.clear()
        known = _KnownShape(shape, tuple(pick.located(shape) for pick in self.picks))
        self._shapes.setdefault(shape.size, []).append(known)
        return known

    def _taken(
        self,
        pick: Pick,
        block: UInt8[np.ndarray, "message byte"],
        received: Int[np.ndarray, " message"],
        number: Int[np.ndarray, " message"],
        located: Located,
    ) -> Stream:
        """Return a row of picked numbers for each of some messages of one shape."""
        columns = [np.zeros(len(block)) if p is None else p.of(block) for p in located.numbers]
        absent = np.tile([place is None for place in located.numbers], (len(block), 1))
        where = (self.path, self.topic, pick.columns)
        values = np.column_stack(columns)
        return Stream(*where, located.stamp(block), received, number, values, absent)


def _concatenated(parts: Sequence[np.ndarray], none: np.ndarray) -> np.ndarray:
    """Return arrays end to end, or `none` if there are no arrays."""
    return np.concatenate(parts) if parts else none


def topic_error(
    path: Path, topic: str, found: str, expected: str, message: int | None = None
) -> DataError:
    """Return the error about a topic, or about one of its messages, counted from 1."""
    where = f"{path} topic '{topic}'" + ("" if message is None else f" message {message}")
    return bad_data(where, found, expected)
