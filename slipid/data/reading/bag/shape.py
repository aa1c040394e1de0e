"""Byte offsets of the numbers in serialised messages.

Most messages of a topic have the same byte layout: their strings are equal, and their arrays have
equal lengths. So one message is decoded field by field, and the numbers of all other messages with
the same byte layout are taken from the same offsets, thousands of messages at a time.

A path names a field, such as `motors[0].current`; a path to an array without an index stands for
all elements.
"""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Int, Num, UInt8

from slipid.data.reading.bag.definitions import TEXT, ArrayType, FieldType, MessageType

_PATH = re.compile(r"[^\W\d]\w*(\[\d+\])?(\.[^\W\d]\w*(\[\d+\])?)*")


def check_path(path: str) -> None:
    """Raise `ValueError` if a string is not a path of a field."""
    if not _PATH.fullmatch(path):
        raise ValueError(
            f"not a path of a field: '{path}'; expected a path such as motors[0].current"
        )


def without_indices(path: str) -> str:
    """Return a path without its indices."""
    return re.sub(r"\[\d+\]", "", path)


@dataclass(frozen=True)
class BytePlace:
    """Offset of a number's first byte in a message, and its numpy type with byte order."""

    offset: int
    dtype: str

    def of(
        self, block: UInt8[np.ndarray, "message byte"], kind: type = float
    ) -> Num[np.ndarray, " message"]:
        """Return the number in each message of a block, converted to the type `kind`.

        All messages of the block have the same byte layout.
        """
        cells = np.ascontiguousarray(block[:, self.offset : self.offset + int(self.dtype[2:])])
        return cells.view(self.dtype)[:, 0].astype(kind)


@dataclass(frozen=True)
class MessageLeaf:
    """A number, an array of numbers or a string at one path of a message.

    Attributes:
        path: path in the message, such as `poses[2].name`. Arrays of messages or strings have one
            leaf per element, with its index; an array of numbers is one leaf, without an index.
        dtype: numpy type of the numbers, with byte order; empty for a string.
        offset: offset of the first byte in the message.
        count: number of elements of an array; None for a single number or a string.
        text: content of a string; empty for numbers.
    """

    path: str
    dtype: str
    offset: int
    count: int | None = None
    text: str = ""

    def numbers(self) -> Iterator[tuple[str, BytePlace]]:
        """Yield the path of every number, with its byte offset and type."""
        if self.count is None:
            yield self.path, BytePlace(self.offset, self.dtype)
        for k in range(self.count or 0):
            place = BytePlace(self.offset + k * int(self.dtype[2:]), self.dtype)
            yield f"{self.path}[{k}]", place


@dataclass(frozen=True, eq=False)
class MessageShape:
    """Byte layout that many messages of a topic have in common.

    Attributes:
        size: number of bytes of a message.
        leaves: all numbers, arrays and strings, in the order of the bytes.
        fixed: offsets of the bytes that are equal in all messages with this byte layout: the bytes
            of strings and of array lengths.
        values: values of these bytes.
    """

    size: int
    leaves: tuple[MessageLeaf, ...]
    fixed: Int[np.ndarray, " fixed"]
    values: UInt8[np.ndarray, " fixed"]

    def fits(self, block: UInt8[np.ndarray, "message byte"]) -> Bool[np.ndarray, " message"]:
        """Return whether each message of a block, all of size `size`, has this byte layout."""
        return np.all(block[:, self.fixed] == self.values, axis=1)

    def places(self, path: str) -> tuple[BytePlace, ...]:
        """Return the byte offset and type of each number at a path; empty if there is none."""
        leaves = (leaf for leaf in self._near(path) if leaf.dtype)
        return tuple(p for leaf in leaves for at, p in leaf.numbers() if _within(at, path))

    def texts(self, path: str) -> tuple[str, ...]:
        """Return the strings at a path."""
        leaves = (leaf for leaf in self._near(path) if not leaf.dtype)
        return tuple(leaf.text for leaf in leaves if _within(leaf.path, path))

    def count(self, path: str) -> int:
        """Return how many numbers or strings there are at a path without indices."""
        return sum(1 if leaf.count is None else leaf.count for leaf in self._near(path))

    def _near(self, path: str) -> list[MessageLeaf]:
        """Return the leaves whose paths differ from the given path in nothing but indices."""
        return self._by_path.get(without_indices(path), [])

    @cached_property
    def _by_path(self) -> dict[str, list[MessageLeaf]]:
        leaves: dict[str, list[MessageLeaf]] = {}
        for leaf in self.leaves:
            leaves.setdefault(without_indices(leaf.path), []).append(leaf)
        return leaves


def _within(path: str, other: str) -> bool:
    """Return whether a path has every index that another path to the same field gives."""
    steps = zip(path.split("."), other.split("."), strict=True)
    return all(want in (have, have.partition("[")[0]) for have, want in steps)


def shape_of(raw: bytes, message: MessageType, *, cdr: bool) -> MessageShape:
    """Return the byte layout of one message.

    Args:
        raw: bytes of the message.
        message: type of the message.
        cdr: True if the message is serialised as in ROS 2 (CDR), not as in ROS 1.

    Raises:
        ValueError: the bytes are not a message of this type; the error message says why.
    """
    walk = _MessageWalk(raw, cdr)
    leaves = tuple(walk.leaves(message, ""))
    over = len(raw) - walk.at
    if not 0 <= over < (4 if cdr else 1):
        raise ValueError(f"{over} bytes remain after its last field")
    fixed = np.concatenate([np.arange(0), *(np.arange(a, b) for a, b in walk.fixed)])
    return MessageShape(len(raw), leaves, fixed, np.frombuffer(raw, np.uint8)[fixed])


class _MessageWalk:
    """Decoder that goes through the bytes of one message and finds its leaves.

    Attributes:
        raw: bytes of the message.
        cdr: True if the message is serialised as in ROS 2 (CDR).
        order: byte order of numbers, `<` or `>`.
        at: offset of the next byte.
        origin: offset from which alignment counts.
        fixed: first offset, and offset after the last byte, of each string and each array length
            found so far.
    """

    def __init__(self, raw: bytes, cdr: bool) -> None:
        self.raw, self.cdr, self.order = raw, cdr, "<"
        self.at = self.origin = 0
        self.fixed: list[tuple[int, int]] = []
        if cdr:
            if raw[:2] not in (b"\x00\x00", b"\x00\x01") or len(raw) < 4:
                raise ValueError(f"it is not serialised as CDR (it starts with {raw[:4].hex(' ')})")
            self.order = "<" if raw[1] else ">"
            self.at = self.origin = 4
            self.fixed.append((0, 2))

    def leaves(self, kind: FieldType, path: str) -> Iterator[MessageLeaf]:
        """Yield the leaves of the next field, of type `kind`, and skip its bytes."""
        if kind == TEXT:
            yield MessageLeaf(path, "", self.at, None, self.text())
        elif isinstance(kind, str):
            yield MessageLeaf(path, self.order + kind, self.numbers(int(kind[1:]), 1))
        elif isinstance(kind, MessageType):
            for name, inner in kind.fields.items():
                yield from self.leaves(inner, f"{path}.{name}" if path else name)
        else:
            yield from self.elements(kind, path)

    def elements(self, kind: ArrayType, path: str) -> Iterator[MessageLeaf]:
        """Yield the leaves of the next field, an array of type `kind`, and skip its bytes."""
        count, element = self.length() if kind.count is None else kind.count, kind.element
        if isinstance(element, str) and element != TEXT:
            at = self.numbers(int(element[1:]), count)
            yield MessageLeaf(path, self.order + element, at, count)
            return
        if count > len(self.raw) - self.at:
            raise ValueError(f"it ends before the {count} elements of '{path}'")
        for k in range(count):
            yield from self.leaves(element, f"{path}[{k}]")

    def numbers(self, size: int, count: int) -> int:
        """Skip some numbers, aligned as CDR demands, and return the offset of their first byte.

        Args:
            size: bytes of one number.
            count: number of numbers.
        """
        if count and self.cdr:
            self.at += -(self.at - self.origin) % size
        first = self.at
        self.at += size * count
        if self.at > len(self.raw):
            raise ValueError(f"it ends after {len(self.raw)} bytes, before the end of its fields")
        return first

    def length(self) -> int:
        """Return the length of an array or string, which is the next number, and skip its bytes."""
        at = self.numbers(4, 1)
        self.fixed.append((at, at + 4))
        return int(struct.unpack_from(self.order + "I", self.raw, at)[0])

    def text(self) -> str:
        """Return the string that comes next, and skip its bytes."""
        size = self.length()
        at = self.numbers(1, size)
        self.fixed.append((at, at + size))
        text = self.raw[at : at + size]
        # In CDR the length of a string includes a zero byte at its end, which is removed.
        return (text[:-1] if self.cdr else text).decode(errors="replace")
