"""What a traced function is lowered to: numbers, loops over lanes, and where both are computed.

An array is a numpy array of cells, one for every number. Long arrays have one axis that is a loop
at run time, their lanes; their cells then stand for a whole row of numbers along it. All else is
unrolled, so that to slice, stack or transpose an array is to rearrange its cells and costs the
robot nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import prod
from typing import TYPE_CHECKING

import numpy as np

from slipid.export.fields import Kind, kind_of

if TYPE_CHECKING:
    from slipid.export.c99.builder import Builder

Cells = np.ndarray
"""Array of objects, each of them a `Cell`."""
LANES = 7
"""Length from which an axis is a loop."""


class NoFormError(Exception):
    """Why there is no form in C for what a primitive is asked to do."""


@dataclass(frozen=True)
class Constant:
    """A constant; 0 and -0 are two."""

    value: float | int | bool = field(compare=False)
    kind: Kind
    text: str = field(init=False)

    def __post_init__(self) -> None:
        """Compare by what is written."""
        object.__setattr__(self, "text", repr(self.value))


@dataclass(frozen=True)
class Memory:
    """Numbers side by side: a field of a struct, an array on the stack or a table of constants.

    Attributes:
        name: name in C; kind: kind of its numbers; size: count of its numbers.
        home: block that fills it; None where it is filled before the function begins.
        values: bytes of a table of constants, empty for other memory.
        scalar: whether it is a single number that C knows without an index.
        lanes: whether a loop fills it, truth values as 1 and 0: numbers of one size make a loop
            that compilers turn into instructions for several lanes at once.
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
        kind: kind of the number; number: number in its name; home: block that computes it.
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
        writes: memory that the template fills; times: how many numbers it fills in a loop of its
            own, 0 for a statement without one.
        always: whether it stays though nothing reads that memory.
        start: number that a reduction starts from; empty for a statement that is none.
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
        owner: builder that it is part of; place: its number among the blocks of the owner.
        lanes: count of the loop's turns; calls: whether its statements call functions.
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
        times: how often a single body runs.
        bodies: code that runs.
    """

    when: Cell | None
    times: int
    bodies: list[Builder]


@dataclass(frozen=True)
class Array:
    """An array of cells.

    Attributes:
        shape: shape of the array; kind: kind of its numbers.
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
    """Kind of the numbers of a value."""
    return value.kind if isinstance(value, Array) else kind_of(value.dtype)


def cells_of(shape: Sequence[int], cells: Sequence[Cell]) -> Cells:
    """An array of cells in row-major order."""
    out = np.empty(len(cells), dtype=object)
    out[:] = cells
    return out.reshape(shape)


def varies(cell: Cell) -> bool:
    """Whether a cell differs from lane to lane."""
    if isinstance(cell, At):
        by_index = cell.index is not None and cell.index.lanes > 0
        return cell.stride != 0 or cell.table is not None or by_index
    return isinstance(cell, Variable) and cell.lanes > 0


def longest(shape: Sequence[int]) -> int | None:
    """Axis that is a loop where nothing else says which; None where all are short."""
    if max(shape, default=0) < LANES:
        return None
    return max(range(len(shape)), key=lambda axis: (shape[axis], axis))


def in_memory(memory: Memory, shape: tuple[int, ...]) -> Array:
    """The array that lies in memory in row-major order."""
    places = np.arange(prod(shape)).reshape(shape)
    axis = longest(shape)
    if axis is None:
        cells: list[Cell] = [At(memory, int(k)) for k in places.reshape(-1)]
        return Array(shape, memory.kind, None, cells_of(shape, cells))
    rows = np.moveaxis(places, axis, -1)
    cells = [At(memory, int(r[0]), int(r[1] - r[0])) for r in rows.reshape(-1, rows.shape[-1])]
    return Array(shape, memory.kind, axis, cells_of(rows.shape[:-1], cells))
