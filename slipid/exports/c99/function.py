"""A traced function as a C function: its arguments, its body, and the memory that it reads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from slipid.exports.c99.builder import Builder, Names
from slipid.exports.c99.ir import Array, Memory, Value, in_memory
from slipid.exports.c99.jaxpr import Traced
from slipid.exports.c99.lower import apart, lowered, store
from slipid.exports.c99.text import FunctionBody, folded
from slipid.exports.fields import Field, Struct


@dataclass(frozen=True)
class Argument:
    """An argument of a C function.

    Attributes:
        name: name of the argument.
        type: name of the struct that the argument points to; empty for plain numbers.
        fields: fields of the struct; a single one for plain numbers.
        example: a tree of arrays with the shapes of the fields, as an argument of the traced
            function.
        read: True if the function reads it.
        written: True if the function fills it.
    """

    name: str
    type: str
    fields: tuple[Field, ...]
    example: object
    read: bool
    written: bool

    @classmethod
    def plain(
        cls, name: str, shape: tuple[int, ...], read: bool = True, written: bool = False
    ) -> Argument:
        """Return an argument that is a number, or an array of numbers."""
        return cls(name, "", (Field(name, "real", shape, ""),), jnp.zeros(shape), read, written)

    @classmethod
    def of(cls, name: str, struct: Struct, read: bool = True, written: bool = False) -> Argument:
        """Return an argument that is a pointer to a struct."""
        return cls(name, struct.name, struct.fields, struct.example, read, written)

    @property
    def memories(self) -> list[Memory]:
        """Memory of each of its fields."""
        plain = f"(*{self.name})" if self.written and not self.fields[0].shape else self.name
        return [
            Memory(
                f"{self.name}->{f.name}" if self.type else plain,
                f.numbers,
                f.size,
                scalar=not f.shape,
            )
            for f in self.fields
        ]

    @property
    def declared(self) -> str:
        """Text of its declaration in the function's head."""
        const, field = "" if self.written else "const ", self.fields[0]
        if self.type:
            return f"{const}{self.type} *{self.name}"
        if field.shape:
            return f"{const}slipid_real {self.name}[{field.size}]"
        return f"slipid_real {'*' if self.written else ''}{self.name}"


@dataclass(frozen=True)
class Function:
    """A C function.

    Attributes:
        name: name of the function.
        about: comment of its declaration.
        arguments: arguments in order.
        lines: lines of its body.
        reads: names of all memory that it reads.
        scratch: count of the numbers in its arrays on the stack.
    """

    name: str
    about: str
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
    names: Names,
    name: str,
    about: str,
    arguments: Sequence[Argument],
    run: Callable[..., object],
) -> Function:
    """Return a function of JAX as a C function.

    Args:
        names: numbers for names and constant tables of the generated file.
        name: name of the function.
        about: comment of its declaration.
        arguments: arguments in order.
        run: function whose inputs are the trees of all arguments that are read and whose results
            are those of all arguments that are written, in the arguments' order.

    Raises:
        UnsupportedError: the function uses a primitive without a rule.
    """
    builder = Builder(names)
    values: list[Value] = [
        in_memory(memory, field.shape)
        for argument in arguments
        if argument.read
        for memory, field in zip(argument.memories, argument.fields, strict=True)
    ]
    examples = [argument.example for argument in arguments if argument.read]
    results = lowered(builder, traced(run, *examples), values)
    targets = [memory for a in arguments if a.written for memory in a.memories]
    overwritten = frozenset(memory.name for memory in targets)
    changed = [
        (memory, apart(builder, value, overwritten))
        for memory, value in zip(targets, results, strict=True)
        if not _holds(memory, value)
    ]
    for memory, value in changed:
        store(builder, value, memory)
    body = FunctionBody(builder)
    unused = [
        f"  (void){a.name};"
        for a in arguments
        if not a.written and not any(memory.name in body.reads for memory in a.memories)
    ]
    lines = (*unused, *body.lines)
    return Function(name, about, tuple(arguments), lines, body.reads, body.scratch)


def traced(run: Callable[..., object], *like: object) -> Traced:
    """Return a function of trees, traced as a function of their leaves.

    Its results are the leaves of the result tree. `like` are example arguments.
    """
    structure = jax.tree.structure(like)

    def of(*leaves: jax.Array) -> list[jax.Array]:
        return jax.tree.leaves(run(*jax.tree.unflatten(structure, leaves)))

    return Traced.of(jax.make_jaxpr(of)(*jax.tree.leaves(like)))


def _holds(memory: Memory, value: Value) -> bool:
    """Return whether memory already contains a value, so that nothing has to be stored."""
    if not isinstance(value, Array):
        return False
    like = in_memory(memory, value.shape)
    return value.axis == like.axis and bool((value.cells == like.cells).all())
