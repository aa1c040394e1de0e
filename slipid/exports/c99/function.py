"""Translation of a traced JAX function to a C function with arguments, body and stack arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp

from slipid.exports.c99.builder import Builder, Names
from slipid.exports.c99.ir import Memory, Value, holds, in_memory
from slipid.exports.c99.jaxpr import Traced
from slipid.exports.c99.lower import apart, lowered, store
from slipid.exports.c99.text import FunctionBody, folded
from slipid.exports.fields import Field, Struct


@dataclass(frozen=True)
class Argument:
    """An argument of a C function.

    Attributes:
        name: name of the argument.
        struct: struct that the argument points to; for plain numbers, a struct without a name and
            with a single field.
        read: True if the function reads the argument.
        written: True if the function writes the argument.
    """

    name: str
    struct: Struct
    read: bool = True
    written: bool = False

    @classmethod
    def plain(
        cls, name: str, shape: tuple[int, ...], read: bool = True, written: bool = False
    ) -> Argument:
        """Return an argument that is a number, or an array of numbers."""
        numbers = Struct("", (Field(name, "real", shape, ""),), jnp.zeros(shape))
        return cls(name, numbers, read, written)

    @property
    def made(self) -> Argument:
        """The same argument for a function that only writes it."""
        return replace(self, read=False, written=True)

    @property
    def changed(self) -> Argument:
        """The same argument for a function that reads and writes it."""
        return replace(self, written=True)

    @property
    def values(self) -> list[tuple[Memory, tuple[int, ...]]]:
        """Memory and shape of each field of the argument."""
        fields = self.struct.fields
        plain = f"(*{self.name})" if self.written and not fields[0].shape else self.name
        names = [f"{self.name}->{f.name}" if self.struct.name else plain for f in fields]
        return [
            (Memory(name, f.numbers, f.size, scalar=not f.shape), f.shape)
            for name, f in zip(names, fields, strict=True)
        ]

    @property
    def declared(self) -> str:
        """C text that declares the argument in the function's head."""
        const, field = "" if self.written else "const ", self.struct.fields[0]
        if self.struct.name:
            return f"{const}slipid_{self.struct.name} *{self.name}"
        if field.shape:
            return f"{const}slipid_real {self.name}[{field.size}]"
        return f"slipid_real {'*' if self.written else ''}{self.name}"


@dataclass(frozen=True)
class Function:
    """A C function.

    Attributes:
        name: name of the function.
        arguments: arguments in order.
        lines: lines of the function's body.
        reads: names of all memory that the function reads.
        scratch: total size of the function's arrays on the stack [numbers].
    """

    name: str
    arguments: tuple[Argument, ...]
    lines: tuple[str, ...]
    reads: frozenset[str]
    scratch: int

    @property
    def head(self) -> str:
        """Text of the declaration without the semicolon."""
        return f"void {self.name}({', '.join(a.declared for a in self.arguments)})"

    @property
    def text(self) -> list[str]:
        """Lines of the definition."""
        return [*folded(f"{self.head} {{", ""), *self.lines, "}", ""]


def function(
    names: Names, name: str, arguments: Sequence[Argument], run: Callable[..., object]
) -> Function:
    """Translate a function of JAX to a C function.

    Args:
        names: unique names and constant tables of the generated file.
        name: name of the C function.
        arguments: arguments of the C function in order.
        run: function of JAX. Its inputs are trees like `Struct.example` of all arguments that are
            read; its results are such trees of all arguments that are written. Both are in the
            order of `arguments`.

    Raises:
        UnsupportedError: the function uses a primitive without a rule.
    """
    builder = Builder(names)
    given = [argument for argument in arguments if argument.read]
    values: list[Value] = [in_memory(*value) for argument in given for value in argument.values]
    results = lowered(builder, traced(run, *(a.struct.example for a in given)), values)
    targets = [memory for a in arguments if a.written for memory, _ in a.values]
    overwritten = frozenset(memory.name for memory in targets)
    changed = [
        (memory, apart(builder, value, overwritten))
        for memory, value in zip(targets, results, strict=True)
        if not holds(memory, value)
    ]
    for memory, value in changed:
        store(builder, value, memory)
    body = FunctionBody(builder)
    unused = [
        f"  (void){a.name};"
        for a in arguments
        if not a.written and not any(memory.name in body.reads for memory, _ in a.values)
    ]
    lines = (*unused, *body.lines)
    return Function(name, tuple(arguments), lines, body.reads, body.scratch)


def traced(run: Callable[..., object], *like: object) -> Traced:
    """Trace a function of trees, as a function of all leaves that returns the result's leaves.

    `like` are example arguments of the function.
    """
    structure = jax.tree.structure(like)

    def of(*leaves: jax.Array) -> list[jax.Array]:
        return jax.tree.leaves(run(*jax.tree.unflatten(structure, leaves)))

    return Traced.of(jax.make_jaxpr(of)(*jax.tree.leaves(like)))
