"""Builder that appends each statement of a function to a block of code.

Every expression is computed once, in the earliest block in which its inputs are known. A block is
straight-line code or one loop over lanes (the elements along one axis of an array), so that many
operations on arrays of the same length share one loop. Expressions that are the same in all
iterations of a repetition are computed before the repetition.
"""

from __future__ import annotations

import numpy as np

from slipid.exports.c99.ir import (
    Array,
    At,
    Cell,
    CodeBlock,
    Memory,
    Statement,
    Variable,
    varies,
)
from slipid.exports.fields import DTYPES, Kind

CALLS = ("r_atan2", "r_cos", "r_exp", "r_log", "r_pow", "r_rem", "r_sin", "r_floor")
"""Functions of C's library, whose calls prevent a compiler from vectorizing a loop."""


class Names:
    """Serial numbers for the names in a generated file, and the file's constant tables."""

    def __init__(self) -> None:
        self._last = 0
        self.tables: dict[tuple[Kind, bytes], Memory] = {}

    def number(self) -> int:
        """Return the next serial number."""
        self._last += 1
        return self._last

    def table(self, values: np.ndarray, kind: Kind) -> Memory:
        """Return the table that holds these constants; equal constants share one table."""
        flat = np.ascontiguousarray(values.reshape(-1), dtype=DTYPES[kind])
        key = (kind, flat.tobytes())
        if key not in self.tables:
            name = f"k{len(self.tables)}"
            self.tables[key] = Memory(name, kind, flat.size, None, flat.tobytes())
        return self.tables[key]


class Builder:
    """Collector of the statements of a function, or of the body of a condition or repetition.

    Attributes:
        names: serial numbers and constant tables of the generated file.
        parent: builder of the surrounding code; None for the body of a function.
        turns: block that repeats this builder's code; None outside of repetitions.
        blocks: blocks in order of execution.
        source: file and line of the Python code from which the next statement is generated.
        contiguous: for each array that was also stored in row-major order, the array and the memory
            that holds it, keyed by the `id` of the array's cells.
    """

    def __init__(self, names: Names, parent: Builder | None = None):
        self.names, self.parent = names, parent
        self.turns: CodeBlock | None = None
        self.blocks: list[CodeBlock] = []
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
        """Return the variable of an expression, after appending its statement if it is new.

        Args:
            kind: kind of the result.
            template: C expression with the placeholders {0}, {1}, ... for the cells.
            cells: cells for the placeholders.
            lanes: number of lanes; it is ignored if no cell varies over the lanes, except in a
                reduction.
            start: initial value of a reduction over the lanes to one number; empty if the
                expression is not a reduction.
        """
        lanes = lanes if start or any(map(varies, cells)) else 0
        around = self._outermost(cells)
        if around is not self:
            around.source = self.source
            return around.compute(kind, template, cells, lanes, start)
        key = (kind, template, cells, lanes, start)
        if key not in self._known and self.parent is not None and key in self.parent._known:
            return self.parent._known[key]
        if key not in self._known:
            block = self._place(cells, lanes, bool(start) or any(f in template for f in CALLS))
            own_lanes, made_by = 0 if start else lanes, (template, cells)
            target = Variable(kind, self.names.number(), own_lanes, block, made_by)
            block.statements.append(
                Statement(target, template, cells, start=start, source=self.source)
            )
            self._known[key] = target
        return self._known[key]

    def array(self, kind: Kind, size: int, cells: tuple[Cell, ...], lanes: int = 0) -> Memory:
        """Return new memory for `fill`, in the earliest block in which `cells` are known."""
        home = self._outermost(cells)._place(cells, lanes)
        return Memory(f"m{self.names.number()}", kind, size, home)

    def fill(self, memory: Memory, template: str, cell: Cell, times: int = 0) -> None:
        """Append a C statement that writes `cell` to memory that `array` returned.

        If `times` is not 0, the statement is in a loop with that number of iterations.
        """
        block = memory.home
        assert block is not None
        block.statements.append(
            Statement(None, template, (cell,), memory, times, source=self.source)
        )

    def append(self, block: CodeBlock) -> CodeBlock:
        """Append a block at the end, and return it."""
        block.place = len(self.blocks)
        self.blocks.append(block)
        return block

    def _outermost(self, cells: tuple[Cell, ...]) -> Builder:
        """Return the builder to which a statement that reads `cells` belongs.

        The statement is moved out of every repetition in which none of the cells changes, but not
        out of the body of a condition.
        """
        if self.parent is None or self.turns is None or any(map(self._changes, cells)):
            return self
        return self.parent._outermost(cells)

    def _changes(self, cell: Cell) -> bool:
        """Return whether a cell may have different values in two iterations of this repetition."""
        if isinstance(cell, At):
            home = cell.memory.home
            by_index = cell.index is not None and self._changes(cell.index)
            return by_index or (home is not None and (home is self.turns or home.owner is self))
        return isinstance(cell, Variable) and cell.home.owner is self

    def _place(self, cells: tuple[Cell, ...], lanes: int, calls: bool = False) -> CodeBlock:
        """Return the earliest block for a statement with these cells and number of lanes.

        `calls` is True for calls of C's library and reductions, which get loops of their own, so
        that a compiler can vectorize the other loops.
        """
        apart = calls and lanes > 0
        first = max((self._first_block(cell, lanes) for cell in cells), default=0)
        for block in self.blocks[first:]:
            if (block.lanes, block.calls) == (lanes, apart) and not block.bodies:
                return block
        return self.append(CodeBlock(self, lanes, apart))

    def _first_block(self, cell: Cell, lanes: int) -> int:
        """Return the index of the first block in which a statement can use a cell."""
        if isinstance(cell, At):
            inner = 0 if cell.index is None else self._first_block(cell.index, lanes)
            return max(inner, self._next_to(cell.memory.home, False))
        if not isinstance(cell, Variable):
            return 0
        return self._next_to(cell.home, lanes == cell.lanes)

    def _next_to(self, home: CodeBlock | None, together: bool) -> int:
        """Return the index of the first block that can use values of the block `home`.

        The result is the index of `home` itself if `together` is True, else of the next block.
        """
        if home is None or home.owner is not self:
            return 0  # the values exist before the code of this builder begins
        return home.place + (0 if together else 1)
