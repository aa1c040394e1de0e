"""Statements as text of C99."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from slipid.control.export.c99.lowering.builder import Builder
from slipid.control.export.c99.lowering.ir import Block, Cell, Memory, Number, Statement, Variable
from slipid.control.export.c99.lowering.usage import Usage
from slipid.control.export.fields import DTYPES, Kind

TYPES: dict[Kind, str] = {"real": "real_t", "int": "int32_t", "bool": "bool"}
"""Types of numbers in C."""
WIDTH = 100
FLOAT_MAX = float(np.finfo(np.float32).max)


def number(value: float | int | bool, kind: Kind) -> str:
    """A constant."""
    if kind == "bool":
        return "true" if value else "false"
    if kind == "int":
        return str(int(value)) if value >= 0 else f"({int(value)})"
    if math.isnan(value):
        return "R_NAN"
    if math.isinf(value):
        return "R_INFINITY" if value > 0 else "(-R_INFINITY)"
    if abs(value) > FLOAT_MAX:
        return f"R_WIDE({float(value)!r})"
    return f"R({float(value)!r})"


def table(memory: Memory) -> list[str]:
    """Definition of a table of constants."""
    values = np.frombuffer(memory.values, dtype=DTYPES[memory.kind]).tolist()
    small = memory.kind == "int" and min(values) >= 0 and max(values) < 2**15
    kind = "int16_t" if small else TYPES[memory.kind]
    lines = wrapped((number(value, memory.kind) for value in values), "  ")
    return [f"static const {kind} {memory.name}[{memory.size}] = {{", *lines, "};"]


def wrapped(words: Iterable[str], indent: str) -> list[str]:
    """Words with commas between them in lines."""
    lines, line = [], indent
    for word in words:
        if len(line) + len(word) + 2 > WIDTH and line.strip():
            lines.append(line.rstrip())
            line = indent
        line += f"{word}, "
    return [*lines, line.rstrip().rstrip(",")]


class Body:
    """Text of the code of a builder, without what nothing uses.

    Attributes:
        reads: names of all memory that is read; scratch: numbers in arrays on the stack.
    """

    def __init__(self, builder: Builder):
        self._usage = Usage(builder)
        self._said = ""
        self._lines = self._text(builder, "  ")
        self.reads = frozenset(self._usage.read)
        self.scratch = sum(self._usage.sizes.values())

    def lines(self) -> list[str]:
        """Declarations and statements."""
        sizes = self._usage.sizes
        arrays = [f"  {TYPES[kind]} {name}[{size}];" for (kind, name), size in sizes.items()]
        return [*arrays, *self._lines]

    def _text(self, builder: Builder, indent: str) -> list[str]:
        lines: list[str] = []
        for block in builder.blocks:
            lines += self._nested(block, indent) if block.nested else self._block(block, indent)
        return lines

    def _nested(self, block: Block, indent: str) -> list[str]:
        nested = block.nested
        assert nested is not None
        bodies = [self._text(body, indent + "  ") for body in nested.bodies]
        if nested.when is not None:
            yes, no = bodies
            head = f"{indent}if ({self._cell(nested.when, block)}) {{"
            return [head, *yes, f"{indent}}} else {{", *no, f"{indent}}}"]
        head = f"{indent}for (int32_t turn = 0; turn < {nested.times}; ++turn) {{"
        return [head, *bodies[0], f"{indent}}}"]

    def _block(self, block: Block, indent: str) -> list[str]:
        live = [s for s in block.statements if id(s) in self._usage.live]
        if not block.lanes:
            return [line for s in live for line in self._statement(s, block, indent)]
        if not live:
            return []
        sums = [s for s in live if s.start]
        begun = [
            f"{indent}{TYPES[s.target.kind]} t{s.target.number} = {s.start};"
            for s in sums
            if s.target is not None
        ]
        inner = indent + "  "
        body = [line for s in live for line in self._statement(s, block, inner)]
        head = f"{indent}for (int32_t l = 0; l < {block.lanes}; ++l) {{"
        return [*begun, head, *body, f"{indent}}}"]

    def _statement(self, statement: Statement, block: Block, indent: str) -> list[str]:
        cells = [self._cell(cell, block) for cell in statement.cells]
        target = statement.target
        if target is None:
            return self._write(statement, cells, indent)
        name = f"t{target.number}"
        text = statement.template.format(*cells, acc=name)
        declared = "" if statement.start else f"const {TYPES[target.kind]} "
        lines = [*self._where(statement, indent), *folded(f"{declared}{name} = {text};", indent)]
        if target.lanes and target.memory.name in self._usage.read:
            kept = f"{name} ? R(1.0) : R(0.0)" if target.kind == "bool" else name
            lines.append(f"{indent}{self._name(target.memory)}[l] = {kept};")
        return lines

    def _write(self, statement: Statement, cells: list[str], indent: str) -> list[str]:
        """A statement that fills memory, in a loop of its own where it fills several numbers."""
        assert statement.writes is not None
        text = statement.template.format(*cells, memory=self._name(statement.writes))
        if statement.times:
            head = f"for (int32_t l = 0; l < {statement.times}; ++l) {{"
            return [f"{indent}{head} {text} }}"]
        return [f"{indent}{text}"]

    def _where(self, statement: Statement, indent: str) -> list[str]:
        """Line of Python that asks for a statement, where it is another one than before."""
        if statement.source == self._said:
            return []
        self._said = statement.source
        return [f"{indent}/* {statement.source} */"] if statement.source else []

    def _cell(self, cell: Cell, block: Block) -> str:
        if isinstance(cell, Number):
            return number(cell.value, cell.kind)
        if isinstance(cell, Variable):
            away = cell.lanes and cell.home is not block
            return self._number(cell.memory, "l") if away else f"t{cell.number}"
        if cell.memory.scalar:
            return cell.memory.name
        if cell.table is not None:
            return self._number(cell.memory, f"{cell.table.name}[l]")
        terms = [str(cell.offset)] if cell.offset or not (cell.stride or cell.index) else []
        if cell.stride:
            terms.append("l" if cell.stride == 1 else f"{cell.stride} * l")
        if cell.index is not None:
            terms.append(self._cell(cell.index, block))
        return self._number(cell.memory, " + ".join(terms))

    def _number(self, memory: Memory, place: str) -> str:
        """A number of memory."""
        text = f"{self._name(memory)}[{place}]"
        return f"({text} != R(0.0))" if memory.lanes and memory.kind == "bool" else text

    def _name(self, memory: Memory) -> str:
        """Name in C: that of the array on the stack which it shares, or its own."""
        shared = self._usage.shared.get(memory.name)
        return memory.name if shared is None else shared[1]


def folded(text: str, indent: str) -> list[str]:
    """A long statement over several lines."""
    if len(indent) + len(text) <= WIDTH:
        return [indent + text]
    lines, line = [], indent
    for word in text.split(" "):
        if len(line) + len(word) > WIDTH:
            lines.append(line.rstrip())
            line = indent + "    "
        line += word + " "
    return [*lines, line.rstrip()]
