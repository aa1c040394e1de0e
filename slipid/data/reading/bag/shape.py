"""Positions of numbers in the bytes of serialised messages.

Most messages of a topic have the same shape: equal texts, and arrays of equal lengths. So one
message is decoded field by field, and the numbers of all others with the same shape are taken from
the same byte positions, thousands of messages at a time.

Numbers are picked by paths of fields, by names of joints, or by frames of a transform.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from slipid.data.reading.bag.definitions import (
    ArrayType,
    FieldType,
    MessageType,
    NumberType,
    TextType,
)


@dataclass(frozen=True)
class PathStep:
    """One step of a path: the name of a field, and the index of an element or None for all."""

    name: str
    index: int | None = None


@dataclass(frozen=True)
class BytePlace:
    """Position of a number in a message: its first byte, and its numpy type with byte order."""

    offset: int
    dtype: str

    def of(self, block: UInt8[np.ndarray, "message byte"]) -> Float[np.ndarray, " message"]:
        """Return the number in each message of a block, all of one shape."""
        return self._cells(block).astype(float)

    def whole(self, block: UInt8[np.ndarray, "message byte"]) -> Int[np.ndarray, " message"]:
        """Return the whole number in each message of a block, without rounding."""
        return self._cells(block).astype(np.int64)

    def _cells(self, block: UInt8[np.ndarray, "message byte"]) -> np.ndarray:
        """Return the number in each message, with the type that it has in the message."""
        cells = np.ascontiguousarray(block[:, self.offset : self.offset + int(self.dtype[2:])])
        return cells.view(self.dtype)[:, 0]


@dataclass(frozen=True)
class MessageLeaf:
    """A number, an array of numbers or a text at one path of a message.

    Attributes:
        path: path in the message.
        dtype: numpy type of the numbers, with byte order; empty for a text.
        offset: position of the first byte.
        count: number of elements of an array; None for a single number or a text.
        text: content of a text; empty for numbers.
    """

    path: tuple[PathStep, ...]
    dtype: str
    offset: int
    count: int | None = None
    text: str = ""

    def places(self, index: int | None) -> tuple[BytePlace, ...]:
        """Return the places of all numbers, or only of the one with an index."""
        size = int(self.dtype[2:])
        every = range(1 if self.count is None else self.count)
        if index is not None:
            every = every[index : index + 1]
        return tuple(BytePlace(self.offset + k * size, self.dtype) for k in every)


@dataclass(frozen=True, eq=False)
class MessageShape:
    """Byte layout that many messages of a topic have in common.

    Attributes:
        size: number of bytes of a message.
        leaves: all numbers, arrays and texts, in the order of the bytes.
        fixed: positions of the bytes that are equal in all messages of this shape: those of texts
            and of lengths of arrays.
        values: values of these bytes.
    """

    size: int
    leaves: tuple[MessageLeaf, ...]
    fixed: Int[np.ndarray, " fixed"]
    values: UInt8[np.ndarray, " fixed"]

    def fits(self, block: UInt8[np.ndarray, "message byte"]) -> Bool[np.ndarray, " message"]:
        """Return whether each of some messages, all of this shape's size, has this shape."""
        return np.all(block[:, self.fixed] == self.values, axis=1)

    def places(self, path: Sequence[PathStep]) -> tuple[BytePlace, ...]:
        """Return the places of the numbers at a path; empty if there are none."""
        return tuple(p for leaf, index in self._at(path) if leaf.dtype for p in leaf.places(index))

    def texts(self, path: Sequence[PathStep]) -> tuple[str, ...]:
        """Return the texts at a path."""
        return tuple(leaf.text for leaf, _ in self._at(path) if not leaf.dtype)

    def count(self, path: Sequence[PathStep]) -> int:
        """Return the number of numbers or texts at a path."""
        return sum(1 if leaf.count is None else leaf.count for leaf, _ in self._at(path))

    def _at(self, path: Sequence[PathStep]) -> list[tuple[MessageLeaf, int | None]]:
        """Return the leaves at a path, each with the index of an array element or None for all."""
        found = []
        for leaf in self._by_names.get(tuple(step.name for step in path), ()):
            ends = zip(leaf.path[:-1], path[:-1], strict=True)
            inner = all(want.index in (None, have.index) for have, want in ends)
            own, want = leaf.path[-1].index, path[-1].index
            if inner and leaf.count is not None:
                found.append((leaf, want))
            elif inner and want in (None, own):
                found.append((leaf, None))
        return found

    @cached_property
    def _by_names(self) -> dict[tuple[str, ...], list[MessageLeaf]]:
        leaves: dict[tuple[str, ...], list[MessageLeaf]] = {}
        for leaf in self.leaves:
            leaves.setdefault(tuple(step.name for step in leaf.path), []).append(leaf)
        return leaves


def steps_of(path: str) -> tuple[PathStep, ...]:
    """Return the steps of a path such as `motors[0].current`.

    Raises:
        ValueError: the text is not such a path.
    """
    steps = []
    for part in path.split("."):
        name, bracket, rest = part.partition("[")
        index, end, after = rest.partition("]")
        whole = not bracket or (bool(end) and not after and index.isdecimal())
        if not (name.isidentifier() and whole):
            raise ValueError(f"no path of a field: '{path}'; expected such as motors[0].current")
        steps.append(PathStep(name, int(index) if bracket else None))
    return tuple(steps)


def shape_of(raw: bytes, message: MessageType, *, cdr: bool) -> MessageShape:
    """Return the shape of one message.

    Args:
        raw: bytes of the message.
        message: type of the message.
        cdr: whether the message is serialised as in ROS 2 (CDR), not as in ROS 1.

    Raises:
        ValueError: the bytes are not a message of this type; the text says why.
    """
    walk = _MessageWalk(raw, cdr)
    walk.through(message, ())
    over = len(raw) - walk.at
    if not 0 <= over < (4 if cdr else 1):
        raise ValueError(f"{over} bytes are left over after its last field")
    fixed = np.concatenate([np.arange(0), *(np.arange(a, b) for a, b in walk.fixed)])
    values = np.frombuffer(raw, np.uint8)[fixed]
    return MessageShape(len(raw), tuple(walk.leaves), fixed, values)


class _MessageWalk:
    """Decoder that goes through the bytes of one message and collects its leaves.

    Attributes:
        raw: bytes of the message.
        cdr: whether the message is serialised as in ROS 2 (CDR).
        order: byte order of numbers, `<` or `>`.
        at: position of the next byte.
        origin: position from which alignment counts.
        leaves: leaves found so far.
        fixed: ranges of bytes of texts and lengths found so far.
    """

    def __init__(self, raw: bytes, cdr: bool) -> None:
        self.raw, self.cdr, self.order = raw, cdr, "<"
        self.at = self.origin = 0
        self.leaves: list[MessageLeaf] = []
        self.fixed: list[tuple[int, int]] = []
        if cdr:
            if raw[:2] not in (b"\x00\x00", b"\x00\x01") or len(raw) < 4:
                raise ValueError(f"it is not serialised as CDR (it starts with {raw[:4].hex(' ')})")
            self.order = "<" if raw[1] else ">"
            self.at = self.origin = 4
            self.fixed.append((0, 2))

    def through(self, kind: FieldType, path: tuple[PathStep, ...]) -> None:
        """Collect the leaves of a field."""
        if isinstance(kind, NumberType):
            dtype = self.order + kind.dtype
            self.leaves.append(MessageLeaf(path, dtype, self.numbers(kind.size, 1)))
        elif isinstance(kind, TextType):
            self.leaves.append(MessageLeaf(path, "", self.at, None, self.text()))
        elif isinstance(kind, MessageType):
            for field in kind.fields:
                self.through(field.kind, (*path, PathStep(field.name)))
        else:
            self.several(kind, path)

    def several(self, kind: ArrayType, path: tuple[PathStep, ...]) -> None:
        """Collect the leaves of an array."""
        count = self.length() if kind.count is None else kind.count
        if isinstance(kind.element, NumberType):
            dtype = self.order + kind.element.dtype
            at = self.numbers(kind.element.size, count)
            self.leaves.append(MessageLeaf(path, dtype, at, count))
            return
        if count > len(self.raw) - self.at:
            raise ValueError(f"it ends before the {count} elements of '{path[-1].name}'")
        *before, last = path
        for k in range(count):
            self.through(kind.element, (*before, PathStep(last.name, k)))

    def numbers(self, size: int, count: int) -> int:
        """Skip some numbers, aligned as CDR demands, and return the position of their first byte.

        Args:
            size: bytes of one number.
            count: number of numbers.
        """
        if count and self.cdr:
            self.at += -(self.at - self.origin) % size
        first = self.at
        self.at += size * count
        if self.at > len(self.raw):
            raise ValueError(f"it ends after {len(self.raw)} bytes, within its fields")
        return first

    def length(self) -> int:
        """Return the length of an array or a text, which comes next, and go past it."""
        at = self.numbers(4, 1)
        self.fixed.append((at, at + 4))
        return int(struct.unpack_from(self.order + "I", self.raw, at)[0])

    def text(self) -> str:
        """Return the text that comes next, and go past it."""
        size = self.length()
        at = self.numbers(1, size)
        self.fixed.append((at, at + size))
        text = self.raw[at : at + size]
        # In CDR a text ends with a zero byte, which its length includes.
        return (text[:-1] if self.cdr else text).decode(errors="replace")


_STAMPS = ("header.stamp", "stamp")
"""Paths at which a message may have its own time."""
POSITION = ("translation.x", "translation.y", "translation.z")
ROTATION = ("rotation.x", "rotation.y", "rotation.z", "rotation.w")


@dataclass(frozen=True)
class Located:
    """Places of the picked numbers in messages of one shape.

    Attributes:
        seconds: place of the seconds of the message's own time, None if it has none.
        nanoseconds: place of the nanoseconds of the message's own time, None if it has none.
        numbers: places of the picked numbers in order, None for a number that is not in these
            messages.
    """

    seconds: BytePlace | None
    nanoseconds: BytePlace | None
    numbers: tuple[BytePlace | None, ...]

    def stamp(self, block: UInt8[np.ndarray, "message byte"]) -> Int[np.ndarray, " message"] | None:
        """Return the messages' own times [ns], or None if they have none."""
        if self.seconds is None or self.nanoseconds is None:
            return None
        return self.seconds.whole(block) * 10**9 + self.nanoseconds.whole(block)


@runtime_checkable
class Pick(Protocol):
    """Rule that picks numbers from the messages of a topic.

    A message yields any number of rows: for example none if it lacks the numbers.
    """

    def located(self, shape: MessageShape) -> tuple[Located, ...]:
        """Return the places of the numbers of each row in a message of a shape."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the name of each number in a row; it may be empty before the first message."""


@dataclass(eq=False)
class FieldPick:
    """Pick of numbers by the paths of their fields; a path to an array picks all its elements.

    Attributes:
        paths: paths of the fields.
        names: names of the numbers, set by the first message with numbers.
    """

    paths: tuple[str, ...]
    names: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        return self.names or self.paths

    def located(self, shape: MessageShape) -> tuple[Located, ...]:
        numbers: list[BytePlace] = []
        names: list[str] = []
        for path in self.paths:
            places = shape.places(steps_of(path))
            numbers += places
            names += [path] if len(places) == 1 else [f"{path}[{k}]" for k in range(len(places))]
        if not numbers:
            return ()
        self.names = self.names or tuple(names)
        return (located_with_time(shape, (), numbers),)


@dataclass(eq=False)
class JointPick:
    """Pick of numbers by the names of joints, from messages like JointState.

    Attributes:
        joints: names of the picked joints, in the order of the columns.
        array: array with the numbers: `position`, `velocity` or `effort`.
        names: all names of joints that have occurred in some message.
    """

    joints: tuple[str, ...]
    array: str
    names: dict[str, None] = field(default_factory=dict)

    @property
    def columns(self) -> tuple[str, ...]:
        return self.joints

    def located(self, shape: MessageShape) -> tuple[Located, ...]:
        names = shape.texts((PathStep("name"),))
        self.names.update(dict.fromkeys(names))
        places = shape.places((PathStep(self.array),))
        # The array may be empty; an array of another length does not match the names.
        have = dict(zip(names, places, strict=True)) if len(places) == len(names) else {}
        numbers = [have.get(joint) for joint in self.joints]
        if not any(numbers):
            return ()
        return (located_with_time(shape, (), numbers),)


@dataclass(frozen=True)
class Edge:
    """Names of the frames of a transform, which is the pose of frame `child` in frame `parent`."""

    parent: str
    child: str


@dataclass(frozen=True, eq=False)
class TransformPick:
    """Pick of the translation and rotation of one transform from messages with several of them.

    The message type is TFMessage.
    """

    edge: Edge

    @property
    def columns(self) -> tuple[str, ...]:
        return (*POSITION, *ROTATION)

    def located(self, shape: MessageShape) -> tuple[Located, ...]:
        rows = []
        for k, edge in enumerate(edges_of(shape)):
            if edge == self.edge:
                first = (PathStep("transforms", k),)
                paths = [(*first, *steps_of(f"transform.{name}")) for name in self.columns]
                numbers = [place for path in paths for place in shape.places(path)]
                rows.append(located_with_time(shape, first, numbers))
        return tuple(rows)


def edges_of(shape: MessageShape) -> tuple[Edge, ...]:
    """Return the frames of every transform in a TFMessage.

    The leading slash that names have in early ROS 1 is removed.
    """
    parents = shape.texts(steps_of("transforms.header.frame_id"))
    children = shape.texts(steps_of("transforms.child_frame_id"))
    pairs = zip(parents, children, strict=True)
    return tuple(Edge(parent.lstrip("/"), child.lstrip("/")) for parent, child in pairs)


def located_with_time(
    shape: MessageShape, first: tuple[PathStep, ...], numbers: Sequence[BytePlace | None]
) -> Located:
    """Return the places of picked numbers, with that of their time.

    The time is that of the message, or of the part of it at the path `first`.
    """
    for stamp in _STAMPS:
        whole, part = (
            shape.places((*first, *steps_of(f"{stamp}.{unit}"))) for unit in ("sec", "nanosec")
        )
        if len(whole) == len(part) == 1:
            return Located(whole[0], part[0], tuple(numbers))
    return Located(None, None, tuple(numbers))
