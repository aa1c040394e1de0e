"""What of the code is used, and which arrays on the stack can share their place."""

from __future__ import annotations

from dataclasses import dataclass

from slipid.control.export.c99.lowering.builder import Builder
from slipid.control.export.c99.lowering.ir import (
    At,
    Block,
    Cell,
    Memory,
    Nested,
    Statement,
    Variable,
)
from slipid.control.export.fields import Kind


class Usage:
    """Use of the statements and arrays of a builder.

    It is found from the end to the beginning, since a statement is needed if a later one uses what
    it computes; steps are numbered downwards, so that earlier ones have smaller numbers.

    Attributes:
        live: identities of the statements that are needed; read: names of all memory that is read.
        shared: kind and name of the array on the stack that each memory has, by its own name.
        sizes: of all arrays on the stack, by kind and name.
    """

    def __init__(self, builder: Builder):
        self.live: set[int] = set()
        self.read: set[str] = set()
        self._used: set[Variable] = set()
        self._lives: dict[str, _Life] = {}
        self._step = 0
        self._scan(builder)
        self.shared = _shared(list(self._lives.values()))
        self.sizes: dict[tuple[Kind, str], int] = {}
        for name, array in self.shared.items():
            self.sizes[array] = self._lives[name].memory.size

    def _scan(self, builder: Builder) -> None:
        """Mark what is used, from the end to the beginning."""
        for block in reversed(builder.blocks):
            self._step -= 1
            if block.nested is not None:
                self._inside(block.nested)
                if block.nested.when is not None:
                    self._uses(block.nested.when, block)
            for statement in reversed(block.statements):
                if self._needed(statement):
                    self._mark(statement, block)

    def _mark(self, statement: Statement, block: Block) -> None:
        """Mark a statement that is needed, and what it uses."""
        self.live.add(id(statement))
        writes, target = statement.writes, statement.target
        if writes is not None and writes.home is not None:
            self._lived(writes)
        if target is not None and target.lanes and target.memory.name in self._lives:
            self._lived(target.memory)
        for cell in statement.cells:
            self._uses(cell, block)

    def _inside(self, nested: Nested) -> None:
        """Mark what bodies use; what a repetition finds there lives until it is over."""
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

    def _uses(self, cell: Cell, block: Block) -> None:
        if isinstance(cell, Variable):
            self._used.add(cell)
            if cell.lanes and cell.home is not block:
                self._keep(cell.memory)
        elif isinstance(cell, At):
            self._keep(cell.memory)
            if cell.table is not None:
                self.read.add(cell.table.name)
            if cell.index is not None:
                self._uses(cell.index, block)

    def _keep(self, memory: Memory) -> None:
        self.read.add(memory.name)
        if memory.home is not None:
            self._lived(memory)

    def _lived(self, memory: Memory) -> None:
        """Note that an array is used in this step."""
        life = self._lives.setdefault(memory.name, _Life(memory, self._step, self._step))
        life.first = min(life.first, self._step)


@dataclass
class _Life:
    """Steps of the program from the first to the last that uses an array."""

    memory: Memory
    first: int
    last: int


def _within(memory: Memory, nested: Nested) -> bool:
    """Whether memory is filled by the bodies of a condition or repetition, or deeper inside."""
    owner = None if memory.home is None else memory.home.owner
    while owner is not None and owner not in nested.bodies:
        owner = owner.parent
    return owner is not None


def _shared(arrays: list[_Life]) -> dict[str, tuple[Kind, str]]:
    """Kind and name of an array for each; those used one after another share one."""
    slots: dict[tuple[Kind, int], list[_Life]] = {}
    names: dict[str, tuple[Kind, str]] = {}
    for life in sorted(arrays, key=lambda life: life.first):
        memory = life.memory
        kind: Kind = "real" if memory.lanes and memory.kind == "bool" else memory.kind
        taken = slots.setdefault((kind, memory.size), [])
        free = next((k for k, other in enumerate(taken) if other.last < life.first), len(taken))
        taken[free : free + 1] = [life]
        names[memory.name] = kind, f"{kind[0]}{memory.size}_{free}"
    return names
