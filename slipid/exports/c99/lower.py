"""Conversion of traced functions to C statements; constant expressions are computed at export.

The words lane, row, cell, source and place are defined in `slipid.exports.c99.ir`.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import Any

import jax
import numpy as np
from jax.extend.core import JaxprEqn, Var
from jax.extend.core import Literal as JaxLiteral

from slipid.exports.c99 import arithmetic, moves
from slipid.exports.c99.arithmetic import BINARY, REDUCED, UNARY, Rule, Shaped
from slipid.exports.c99.builder import Builder
from slipid.exports.c99.ir import (
    Array,
    At,
    Cell,
    CodeBlock,
    Memory,
    NoFormError,
    Statement,
    Value,
    cells_of,
    in_memory,
    kind_of_value,
    longest,
    numbered,
    rows_of,
)
from slipid.exports.c99.jaxpr import Params, ScanParameters, Traced, branches, called, source_line
from slipid.exports.c99.moves import MOVES, SOURCES, moved
from slipid.exports.c99.sources import along, rearranged
from slipid.exports.fields import DTYPES
from slipid.support.errors import DataError

RULES: dict[str, Rule] = {
    **{name: arithmetic.unary(name) for name in UNARY},
    **{name: arithmetic.binary(name) for name in BINARY},
    **{name: arithmetic.reduced(name) for name in REDUCED},
    "argmin": arithmetic.argmin,
    "convert_element_type": arithmetic.converted,
    "dot_general": arithmetic.dot,
    "dynamic_slice": moves.dynamic_slice,
    "gather": moves.gather,
    "integer_pow": arithmetic.integer_pow,
    "scatter": moves.scatter,
    "scatter-add": moves.scattered("add", 0.0),
    "scatter-mul": moves.scattered("mul", 1.0),
    "select_n": arithmetic.select,
}
"""Rules that convert a primitive of JAX to C, keyed by the primitive's name.

Primitives in `MOVES` only move elements. At export `moved` applies them to the elements' indices,
which shows the origin of each element of the result. The rules of `dynamic_slice` and `gather` are
for indices that are computed at run time."""
INLINED = frozenset(("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call"))
"""Primitives that call another traced function, whose statements are inlined."""

_TYPES = frozenset(map(np.dtype, ("float64", "int64", "int32", "bool")))
"""Data types that the generated C code supports."""


class UnsupportedError(DataError):
    """Error for a function that cannot be converted to C.

    The message gives the unsupported primitive and its line of Python code.
    """


def lowered(builder: Builder, traced: Traced, values: Sequence[Value]) -> list[Value]:
    """Append the statements of a traced function to a builder, and return the function's results.

    Raises:
        UnsupportedError: the function uses a primitive without a rule.
        DataError: this version of JAX represents the function in an unsupported way.
    """
    jaxpr, known = traced.jaxpr, dict[Var, Value]()
    known.update(zip(jaxpr.constvars, map(np.asarray, traced.constants), strict=True))
    known.update(zip(jaxpr.invars, values, strict=True))

    def of(atom: Var | JaxLiteral) -> Value:
        return np.asarray(atom.val) if isinstance(atom, JaxLiteral) else known[atom]

    for equation in jaxpr.eqns:
        results = _results(builder, equation, [_filled(of(atom)) for atom in equation.invars])
        known.update(zip(equation.outvars, results, strict=True))
    return [of(atom) for atom in jaxpr.outvars]


def _results(builder: Builder, equation: JaxprEqn, values: list[Value]) -> list[Value]:
    """Return the results of an equation."""
    name = equation.primitive.name
    if name in INLINED:
        return lowered(builder, called(Params(equation)), values)
    if not any(isinstance(v, Array) for v in values):
        return _evaluated(equation, values)
    builder.source = source_line(equation) or builder.source
    try:
        return _by_rule(builder, equation, values)
    except NoFormError as error:
        known = sorted({*RULES, *MOVES, *INLINED, "cond", "scan"})
        raise UnsupportedError(
            f"{builder.source}: the JAX primitive '{name}' has no form in C ({error}); use only "
            f"these primitives: {', '.join(known)}"
        ) from error


def _by_rule(builder: Builder, equation: JaxprEqn, values: list[Value]) -> list[Value]:
    """Return the results of an equation by the rule of its primitive."""
    primitive, params, name = equation.primitive, Params(equation), equation.primitive.name
    if name == "cond":
        return _cond(builder, params, values)
    if name == "scan":
        return _scan(builder, params, values)
    # JAX's type annotation of `aval` has no shape and dtype
    out: Any = equation.outvars[0].aval
    shaped = Shaped(out.shape, out.dtype)
    if out.dtype not in _TYPES:
        raise NoFormError(f"numbers of type {out.dtype} are not supported")
    if name in ("split", "unstack"):
        parts = primitive.bind(numbered(values[0].shape), **equation.params)
        return [rearranged(builder, values[:1], np.asarray(part)) for part in parts]
    variable_index = name in SOURCES and any(isinstance(v, Array) for v in values[1:])
    if name in MOVES and not variable_index:
        return [moved(primitive, SOURCES.get(name, 0))(builder, values, params, shaped)]
    if name not in RULES:
        raise NoFormError("there is no rule for this primitive")
    return [RULES[name](builder, values, params, shaped)]


def _cond(builder: Builder, params: Params, values: list[Value]) -> list[Value]:
    """Append an if-else whose branches are the functions of a `cond`, and return its results."""
    which, choices = values[0], branches(params)
    if len(choices) != 2:
        raise NoFormError("more than two branches are not supported")
    if not isinstance(which, Array):
        return lowered(builder, choices[int(np.clip(which, 0, 1))], values[1:])
    bodies = [Builder(builder.names, builder) for _ in range(2)]
    results = [
        lowered(body, branch, values[1:]) for body, branch in zip(bodies, choices, strict=True)
    ]
    when = builder.compute("bool", "{0} != 0", (along(builder, which, (), None).item(),))
    block = builder.append(CodeBlock(builder, when=when, bodies=bodies[::-1]))
    out: list[Value] = []
    for pair in zip(*results, strict=True):
        memory = _memory(builder, pair[0], block)
        for body, value in zip(bodies, pair, strict=True):
            store(body, value, memory)
        out.append(in_memory(memory, pair[0].shape))
    return out


def _memory(builder: Builder, like: Value, block: CodeBlock) -> Memory:
    """Return new memory with the kind and size of the value `like`, written in `block`."""
    return Memory(f"m{builder.names.number()}", kind_of_value(like), prod(like.shape), block)


def _scan(builder: Builder, params: Params, values: list[Value]) -> list[Value]:
    """Append a loop that applies a function repeatedly to its results; return the last results."""
    scan = ScanParameters.of(params)
    carried, consts = scan.carried, scan.constants
    if len(values) != carried + consts or len(scan.body.jaxpr.outvars) != carried:
        raise NoFormError("a scan over an array is not supported")
    body = Builder(builder.names, builder)
    body.turns = CodeBlock(builder, times=scan.turns, bodies=[body])
    begun = values[consts:]
    memories = [_memory(builder, value, body.turns) for value in begun]
    for value, memory in zip(begun, memories, strict=True):
        store(builder, value, memory)
    carry = [in_memory(m, v.shape) for m, v in zip(memories, begun, strict=True)]
    results = lowered(body, scan.body, [*values[:consts], *carry])
    names = frozenset(memory.name for memory in memories)
    results = [apart(body, value, names) for value in results]
    for value, memory in zip(results, memories, strict=True):
        store(body, value, memory)
    builder.append(body.turns)
    return list(carry)


def apart(builder: Builder, value: Value, overwritten: frozenset[str]) -> Value:
    """Return a result whose cells in memory called `overwritten` are copied to variables.

    That memory is about to be overwritten, so these cells would change.
    """
    if not isinstance(value, Array):
        return value

    def own(cell: Cell) -> Cell:
        if not isinstance(cell, At) or cell.memory.name not in overwritten:
            return cell
        return builder.compute(cell.kind, "{0}", (cell,), value.lanes)

    cells = [own(cell) for cell in value.cells.reshape(-1)]
    return Array(value.shape, value.kind, value.axis, cells_of(value.cells.shape, cells))


def store(builder: Builder, value: Value, memory: Memory) -> None:
    """Append statements that write an array into memory in row-major order."""
    shape = value.shape
    axis = value.axis if isinstance(value, Array) else longest(shape)
    cells = along(builder, value, shape, axis)
    lanes = 0 if axis is None else shape[axis]
    rows = rows_of(numbered(shape), axis).reshape(-1, max(lanes, 1))
    end = builder.append(CodeBlock(builder, lanes))
    for row, cell in zip(rows, cells.reshape(-1), strict=True):
        stride = int(row[1] - row[0]) if lanes > 1 else 0
        text = f"{_place(memory, int(row[0]), stride)} = {{0}};"
        end.statements.append(Statement(None, text, (cell,), memory, always=True))


def _place(memory: Memory, offset: int, stride: int) -> str:
    if memory.scalar:
        return "{memory}"
    if not stride:
        return f"{{memory}}[{offset}]"
    step = "l" if stride == 1 else f"{stride} * l"
    return f"{{memory}}[{offset} + {step}]" if offset else f"{{memory}}[{step}]"


def _filled(value: Value) -> Value:
    """Return a value unchanged, but convert an array without elements to a numpy array."""
    return value if prod(value.shape) else np.zeros(value.shape, DTYPES[kind_of_value(value)])


def _evaluated(equation: JaxprEqn, values: list[Value]) -> list[Value]:
    """Return the results of a primitive whose inputs are all constant."""
    avals: list[Any] = [atom.aval for atom in equation.invars]
    inputs = [jax.numpy.asarray(v, a.dtype) for v, a in zip(values, avals, strict=True)]
    with jax.ensure_compile_time_eval():
        result = equation.primitive.bind(*inputs, **equation.params)
    many = equation.primitive.multiple_results
    return [np.asarray(x) for x in (result if many else [result])]
