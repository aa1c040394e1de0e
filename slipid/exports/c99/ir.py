"""Intermediate representation of a traced function: numbers, loops over lanes, and their blocks.

An array is a numpy array of cells, one for every number. A long array has one axis along which the
C code loops; the elements along it are its lanes, and each of its cells then stands for a whole row
of numbers along that axis. All other axes are unrolled, so that slicing, stacking or transposing an
array only rearranges its cells and takes no time on the robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import prod
from typing import TYPE_CHECKING

import numpy as np

from slipid.exports.fields import Kind, kind_of

if TYPE_CHECKING:
    from slipid.exports.c99.builder import Builder

Cells = np.ndarray
"""Numpy array of objects, each of which is a `Cell`."""
LOOP_FROM = 7
"""Smallest length of an axis of an array that becomes a loop in C."""


class NoFormError(Exception):
    """Reason why a use of a primitive cannot be converted to C."""


@dataclass(frozen=True)
class Constant:
    """A constant number; constants compare by their text, so that 0.0 and -0.0 differ."""

    value: float | int | bool = field(compare=False)
    kind: Kind
    text: str = field(init=False)

    def __post_init__(self) -> None:
        """Set the text by which constants compare."""
        object.__setattr__(self, "text", repr(self.value))


@dataclass(frozen=True)
class Memory:
    """Contiguous numbers: a field of a struct, an array on the stack or a table of constants.

    Attributes:
        name: name in C.
        kind: kind of its numbers.
        size: count of its numbers.
        home: block that fills it; None if it is filled before the function begins.
        values: bytes of a table of constants, empty for other memory.
        scalar: True if it is a single number that C accesses without an index.
        lanes: True if it stores the lanes of a variable. Truth values are then stored as the
            numbers 1 and 0, since compilers vectorize loops over numbers of one size.
    """

    name: str
    kind: Kind
    size: int
    home: CodeBlock | None = None
    values: bytes = b""
    scalar: bool = False
    lanes: bool = False


@dataclass(frozen=True)
class At:
    """A number in memory: `memory[offset + stride * lane + index]`, or `memory[table[lane]]`."""

    memory: Memory
    offset: int
    stride: int = 0
    index: Variable | None = None
    table: Memory | None = None

    @property
    def kind(self) -> Kind:
        """Kind of the numbers in the memory."""
        return self.memory.kind


@dataclass(eq=False)
class Variable:
    """A number that a statement computes, or one number per lane if `lanes` is not 0.

    Attributes:
        kind: kind of the number.
        number: number that makes its name unique.
        lanes: count of its lanes.
        home: block that computes it.
        made_by: template and cells of the statement that computes it.
    """

    kind: Kind
    number: int
    lanes: int
    home: CodeBlock
    made_by: tuple[str, tuple[Cell, ...]] = ("", ())

    @property
    def memory(self) -> Memory:
        """Array on the stack that stores its lanes."""
        return Memory(f"m{self.number}", self.kind, self.lanes, self.home, lanes=True)


Cell = Constant | At | Variable
"""A single number, or one number for every lane."""


@dataclass(eq=False)
class Statement:
    """The C statement `target = template`, with cells in the places {0}, {1} and so on.

    Attributes:
        target: variable that it computes; None if the template is a whole C statement.
        template: C text with places for cells.
        cells: cells for these places.
        writes: memory that the template fills.
        times: count of the numbers that it fills in a separate loop; 0 for no such loop.
        always: True to keep it even if that memory is never read.
        start: initial value of a reduction; empty for other statements.
        source: file and line of the Python code that it is generated from.
    """

    target: Variable | None
    template: str
    cells: tuple[Cell, ...]
    writes: Memory | None = None
    times: int = 0
    always: bool = False
    start: str = ""
    source: str = ""


@dataclass(eq=False)
class CodeBlock:
    """Statements that run one after the other, for every lane if `lanes` is not 0.

    A block with bodies is a condition or a repetition, and has no other statements.

    Attributes:
        owner: builder to which it belongs.
        lanes: number of iterations of the loop; 0 for straight-line code.
        calls: True if its statements call functions.
        when: condition under which the first of two bodies runs, else the second.
        times: number of times that the one body of a repetition runs.
        bodies: builders of the bodies.
        place: its index among the blocks of the owner.
        statements: statements in order.
    """

    owner: Builder
    lanes: int = 0
    calls: bool = False
    when: Cell | None = None
    times: int = 1
    bodies: Sequence[Builder] = ()
    place: int = 0
    statements: list[Statement] = field(default_factory=list)


@dataclass(frozen=True)
class Array:
    """An array of cells.

    Attributes:
        shape: shape of the array.
        kind: kind of its numbers.
        axis: axis of the lanes; None without lanes.
        cells: cells of the array, whose shape lacks that axis.
    """

    shape: tuple[int, ...]
    kind: Kind
    axis: int | None
    cells: Cells

    @property
    def lanes(self) -> int:
        """Number of lanes; 0 without lanes."""
        return 0 if self.axis is None else self.shape[self.axis]


Value = Array | np.ndarray
"""An array of cells computed at run time, or a numpy array of constants."""


def kind_of_value(value: Value) -> Kind:
    """Return the kind of the numbers of a value."""
    return value.kind if isinstance(value, Array) else kind_of(value.dtype)


def axis_of(value: Value) -> int | None:
    """Return the axis of a value's lanes; None without lanes."""
    return value.axis if isinstance(value, Array) else None


def cells_of(shape: Sequence[int], cells: Sequence[Cell]) -> Cells:
    """Return cells in row-major order as an array of this shape."""
    out = np.empty(len(cells), dtype=object)
    out[:] = cells
    return out.reshape(shape)


def varies(cell: Cell) -> bool:
    """Return whether a cell differs from lane to lane."""
    if isinstance(cell, At):
        by_index = cell.index is not None and cell.index.lanes > 0
        return cell.stride != 0 or cell.table is not None or by_index
    return isinstance(cell, Variable) and cell.lanes > 0


def longest(shape: Sequence[int]) -> int | None:
    """Return the axis that becomes a loop by default, the longest; None if all are short."""
    if max(shape, default=0) < LOOP_FROM:
        return None
    return max(range(len(shape)), key=lambda axis: (shape[axis], axis))


def numbered(shape: Sequence[int]) -> np.ndarray:
    """Return an array of this shape whose numbers are their row-major indices."""
    return np.arange(prod(shape)).reshape(shape)


def rows_of(values: np.ndarray, axis: int | None) -> np.ndarray:
    """Return values with the axis of the lanes last; without lanes, a last axis of length 1."""
    return values[..., None] if axis is None else np.moveaxis(values, axis, -1)


def read_at(memory: Memory, places: np.ndarray, index: Variable | None = None) -> Array:
    """Return the numbers at evenly spaced places of memory, all of them shifted by an index."""
    axis = longest(places.shape)
    rows = rows_of(places, axis)
    cells = [
        At(memory, int(row[0]), 0 if axis is None else int(row[1] - row[0]), index)
        for row in rows.reshape(-1, rows.shape[-1])
    ]
    return Array(places.shape, memory.kind, axis, cells_of(rows.shape[:-1], cells))


def in_memory(memory: Memory, shape: tuple[int, ...]) -> Array:
    """Return the array of this shape that is stored in memory in row-major order."""
    return read_at(memory, numbered(shape))


def holds(memory: Memory, value: Value) -> bool:
    """Return whether memory already holds a value in row-major order."""
    if not isinstance(value, Array):
        return False
    like = in_memory(memory, value.shape)
    return value.axis == like.axis and bool((value.cells == like.cells).all())
