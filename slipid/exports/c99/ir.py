"""Intermediate representation of a traced function: arrays of cells, statements, and their blocks.

Words of the code generator:
    lane: one iteration, with index `l`, of a C loop along an axis of a long array (the axis of its
        lanes); also the array element that belongs to the iteration.
    row: all elements of an array along the axis of its lanes, one per lane.
    cell: what a C expression refers to: a single number, or a row of numbers in a loop over lanes.
        An array is a numpy array of cells, without the axis of its lanes. All other axes are
        unrolled, so that slicing or transposing an array costs no time on the robot.
    memory: named storage in C: a struct field, an array on the stack or a table of constants.
    source: array whose elements are rearranged into a new array.
    place: index of an element in the concatenation of all sources, each flattened in row-major
        order.
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
"""Numpy array (dtype object) of `Cell`s."""
LOOP_FROM = 7
"""Smallest length of an axis that becomes a loop in C; shorter axes are unrolled."""


class NoFormError(Exception):
    """Error with the reason why a primitive cannot be converted to C with its arguments."""


@dataclass(frozen=True)
class Constant:
    """A constant number; equality compares `text`, so that 0.0 and -0.0 differ."""

    value: float | int | bool = field(compare=False)
    kind: Kind
    text: str = field(init=False)

    def __post_init__(self) -> None:
        """Set `text` to the shortest decimal text of the value."""
        object.__setattr__(self, "text", repr(self.value))


@dataclass(frozen=True)
class Memory:
    """Contiguous numbers: a field of a struct, an array on the stack or a table of constants.

    Attributes:
        name: name in C.
        kind: kind of the stored numbers.
        size: count of the stored numbers.
        home: block that writes the numbers; None if they exist before the function begins.
        values: bytes of a table of constants; empty for other memory.
        scalar: True for a single number that C accesses without an index.
        lanes: True if the memory stores one number per lane of a variable. Truth values are then
            stored as the real numbers 1 and 0, since compilers vectorize loops over numbers of one
            size.
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
    """The cell `memory[offset + stride * l + index]`, or `memory[table[l]]`, where `l` is the lane.

    `index` is a further offset that is computed at run time; `table` is an integer table of
    constants.
    """

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
    """A local variable in C: the result of a statement, in every lane if `lanes` is not 0.

    Attributes:
        kind: kind of the number.
        number: serial number, from which the name in C is formed.
        lanes: number of lanes; 0 for a single number.
        home: block of the statement that computes the variable.
        made_by: template and cells of the statement that computes the variable.
    """

    kind: Kind
    number: int
    lanes: int
    home: CodeBlock
    made_by: tuple[str, tuple[Cell, ...]] = ("", ())

    @property
    def memory(self) -> Memory:
        """Stack array with a number per lane; blocks other than `home` read the variable there."""
        return Memory(f"m{self.number}", self.kind, self.lanes, self.home, lanes=True)


Cell = Constant | At | Variable
"""A single number, or one number for every lane."""


@dataclass(eq=False)
class Statement:
    """The C statement `target = template`, with cells for the placeholders {0}, {1} and so on.

    Attributes:
        target: variable that the statement computes; None if the template is a whole C statement.
        template: C text with placeholders for cells.
        cells: cells for the placeholders.
        writes: memory that the template writes to; None if it writes to no memory.
        times: number of iterations of a loop around only this statement; 0 without such a loop.
        always: True if the statement is needed even if nothing reads the memory that it writes.
        start: initial value of a reduction; empty for other statements.
        source: file and line of the Python code that the statement is generated from.
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
    """Statements in sequence, within a loop over lanes if `lanes` is not 0.

    A block with bodies is instead an if-else or a repetition, without statements of its own.

    Attributes:
        owner: builder that the block belongs to.
        lanes: number of iterations of the loop; 0 for straight-line code.
        calls: True if the loop contains reductions or calls of C's library, see
            `slipid.exports.c99.builder.CALLS`.
        when: condition of an if-else: if true, the first of the two bodies runs, else the second.
        times: number of times that the single body of a repetition runs.
        bodies: builders of the bodies.
        place: index of the block among the blocks of the owner.
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
        axis: axis of the lanes (see the module), along which C code loops; None if every element
            has a cell of its own.
        cells: cells, in the array's shape without the axis of the lanes.
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
    """Return cells, listed in row-major order, as a numpy array of this shape."""
    out = np.empty(len(cells), dtype=object)
    out[:] = cells
    return out.reshape(shape)


def varies(cell: Cell) -> bool:
    """Return whether a cell has different values in different lanes."""
    if isinstance(cell, At):
        by_index = cell.index is not None and cell.index.lanes > 0
        return cell.stride != 0 or cell.table is not None or by_index
    return isinstance(cell, Variable) and cell.lanes > 0


def longest(shape: Sequence[int]) -> int | None:
    """Return the longest axis, which becomes a loop; None if it is shorter than `LOOP_FROM`."""
    if max(shape, default=0) < LOOP_FROM:
        return None
    return max(range(len(shape)), key=lambda axis: (shape[axis], axis))


def numbered(shape: Sequence[int]) -> np.ndarray:
    """Return an array of this shape in which each element is its own row-major index."""
    return np.arange(prod(shape)).reshape(shape)


def rows_of(values: np.ndarray, axis: int | None) -> np.ndarray:
    """Move the axis of the lanes to the end; without lanes, append an axis of length 1."""
    return values[..., None] if axis is None else np.moveaxis(values, axis, -1)


def read_at(memory: Memory, places: np.ndarray, index: Variable | None = None) -> Array:
    """Return an array that reads memory at the indices `places + index`.

    Along the longest axis, `places` must be evenly spaced.
    """
    axis = longest(places.shape)
    rows = rows_of(places, axis)
    cells = [
        At(memory, int(row[0]), 0 if axis is None else int(row[1] - row[0]), index)
        for row in rows.reshape(-1, rows.shape[-1])
    ]
    return Array(places.shape, memory.kind, axis, cells_of(rows.shape[:-1], cells))


def in_memory(memory: Memory, shape: tuple[int, ...]) -> Array:
    """Return memory as an array of this shape in row-major order."""
    return read_at(memory, numbered(shape))


def holds(memory: Memory, value: Value) -> bool:
    """Return whether memory already holds a value in row-major order."""
    if not isinstance(value, Array):
        return False
    like = in_memory(memory, value.shape)
    return value.axis == like.axis and bool((value.cells == like.cells).all())
