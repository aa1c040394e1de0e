"""Conversion of statements to C99 text, without unused statements and with shared stack arrays."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from slipid.exports.c99.builder import Builder
from slipid.exports.c99.ir import At, Cell, CodeBlock, Constant, Memory, Statement, Variable
from slipid.exports.fields import DTYPES, Kind


class Usage:
    """Liveness analysis: which statements and arrays of a builder are used, and when.

    The code is scanned backwards from its end, since a statement is needed if a later statement
    uses its result. Each scanned block gets the next step number, counted down from 0, so that an
    earlier block of the program has a smaller number.

    Attributes:
        live: `id` of each statement that is needed.
        read: names of all memory that is read.
        shared: stack array for each memory, keyed by the memory's name.
    """

    def __init__(self, builder: Builder):
        self.live: set[int] = set()
        self.read: set[str] = set()
        self._used: set[Variable] = set()
        self._lives: dict[str, _Life] = {}
        self._step = 0
        self._scan(builder)
        self.shared = _shared(list(self._lives.values()))

    def _scan(self, builder: Builder) -> None:
        """Mark the needed statements and their arrays, from the last statement to the first."""
        for block in reversed(builder.blocks):
            self._step -= 1
            if block.bodies:
                self._mark_bodies(block)
            if block.when is not None:
                self._uses(block.when, block)
            for statement in reversed(block.statements):
                if self._needed(statement):
                    self._mark(statement, block)

    def _mark(self, statement: Statement, block: CodeBlock) -> None:
        """Mark a statement as needed, and all cells and arrays that it uses."""
        self.live.add(id(statement))
        writes, target = statement.writes, statement.target
        if writes is not None and writes.home is not None:
            self._use_array(writes)
        if target is not None and target.lanes and target.memory.name in self._lives:
            self._use_array(target.memory)
        for cell in statement.cells:
            self._uses(cell, block)

    def _mark_bodies(self, nested: CodeBlock) -> None:
        """Mark what the bodies use; memory from outside stays live until the end of the bodies.

        The bodies of a repetition run several times, so that memory read in them is needed again.
        """
        end = self._step
        for body in nested.bodies:
            self._scan(body)
        for life in self._lives.values():
            if life.first < end and not _within(life.memory, nested):
                life.last = max(life.last, end)
        self._step -= 1

    def _needed(self, statement: Statement) -> bool:
        if statement.target is None:
            written = statement.writes
            return statement.always or (written is not None and written.name in self.read)
        return statement.target in self._used or statement.target.memory.name in self.read

    def _uses(self, cell: Cell, block: CodeBlock) -> None:
        if isinstance(cell, Variable):
            self._used.add(cell)
            if cell.lanes and cell.home is not block:
                self._read_memory(cell.memory)
        elif isinstance(cell, At):
            self._read_memory(cell.memory)
            if cell.table is not None:
                self.read.add(cell.table.name)
            if cell.index is not None:
                self._uses(cell.index, block)

    def _read_memory(self, memory: Memory) -> None:
        self.read.add(memory.name)
        if memory.home is not None:
            self._use_array(memory)

    def _use_array(self, memory: Memory) -> None:
        """Extend the life of an array to the step of the block that is being scanned."""
        life = self._lives.setdefault(memory.name, _Life(memory, self._step, self._step))
        life.first = min(life.first, self._step)


@dataclass
class _Life:
    """First and last step of the program (see `Usage`) at which an array is used."""

    memory: Memory
    first: int
    last: int


def _within(memory: Memory, nested: CodeBlock) -> bool:
    """Return whether memory is filled within the bodies of a condition or repetition."""
    owner = None if memory.home is None else memory.home.owner
    while owner is not None and owner not in nested.bodies:
        owner = owner.parent
    return owner is not None


class StackArray(NamedTuple):
    """An array on the stack: kind of its numbers, name in C, and length."""

    kind: Kind
    name: str
    size: int


def _shared(arrays: list[_Life]) -> dict[str, StackArray]:
    """Return the stack array for each memory, keyed by the memory's name.

    Memory of the same kind and size shares an array if its lives do not overlap.
    """
    slots: dict[tuple[Kind, int], list[_Life]] = {}
    shared: dict[str, StackArray] = {}
    for life in sorted(arrays, key=lambda life: life.first):
        memory = life.memory
        kind: Kind = "real" if memory.lanes and memory.kind == "bool" else memory.kind
        taken = slots.setdefault((kind, memory.size), [])
        free = next((k for k, other in enumerate(taken) if other.last < life.first), len(taken))
        taken[free : free + 1] = [life]
        shared[memory.name] = StackArray(kind, f"{kind[0]}{memory.size}_{free}", memory.size)
    return shared


TYPES: dict[Kind, str] = {"real": "real_t", "int": "int32_t", "bool": "bool"}
"""C type of each kind of number."""
CODE_WIDTH = 100
"""Largest length of a line of generated C [characters]."""
FLOAT_MAX = float(np.finfo(np.float32).max)
"""Largest 32-bit float; larger constants are written with the macro R_WIDE of prelude.c."""


def number(value: float | int | bool, kind: Kind) -> str:
    """Return a constant as C text."""
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
    """Return the lines of C that define a table of constants."""
    values = np.frombuffer(memory.values, dtype=DTYPES[memory.kind]).tolist()
    small = memory.kind == "int" and min(values) >= 0 and max(values) < 2**15
    kind = "int16_t" if small else TYPES[memory.kind]
    lines = wrapped((number(value, memory.kind) for value in values), "  ")
    return [f"static const {kind} {memory.name}[{memory.size}] = {{", *lines, "};"]


def wrapped(words: Iterable[str], indent: str) -> list[str]:
    """Join words by commas, in lines of at most `CODE_WIDTH` characters."""
    lines = _broken(", ".join(words) + ",", CODE_WIDTH - 1, indent, indent)
    return [*lines[:-1], lines[-1].removesuffix(",")]


class FunctionBody:
    """C text of the blocks of a builder, without unused statements.

    Attributes:
        lines: lines of declarations and statements.
        reads: names of all memory that the code reads.
        scratch: total size of the code's arrays on the stack [numbers].
    """

    def __init__(self, builder: Builder):
        self._usage = Usage(builder)
        self._source = ""
        arrays = dict.fromkeys(self._usage.shared.values())
        declared = [f"  {TYPES[array.kind]} {array.name}[{array.size}];" for array in arrays]
        self.lines = (*declared, *self._text(builder, "  "))
        self.reads = frozenset(self._usage.read)
        self.scratch = sum(array.size for array in arrays)

    def _text(self, builder: Builder, indent: str) -> list[str]:
        lines: list[str] = []
        for block in builder.blocks:
            lines += self._nested(block, indent) if block.bodies else self._block(block, indent)
        return lines

    def _nested(self, block: CodeBlock, indent: str) -> list[str]:
        bodies = [self._text(body, indent + "  ") for body in block.bodies]
        if block.when is not None:
            yes, no = bodies
            head = f"{indent}if ({self._cell(block.when, block)}) {{"
            return [head, *yes, f"{indent}}} else {{", *no, f"{indent}}}"]
        head = f"{indent}for (int32_t turn = 0; turn < {block.times}; ++turn) {{"
        return [head, *bodies[0], f"{indent}}}"]

    def _block(self, block: CodeBlock, indent: str) -> list[str]:
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

    def _statement(self, statement: Statement, block: CodeBlock, indent: str) -> list[str]:
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
        """Return the C text of a statement that writes to memory, within its loop if it has one."""
        assert statement.writes is not None
        text = statement.template.format(*cells, memory=self._name(statement.writes))
        if statement.times:
            head = f"for (int32_t l = 0; l < {statement.times}; ++l) {{"
            return [f"{indent}{head} {text} }}"]
        return [f"{indent}{text}"]

    def _where(self, statement: Statement, indent: str) -> list[str]:
        """Return a comment with a statement's Python line, unless the last comment had it."""
        if statement.source == self._source:
            return []
        self._source = statement.source
        return [f"{indent}/* {statement.source} */"] if statement.source else []

    def _cell(self, cell: Cell, block: CodeBlock) -> str:
        if isinstance(cell, Constant):
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
        """Return the C expression `memory[place]`; `place` is the text of the index."""
        text = f"{self._name(memory)}[{place}]"
        return f"({text} != R(0.0))" if memory.lanes and memory.kind == "bool" else text

    def _name(self, memory: Memory) -> str:
        """Return the C name of memory: the name of its stack array if it has one, else its own."""
        shared = self._usage.shared.get(memory.name)
        return memory.name if shared is None else shared.name


def folded(text: str, indent: str) -> list[str]:
    """Return the lines of a statement, wrapped at `CODE_WIDTH` characters."""
    return _broken(text, CODE_WIDTH, indent, f"{indent}    ")


def _broken(text: str, width: int, first: str, later: str) -> list[str]:
    """Return text as lines, broken only at spaces; `first` and `later` are the lines' indents."""
    return textwrap.wrap(
        text,
        width,
        initial_indent=first,
        subsequent_indent=later,
        break_long_words=False,
        break_on_hyphens=False,
    )
