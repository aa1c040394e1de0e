"""What a traced function is lowered to: numbers, loops over lanes, and where both are computed.

An array is a numpy array of cells, one for every number. Long arrays have one axis that is a loop
at run time, their lanes; their cells then stand for a whole row of numbers along it. All else is
unrolled, so that to slice, stack or transpose an array is to rearrange its cells and costs the
robot nothing.

Every number is computed once, in the earliest block that has what it needs. A block is straight
code, or one loop over lanes, so that what many operations do to the same lanes is one loop.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal as Choice

import numpy as np

Kind = Choice["real", "int", "bool"]
Cells = np.ndarray
"""Of objects, each a `Cell`."""


class Cell:
    """A number, or one for every lane."""

    kind: Kind


@dataclass(frozen=True)
class Number(Cell):
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
        name: in C; kind: of its numbers; size: how many.
        home: block that fills it; None where it is filled before the function begins.
        values: of a table of constants.
        scalar: whether it is a single number that C knows without an index.
        lanes: whether a loop fills it, truth values as 1 and 0: numbers of one size make a loop
            that compilers turn into instructions for several lanes at once.
    """

    name: str
    kind: Kind
    size: int
    home: Block | None = None
    values: bytes = b""
    scalar: bool = False
    lanes: bool = False


@dataclass(frozen=True)
class At(Cell):
    """A number in memory: `memory[offset + stride * lane + index]`, or `[table[lane]]`."""

    memory: Memory
    offset: int
    stride: int = 0
    index: Variable | None = None
    table: Memory | None = None

    @property
    def kind(self) -> Kind:  # type: ignore[override]
        """Of the memory."""
        return self.memory.kind

    @property
    def varies(self) -> bool:
        """Whether it differs from lane to lane."""
        by_index = self.index is not None and self.index.lanes > 0
        return self.stride != 0 or self.table is not None or by_index


@dataclass(eq=False)
class Variable(Cell):
    """A number that a statement computes; one for every lane where `lanes` is not 0.

    Attributes:
        kind: of it; number: of its name; home: block that computes it.
        summed: whether lanes are summed up, or reduced in another way, to one number.
        made_by: template and cells of its statement.
    """

    kind: Kind
    number: int
    lanes: int
    home: Block
    summed: bool = False
    made_by: tuple[str, tuple[Cell, ...]] = ("", ())

    @property
    def memory(self) -> Memory:
        """Where its lanes are kept."""
        return Memory(f"m{self.number}", self.kind, self.lanes, self.home, lanes=True)


@dataclass(eq=False)
class Statement:
    """`target = template` with cells for {0}, {1} ...; `start` and `less` are for reductions.

    Attributes:
        target: what it computes; None where the template is a whole statement of C.
        writes: memory that the template fills; times: numbers of it, in a loop, if not 0.
        always: whether it stays though nothing reads that memory.
        start: of a reduction.
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
class Block:
    """Statements that run one after the other, for every lane if `lanes` is not 0.

    Attributes:
        owner: what it is part of; place: among the blocks of its owner.
        lanes: of the loop; calls: whether its statements call functions.
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
        times: how often a single body runs; counter: its number, from 0.
        bodies: what runs.
    """

    when: Cell | None
    times: int
    bodies: list[Builder]


@dataclass(frozen=True)
class Array:
    """An array of cells.

    Attributes:
        shape: of the array; kind: of its numbers.
        axis: that of the lanes, or None.
        cells: without that axis.
    """

    shape: tuple[int, ...]
    kind: Kind
    axis: int | None
    cells: Cells


class Builder:
    """Collects the statements of a function, or of the body of a condition or repetition.

    Attributes:
        blocks: in their order; source: line of Python that asks for what comes next.
        contiguous: arrays that lie in row-major order in memory as well, by their cells.
    """

    def __init__(self, names: Names, parent: Builder | None = None):
        self.names, self.parent = names, parent
        self.blocks: list[Block] = []
        self.source = ""
        self.contiguous: dict[int, tuple[Array, Memory]] = {}
        self._known: dict[tuple[object, ...], Variable] = {}

    def compute(
        self,
        kind: Kind,
        template: str,
        cells: tuple[Cell, ...],
        lanes: int = 0,
        start: str = "",
    ) -> Variable:
        """A variable computed from cells; the one there is if it was computed before.

        With `start` lanes are reduced to one number.
        """
        key = (kind, template, cells, lanes, start)
        if key not in self._known and self.parent is not None and key in self.parent._known:
            return self.parent._known[key]
        if key not in self._known:
            block = self.place(cells, lanes, bool(start) or any(f in template for f in CALLS))
            one = start != ""
            made = Variable(
                kind, self.names.number(), 0 if one else lanes, block, one, (template, cells)
            )
            block.statements.append(
                Statement(made, template, cells, start=start, source=self.source)
            )
            self._known[key] = made
        return self._known[key]

    def write(self, template: str, cells: tuple[Cell, ...], memory: Memory, lanes: int = 0) -> None:
        """A statement of C that fills memory made by `array` before."""
        block = memory.home
        assert block is not None
        block.statements.append(Statement(None, template, cells, memory, lanes, source=self.source))

    def late(self, block: Block, template: str, cell: Cell, memory: Memory) -> None:
        """A statement at the end of the code so far, that stores a cell in memory."""
        block.statements.append(Statement(None, template, (cell,), memory, always=True))

    def fill(self, template: str, cell: Cell, memory: Memory) -> None:
        """A statement that fills memory made by `array` before, for every lane of its block."""
        block = memory.home
        assert block is not None
        block.statements.append(Statement(None, template, (cell,), memory, source=self.source))

    def array(self, kind: Kind, size: int, cells: tuple[Cell, ...], lanes: int = 0) -> Memory:
        """Memory for numbers that straight code, or a loop over lanes, fills from these cells."""
        return Memory(f"m{self.names.number()}", kind, size, self.place(cells, lanes))

    def place(self, cells: tuple[Cell, ...], lanes: int, calls: bool = False) -> Block:
        """The earliest block for a statement over so many lanes that uses these cells.

        Loops whose statements call functions are apart from those that a compiler can make of
        instructions for several lanes at once.
        """
        apart = calls and lanes > 0
        first = max((self._after(cell, lanes) for cell in cells), default=0)
        for block in self.blocks[first:]:
            if (block.lanes, block.calls, block.nested) == (lanes, apart, None):
                return block
        return self.append(lanes, calls=apart)

    def append(self, lanes: int = 0, nested: Nested | None = None, calls: bool = False) -> Block:
        """A new block behind all others."""
        block = Block(self, len(self.blocks), lanes, calls, nested=nested)
        self.blocks.append(block)
        return block

    def _after(self, cell: Cell, lanes: int) -> int:
        """Place of the first block of which a statement can use a cell."""
        if isinstance(cell, At):
            inner = 0 if cell.index is None else self._after(cell.index, lanes)
            return max(inner, self._behind(cell.memory.home, False))
        if not isinstance(cell, Variable):
            return 0
        together = lanes == cell.lanes and not cell.summed
        return self._behind(cell.home, together)

    def _behind(self, home: Block | None, together: bool) -> int:
        if home is None or home.owner is not self:
            return 0  # it is filled before this builder's code begins
        return home.place + (0 if together else 1)


class Names:
    """Numbers for names, and the tables of constants of a whole file."""

    def __init__(self) -> None:
        self._last = 0
        self.tables: dict[tuple[Kind, bytes], Memory] = {}

    def number(self) -> int:
        """A new number."""
        self._last += 1
        return self._last

    def table(self, values: np.ndarray, kind: Kind) -> Memory:
        """Memory of constants; the one there is if it holds the same."""
        flat = np.ascontiguousarray(values.reshape(-1), dtype=DTYPES[kind])
        key = (kind, flat.tobytes())
        if key not in self.tables:
            name = f"k{len(self.tables)}"
            self.tables[key] = Memory(name, kind, flat.size, None, flat.tobytes())
        return self.tables[key]


CALLS = ("r_atan2", "r_cos", "r_exp", "r_log", "r_pow", "r_rem", "r_sin", "r_floor")
"""Functions of C's library, which no compiler makes of a few instructions."""
DTYPES: dict[Kind, type] = {"real": np.float64, "int": np.int64, "bool": np.bool_}


def kind_of(dtype: np.dtype) -> Kind:
    """Of the numbers of a jax or numpy type."""
    if dtype == np.bool_:
        return "bool"
    return "int" if np.issubdtype(dtype, np.integer) else "real"
