"""Intermediate representation of a traced function: numbers, loops over lanes, and their blocks.

An array is a numpy array of cells, one for every number. Long arrays have one axis that is a loop
at run time, their lanes; each of their cells then stands for a whole row of numbers along it.
Everything else is unrolled, so that slicing, stacking or transposing an array rearranges its cells
and costs the robot nothing.
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
"""Array of objects, each of them a `Cell`."""
LANES = 7
"""Length from which an axis is a loop."""


class NoFormError(Exception):
    """Reason why there is no form in C for an application of a primitive."""


@dataclass(frozen=True)
class Constant:
    """A constant; 0 and -0 are different."""

    value: float | int | bool = field(compare=False)
    kind: Kind
    text: str = field(init=False)

    def __post_init__(self) -> None:
        """Set the text by which constants compare."""
        object.__setattr__(self, "text", repr(self.value))


@dataclass(frozen=True)
class Memory:
    """Numbers side by side: a field of a struct, an array on the stack or a table of constants.

    Attributes:
        name: name in C.
        kind: kind of its numbers.
        size: count of its numbers.
        home: block that fills it; None where it is filled before the function begins.
        values: bytes of a table of constants, empty for other memory.
        scalar: whether it is a single number that C accesses without an index.
        lanes: whether a loop fills it, truth values as 1 and 0: compilers vectorize loops over
            numbers of one size.
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
    """A number in memory: `memory[offset + stride * lane + index]`, or `[table[lane]]`."""

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
    """A number that a statement computes; one for every lane where `lanes` is not 0.

    Attributes:
        kind: kind of the number.
        number: number in its name.
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
        """Array on the stack that keeps its lanes."""
        return Memory(f"m{self.number}", self.kind, self.lanes, self.home, lanes=True)


Cell = Constant | At | Variable
"""A number, or one for every lane."""


@dataclass(eq=False)
class Statement:
    """`target = template` with cells for {0}, {1} and so on.

    Attributes:
        target: variable that it computes; None where the template is a whole statement of C.
        template: text of C with places for cells.
        cells: cells for these places.
        writes: memory that the template fills.
        times: count of the numbers it fills in a loop of its own, 0 for a statement without one.
        always: whether it stays even if nothing reads that memory.
        start: number that a reduction starts from; empty for other statements.
        source: line of Python that asks for it.
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

    Attributes:
        owner: builder that it belongs to.
        place: its number among the blocks of the owner.
        lanes: count of the loop's turns.
        calls: whether its statements call functions.
        statements: statements in order.
        nested: a condition or a repetition, which has blocks of its own.
    """

    owner: Builder
    place: int
    lanes: int = 0
    calls: bool = False
    statements: list[Statement] = field(default_factory=list)
    nested: Nested | None = None


@dataclass(eq=False)
class Nested:
    """Code that runs under a condition, or several times.

    Attributes:
        when: condition of the first of two bodies, or None.
        times: number of times that a single body runs.
        bodies: code that runs.
    """

    when: Cell | None
    times: int
    bodies: list[Builder]


@dataclass(frozen=True)
class Array:
    """An array of cells.

    Attributes:
        shape: shape of the array.
        kind: kind of its numbers.
        axis: axis of the lanes, or None.
        cells: its cells, an array without that axis.
    """

    shape: tuple[int, ...]
    kind: Kind
    axis: int | None
    cells: Cells


Value = Array | np.ndarray
"""An array that is computed at run time, or a constant."""


def kind_of_value(value: Value) -> Kind:
    """Return the kind of the numbers of a value."""
    return value.kind if isinstance(value, Array) else kind_of(value.dtype)


def cells_of(shape: Sequence[int], cells: Sequence[Cell]) -> Cells:
    """Return an array of cells in row-major order."""
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
    """Return the axis that is a loop by default; None where all are short."""
    if max(shape, default=0) < LANES:
        return None
    return max(range(len(shape)), key=lambda axis: (shape[axis], axis))


def in_memory(memory: Memory, shape: tuple[int, ...]) -> Array:
    """Return the array that is stored in memory in row-major order."""
    places = np.arange(prod(shape)).reshape(shape)
    axis = longest(shape)
    if axis is None:
        cells: list[Cell] = [At(memory, int(k)) for k in places.reshape(-1)]
        return Array(shape, memory.kind, None, cells_of(shape, cells))
    rows = np.moveaxis(places, axis, -1)
    cells = [At(memory, int(r[0]), int(r[1] - r[0])) for r in rows.reshape(-1, rows.shape[-1])]
    return Array(shape, memory.kind, axis, cells_of(rows.shape[:-1], cells))
