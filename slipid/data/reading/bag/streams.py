"""Collection of picked numbers from the messages of a topic, batch by batch, in arrays.

Numbers are picked by paths of fields, by names of joints, or by frames of a transform. The messages
themselves are not kept in memory.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from slipid.data.reading.bag.opened import BagTopic, OpenBag
from slipid.data.reading.bag.shape import BytePlace, MessageShape
from slipid.support.errors import DataError

BATCH_BYTES = 1 << 20
"""Size of the messages of one topic that are processed together [byte]."""
MAX_SHAPES = 256
"""Largest number of remembered byte layouts of a topic; when it is reached, all are discarded, to
save memory and time."""
FEW_SHAPES = 16
"""Largest number of new byte layouts, per batch and message size, with which all remaining messages
are compared; when it is exceeded, every message is decoded separately."""
STAMPS = ("header.stamp", "stamp")
"""Paths at which a message may have a time stamp."""
POSITION = ("translation.x", "translation.y", "translation.z")
ROTATION = ("rotation.x", "rotation.y", "rotation.z", "rotation.w")


class Edge(NamedTuple):
    """Names of the two frames of a transform, the pose of frame `child` in frame `parent`."""

    parent: str
    child: str


def edges_of(shape: MessageShape) -> tuple[Edge, ...]:
    """Return the frames of every transform in a TFMessage.

    The leading slash that names have in early ROS 1 is removed.
    """
    parents = shape.texts("transforms.header.frame_id")
    children = shape.texts("transforms.child_frame_id")
    pairs = zip(parents, children, strict=False)  # a damaged definition may lack one of both
    return tuple(Edge(parent.lstrip("/"), child.lstrip("/")) for parent, child in pairs)


@dataclass(frozen=True)
class Located:
    """Byte offsets of the picked numbers in messages with one byte layout.

    Attributes:
        time: offsets of the seconds and nanoseconds of the message's time stamp; None if it has no
            stamp.
        numbers: offsets of the picked numbers in order; None for a number that is not in these
            messages.
    """

    time: tuple[BytePlace, BytePlace] | None
    numbers: tuple[BytePlace | None, ...]

    @classmethod
    def of(
        cls, shape: MessageShape, numbers: Sequence[BytePlace | None] = (), part: str = ""
    ) -> "Located":
        """Return the byte offsets of the numbers and time stamp in messages with this byte layout.

        `part` is the path of the part of the message that has the stamp, followed by a dot; it is
        empty for the whole message.
        """
        for stamp in STAMPS:
            places = [
                p for unit in ("sec", "nanosec") for p in shape.places(f"{part}{stamp}.{unit}")
            ]
            if len(places) == 2:
                return cls((places[0], places[1]), tuple(numbers))
        return cls(None, tuple(numbers))

    def stamp(self, block: UInt8[np.ndarray, "message byte"]) -> Int[np.ndarray, " message"] | None:
        """Return the time stamps of the messages [ns], or None if they have none."""
        if self.time is None:
            return None
        seconds, nanoseconds = (place.of(block, np.int64) for place in self.time)
        return seconds * 10**9 + nanoseconds


@dataclass(eq=False)
class FieldPick:
    """Pick of numbers by the paths of their fields; a path to an array picks all its elements.

    Attributes:
        paths: paths of the fields.
        columns: names of the numbers; the paths until `located` has found numbers in a message.
    """

    paths: tuple[str, ...]
    columns: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        self.columns = self.paths

    def located(self, shape: MessageShape) -> tuple[Located, ...]:
        """Return a `Located` for each row of numbers in messages with this byte layout."""
        each = {path: shape.places(path) for path in self.paths}
        numbers = [place for places in each.values() for place in places]
        if not numbers:
            return ()
        self.columns = tuple(
            path if len(places) == 1 else f"{path}[{k}]"
            for path, places in each.items()
            for k in range(len(places))
        )
        return (Located.of(shape, numbers),)


@dataclass(frozen=True, eq=False)
class JointPick:
    """Pick of numbers by the names of joints, from messages like JointState.

    Attributes:
        columns: names of the picked joints.
        array: array with the numbers: `position`, `velocity` or `effort`.
        names: all names of joints that have occurred in some message.
    """

    columns: tuple[str, ...]
    array: str
    names: dict[str, None] = field(default_factory=dict)

    def located(self, shape: MessageShape) -> tuple[Located, ...]:
        """Return a `Located` for each row of numbers in messages with this byte layout."""
        names, places = shape.texts("name"), shape.places(self.array)
        self.names.update(dict.fromkeys(names))
        # An array with another length than the names, such as an empty one, cannot be assigned to
        # them and is not used.
        have = dict(zip(names, places, strict=True)) if len(places) == len(names) else {}
        numbers = [have.get(joint) for joint in self.columns]
        return (Located.of(shape, numbers),) if any(numbers) else ()


@dataclass(frozen=True, eq=False)
class TransformPick:
    """Pick of the translation and rotation of one transform from messages with several of them.

    The message type is TFMessage.
    """

    edge: Edge
    columns: tuple[str, ...] = (*POSITION, *ROTATION)

    def located(self, shape: MessageShape) -> tuple[Located, ...]:
        """Return a `Located` for each row of numbers in messages with this byte layout."""
        rows = []
        for k, edge in enumerate(edges_of(shape)):
            if edge == self.edge:
                part = f"transforms[{k}]."
                paths = (f"{part}transform.{name}" for name in self.columns)
                numbers = [place for path in paths for place in shape.places(path)]
                rows.append(Located.of(shape, numbers, part))
        return tuple(rows)


Pick = FieldPick | JointPick | TransformPick
"""Rule that picks numbers from the messages of a topic. A message may yield several rows, or none
if it does not have the numbers."""
_Places = list[tuple[Located, ...]]
"""For each pick, the byte offsets of its rows of numbers in messages with one byte layout."""


@dataclass(frozen=True, eq=False)
class Stream:
    """Rows of numbers from the messages of a topic, in the order of receipt.

    Attributes:
        topic: the topic.
        columns: name of each number in a row.
        time: times on the clock that the layout selects [ns].
        delay: median time from the messages' own stamps to their receipt [s], None without stamps.
        number: number of the row's message in its topic, from 1.
        values: numbers as in the messages, 0 where absent.
        absent: True for numbers that the message does not have, such as those of other joints.
    """

    topic: BagTopic
    columns: tuple[str, ...]
    time: Int[np.ndarray, " row"]
    delay: float | None
    number: Int[np.ndarray, " row"]
    values: Float[np.ndarray, "row column"]
    absent: Bool[np.ndarray, "row column"]

    def error(self, found: str, expected: str, row: int | None = None) -> DataError:
        """Return the error about a row, counted from 0, or about the topic if `row` is None."""
        return self.topic.error(found, expected, None if row is None else int(self.number[row]))

    def part(self, which: Int[np.ndarray, " part"] | Bool[np.ndarray, " row"]) -> "Stream":
        """Return the selected rows."""
        names = ("time", "number", "values", "absent")
        return replace(self, **{name: getattr(self, name)[which] for name in names})


def collected(
    bag: OpenBag, picks: Mapping[str, Sequence[Pick]], stamp: Literal["header", "received"]
) -> dict[Pick, Stream]:
    """Return the numbers of all picks, from one pass over the bag.

    Args:
        bag: the bag.
        picks: picks, keyed by the name of their topic.
        stamp: "header" for times from the stamps in the messages, where messages have stamps;
            "received" for the times of receipt.
    """
    topics = {name: _Collector(bag.topics[name], few) for name, few in picks.items()}
    for name, received, data in bag.messages(tuple(topics)):
        topics[name].add(received, data)
    return {
        pick: one.stream(k, stamp == "header")
        for one in topics.values()
        for k, pick in enumerate(one.picks)
    }


class _Rows(NamedTuple):
    """Rows of numbers from messages with one byte layout.

    `stamp` is the time stamp of each row's message [ns], or None; `received` is its time of receipt
    [ns], and `number` its number in the topic, from 1.
    """

    stamp: Int[np.ndarray, " row"] | None
    received: Int[np.ndarray, " row"]
    number: Int[np.ndarray, " row"]
    values: Float[np.ndarray, "row column"]
    absent: Bool[np.ndarray, "row column"]


class _Collector:
    """Collector of the picked numbers in the messages of one topic."""

    def __init__(self, topic: BagTopic, picks: Sequence[Pick]) -> None:
        self.topic, self.picks = topic, picks
        self._count = 0
        self._received: list[int] = []
        self._data: list[bytes] = []
        self._room = BATCH_BYTES
        self._rows: list[list[_Rows]] = [[] for _ in picks]
        self._shapes: dict[int, list[tuple[MessageShape, _Places]]] = {}

    def add(self, received: int, data: bytes) -> None:
        """Add the next message of the topic."""
        self._received.append(received)
        self._data.append(data)
        self._room -= len(data)
        if self._room < 0:
            self._take()

    def stream(self, pick: int, stamped: bool) -> Stream:
        """Return all rows of the pick with the index `pick`, in the order of the messages.

        Their times are the stamps if `stamped` is True and every message has one, else the times of
        receipt.
        """
        self._take()
        columns, none = self.picks[pick].columns, np.zeros(0, dtype=np.int64)
        empty = np.zeros((0, len(columns)))
        parts = self._rows[pick] or [_Rows(None, none, none, empty, empty.astype(bool))]
        width = parts[0].values.shape[1]
        for part in parts:
            if part.values.shape[1] != width:
                found = f"{part.values.shape[1]} numbers, but {width} in earlier messages"
                expected = "the same number in every message; select one by its index, such as [0]?"
                raise self.topic.error(found, expected, int(part.number[0]))
        stamps, *columns_of_rows = zip(*parts, strict=True)
        received, number, values, absent = map(np.concatenate, columns_of_rows)
        stamp = None if any(one is None for one in stamps) else np.concatenate(stamps)
        delay = None if stamp is None else float(np.median(received - stamp)) / 1e9
        time = stamp if stamped and stamp is not None else received
        stream = Stream(self.topic, columns, time, delay, number, values, absent)
        # Rows were appended by byte layout, and transform by transform, so they may have to be
        # sorted into the order of the messages.
        in_order = (np.diff(number) >= 0).all()
        return stream if in_order else stream.part(np.argsort(number, kind="stable"))

    def _take(self) -> None:
        """Extract the picked numbers from the waiting messages, and discard these messages."""
        received = np.array(self._received, dtype=np.int64)
        for which, block, places in self._by_shape():
            number = self._count + 1 + which
            for rows, each in zip(self._rows, places, strict=True):
                for one in each:
                    values = [
                        np.zeros(len(block)) if p is None else p.of(block) for p in one.numbers
                    ]
                    absent = np.tile([place is None for place in one.numbers], (len(block), 1))
                    when = one.stamp(block), received[which], number
                    rows.append(_Rows(*when, np.column_stack(values), absent))
        self._count += len(received)
        self._received, self._data, self._room = [], [], BATCH_BYTES

    def _by_shape(self) -> Iterator[tuple[np.ndarray, np.ndarray, _Places]]:
        """Yield the waiting messages grouped by byte layout.

        Each group is given by the messages' indices, their bytes, and the numbers' byte offsets.
        """
        lengths = np.fromiter(map(len, self._data), np.int64, len(self._data))
        for length in np.unique(lengths).tolist():
            rest = np.flatnonzero(lengths == length)
            joined = b"".join(self._data[int(k)] for k in rest)
            block = np.frombuffer(joined, np.uint8).reshape(len(rest), length)
            known, new = list(self._shapes.get(length, ())), 0
            while len(rest):
                if known:
                    shape, places = known.pop(0)
                else:
                    (shape, places), new = self._known(int(rest[0])), new + 1
                same = shape.fits(block) if new <= FEW_SHAPES else np.arange(len(rest)) == 0
                if same.any():
                    yield rest[same], block[same], places
                rest, block = rest[~same], block[~same]

    def _known(self, k: int) -> tuple[MessageShape, _Places]:
        """Return and remember the byte layout of waiting message k, and its numbers' offsets."""
        shape = self.topic.shape(self._data[k], self._count + 1 + k)
        if sum(map(len, self._shapes.values())) >= MAX_SHAPES:
            self._shapes.clear()
        known = shape, [pick.located(shape) for pick in self.picks]
        self._shapes.setdefault(shape.size, []).append(known)
        return known
