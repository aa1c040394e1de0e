"""Rules that turn element-wise JAX primitives into C."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from math import prod

import jax

from slipid.exports.c99.builder import Builder
from slipid.exports.c99.ir import (
    Array,
    Cell,
    Constant,
    NoFormError,
    Value,
    Variable,
    cells_of,
    kind_of_value,
    longest,
    varies,
)
from slipid.exports.c99.jaxpr import Params
from slipid.exports.c99.sources import UNROLLED, along
from slipid.exports.fields import Kind, kind_of

Shaped = jax.ShapeDtypeStruct
Rule = Callable[[Builder, list[Value], Params, Shaped], Value]
Simpler = Callable[[Builder, tuple[Cell, ...], int], Cell | None]
"""Function that returns the cell that the result of an operation equals, given its operands and the
number of lanes of the result; None if the operation must be computed as it is."""


UNARY = {
    "abs": "r_abs({0})",
    "cos": "r_cos({0})",
    "exp": "r_exp({0})",
    "floor": "r_floor({0})",
    "is_finite": "is_finite({0})",
    "log": "r_log({0})",
    "neg": "-{0}",
    "not": "!{0}",
    "rsqrt": "R(1.0) / r_sqrt({0})",
    "sign": "r_sign({0})",
    "sin": "r_sin({0})",
    "sqrt": "r_sqrt({0})",
    "square": "{0} * {0}",
    "tanh": "r_tanh({0})",
    "copy": "{0}",
    "stop_gradient": "{0}",
}
BINARY = {
    "add": "{0} + {1}",
    "add_any": "{0} + {1}",
    "and": "{0} & {1}",
    "atan2": "r_atan2({0}, {1})",
    "div": "{0} / {1}",
    "eq": "{0} == {1}",
    "ge": "{0} >= {1}",
    "gt": "{0} > {1}",
    "le": "{0} <= {1}",
    "lt": "{0} < {1}",
    "max": "r_max({0}, {1})",
    "min": "r_min({0}, {1})",
    "mul": "{0} * {1}",
    "ne": "{0} != {1}",
    "or": "{0} | {1}",
    "pow": "r_pow({0}, {1})",
    "rem": "r_rem({0}, {1})",
    "sub": "{0} - {1}",
}
OF_INTS = {"max": "i_max({0}, {1})", "min": "i_min({0}, {1})", "rem": "{0} % {1}"}
"""Templates of operations that C writes differently for whole numbers."""
NEUTRAL = {"add": (0.0, 0.0), "sub": (None, 0.0), "mul": (1.0, 1.0), "div": (None, 1.0)}
"""Neutral numbers of an operation as its first and as its second operand; None if there is none."""


def applied(
    builder: Builder,
    template: str,
    kind: Kind,
    values: Sequence[Value],
    shape: tuple[int, ...],
    simpler: Simpler | None = None,
) -> Array:
    """Return the array computed by a C expression from each element of some arrays.

    Arrays are broadcast to the shape.
    """
    axis = _axis(values, shape)
    rows = [along(builder, v, shape, axis) for v in values]
    lanes = 0 if axis is None else shape[axis]
    out = []
    for cells in zip(*(row.reshape(-1) for row in rows), strict=True):
        plain = simpler(builder, cells, lanes) if simpler else None
        if plain is None:
            count = lanes if any(varies(cell) for cell in cells) else 0
            plain = builder.compute(kind, template, cells, count)
        out.append(plain)
    return Array(shape, kind, axis, cells_of(rows[0].shape, out))


def _axis(values: Sequence[Value], shape: tuple[int, ...]) -> int | None:
    """Return the axis of the lanes of an element-wise result."""
    axis = next((a for a in map(partial(_lanes, shape), values) if a is not None), None)
    return longest(shape) if axis is None and prod(shape) > UNROLLED else axis


def _lanes(shape: tuple[int, ...], value: Value) -> int | None:
    """Return the axis of a value's lanes if the result is equally long along it, else None."""
    if not isinstance(value, Array) or value.axis is None or len(value.shape) != len(shape):
        return None
    return value.axis if value.shape[value.axis] == shape[value.axis] else None


def unary(name: str) -> Rule:
    """Return the rule of a function of one number."""

    def rule(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
        if UNARY[name] == "{0}":
            return values[0]
        if kind_of_value(values[0]) == "int" and name not in ("neg", "square"):
            raise NoFormError("of whole numbers")
        return applied(builder, UNARY[name], kind_of(out.dtype), values, out.shape)

    return rule


def binary(name: str) -> Rule:
    """Return the rule of a function of two numbers; tanh(a) / b becomes one call."""
    first, second = NEUTRAL.get(name.removesuffix("_any"), (None, None))

    def simpler(builder: Builder, cells: tuple[Cell, ...], lanes: int) -> Cell | None:
        a, b = cells
        if name == "div" and isinstance(a, Variable) and a.made_by[0] == UNARY["tanh"]:
            both = (*a.made_by[1], b)
            count = lanes if any(varies(cell) for cell in both) else 0
            return builder.compute("real", "r_tanh_over({0}, {1})", both, count)
        if isinstance(a, Constant) and first is not None and a.value == first:
            return b
        if isinstance(b, Constant) and second is not None and b.value == second:
            return a
        return None

    def rule(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
        integer = kind_of_value(values[0]) == "int"
        template = OF_INTS.get(name, BINARY[name]) if integer else BINARY[name]
        return applied(builder, template, kind_of(out.dtype), values, out.shape, simpler)

    return rule


def integer_pow(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
    """Return an integer power, computed by multiplications."""
    power = params["y"]
    if power == 0:
        raise NoFormError("a power of 0")
    product = " * ".join(["{0}"] * abs(power))
    template = product if power > 0 else f"R(1.0) / ({product})"
    return applied(builder, template, kind_of(out.dtype), values, out.shape)


CONVERTED: dict[tuple[Kind, Kind], str] = {
    ("bool", "real"): "{0} ? R(1.0) : R(0.0)",
    ("bool", "int"): "{0} ? 1 : 0",
    ("int", "real"): "(real_t){0}",
    ("int", "bool"): "{0} != 0",
    ("real", "bool"): "{0} != R(0.0)",
    ("real", "int"): "to_int({0})",
}


def converted(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
    """Return the numbers converted to another kind."""
    pair = kind_of_value(values[0]), kind_of(out.dtype)
    if pair[0] == pair[1]:
        return values[0]
    return applied(builder, CONVERTED[pair], pair[1], values, out.shape)


def select(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
    """Return the first or second of two numbers, selected by a condition."""

    def simpler(builder: Builder, cells: tuple[Cell, ...], lanes: int) -> Cell | None:
        which, no, yes = cells
        if no == yes:
            return no
        return (yes if which.value else no) if isinstance(which, Constant) else None

    if len(values) != 3 or kind_of_value(values[0]) != "bool":
        raise NoFormError("more than two cases")
    kind = kind_of(out.dtype)
    return applied(builder, "{0} ? {2} : {1}", kind, values, out.shape, simpler)
