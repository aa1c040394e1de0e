"""Rules that convert arithmetic primitives of JAX to C: element-wise, reductions, matrix products.

A product with a constant 0 is omitted from a sum of products. For finite numbers this does not
change the result, but infinity or NaN times such a constant counts as 0, where JAX gives NaN. The
words lane, row and cell are defined in `slipid.exports.c99.ir`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from math import prod

import jax
import numpy as np

from slipid.exports.c99.builder import Builder
from slipid.exports.c99.ir import (
    Array,
    At,
    Cell,
    Cells,
    Constant,
    NoFormError,
    Value,
    Variable,
    axis_of,
    cells_of,
    kind_of_value,
    longest,
    varies,
)
from slipid.exports.c99.jaxpr import Params
from slipid.exports.c99.sources import MOST_UNROLLED, along
from slipid.exports.fields import Kind, kind_of

Shaped = jax.ShapeDtypeStruct
"""Shape and data type of a result."""
Rule = Callable[[Builder, list[Value], Params, Shaped], Value]
Simpler = Callable[[Builder, tuple[Cell, ...], int], Cell | None]
"""Function that simplifies an operation, given its operands and the number of lanes of the result.

A lane is an iteration of the C loop that computes the result, see `slipid.exports.c99.ir`. The
function returns a cell that equals the result, such as one of the operands; None if the operation
cannot be simplified."""


UNARY = {
    **{
        name: f"r_{name}({{0}})"
        for name in ("abs", "cos", "exp", "floor", "log", "sign", "sin", "sqrt", "tanh")
    },
    **dict.fromkeys(("copy", "stop_gradient"), "{0}"),
    "is_finite": "is_finite({0})",
    "neg": "-{0}",
    "not": "!{0}",
    "rsqrt": "R(1.0) / r_sqrt({0})",
    "square": "{0} * {0}",
}
"""C expressions of the primitives with one operand; the functions r_... are in prelude.c."""
BINARY = {
    **{name: f"r_{name}({{0}}, {{1}})" for name in ("atan2", "max", "min", "pow", "rem")},
    **dict.fromkeys(("add", "add_any"), "{0} + {1}"),
    "and": "{0} & {1}",
    "div": "{0} / {1}",
    "eq": "{0} == {1}",
    "ge": "{0} >= {1}",
    "gt": "{0} > {1}",
    "le": "{0} <= {1}",
    "lt": "{0} < {1}",
    "mul": "{0} * {1}",
    "ne": "{0} != {1}",
    "or": "{0} | {1}",
    "sub": "{0} - {1}",
}
"""C expressions of the primitives with two operands."""
INTEGER_TEMPLATES = {"max": "i_max({0}, {1})", "min": "i_min({0}, {1})", "rem": "{0} % {1}"}
"""Templates of operations whose C expression differs for integers."""
NEUTRAL = {"add": (0.0, 0.0), "sub": (None, 0.0), "mul": (1.0, 1.0), "div": (None, 1.0)}
"""Neutral elements of each operation: a value of the first operand with which the result equals the
second, and a value of the second operand with which the result equals the first; None if there is
no such value."""


def applied(
    builder: Builder,
    template: str,
    kind: Kind,
    values: Sequence[Value],
    shape: tuple[int, ...],
    simpler: Simpler | None = None,
) -> Array:
    """Broadcast arrays to a shape and apply a C expression to them element by element."""
    axis = _axis(values, shape)
    rows = [along(builder, v, shape, axis) for v in values]
    lanes = 0 if axis is None else shape[axis]
    out = []
    for cells in zip(*(row.reshape(-1) for row in rows), strict=True):
        plain = simpler(builder, cells, lanes) if simpler else None
        out.append(plain or builder.compute(kind, template, cells, lanes))
    return Array(shape, kind, axis, cells_of(rows[0].shape, out))


def _axis(values: Sequence[Value], shape: tuple[int, ...]) -> int | None:
    """Return the axis of the lanes of an element-wise result.

    It is the lane axis of the first operand that has lanes and is not broadcast along them. If
    there is no such operand, it is the longest axis of a result with more than `MOST_UNROLLED`
    elements; a smaller result has no lanes, and None is returned.
    """
    for value in values:
        axis = axis_of(value)
        if axis is not None and len(value.shape) == len(shape) and value.shape[axis] == shape[axis]:
            return axis
    return longest(shape) if prod(shape) > MOST_UNROLLED else None


def unary(name: str) -> Rule:
    """Return the rule of a primitive with one operand."""

    def rule(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
        if UNARY[name] == "{0}":
            return values[0]
        if kind_of_value(values[0]) == "int" and name not in ("neg", "square"):
            raise NoFormError("it is not supported for integers")
        return applied(builder, UNARY[name], kind_of(out.dtype), values, out.shape)

    return rule


def binary(name: str) -> Rule:
    """Return the rule of a primitive with two operands; tanh(a) / b becomes a single call."""
    first, second = NEUTRAL.get(name.removesuffix("_any"), (None, None))

    def simpler(builder: Builder, cells: tuple[Cell, ...], lanes: int) -> Cell | None:
        a, b = cells
        if name == "div" and isinstance(a, Variable) and a.made_by[0] == UNARY["tanh"]:
            return builder.compute("real", "r_tanh_over({0}, {1})", (*a.made_by[1], b), lanes)
        if isinstance(a, Constant) and first is not None and a.value == first:
            return b
        if isinstance(b, Constant) and second is not None and b.value == second:
            return a
        return None

    def rule(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
        integer = kind_of_value(values[0]) == "int"
        template = INTEGER_TEMPLATES.get(name, BINARY[name]) if integer else BINARY[name]
        return applied(builder, template, kind_of(out.dtype), values, out.shape, simpler)

    return rule


def integer_pow(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
    """Return an array raised to an integer power by repeated multiplication."""
    power = params["y"]
    if power == 0:
        raise NoFormError("an exponent of 0 is not supported")
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
"""C expressions that convert a number, keyed by its kind before and after."""


def converted(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
    """Return an array converted to another kind of number."""
    pair = kind_of_value(values[0]), kind_of(out.dtype)
    if pair[0] == pair[1]:
        return values[0]
    return applied(builder, CONVERTED[pair], pair[1], values, out.shape)


def select(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
    """Choose between two arrays element by element: the second array where a condition is true."""

    def simpler(builder: Builder, cells: tuple[Cell, ...], lanes: int) -> Cell | None:
        which, no, yes = cells
        if no == yes:
            return no
        return (yes if which.value else no) if isinstance(which, Constant) else None

    if len(values) != 3 or kind_of_value(values[0]) != "bool":
        raise NoFormError("more than two cases are not supported")
    kind = kind_of(out.dtype)
    return applied(builder, "{0} ? {2} : {1}", kind, values, out.shape, simpler)


REDUCED: dict[str, tuple[str, str, str | None]] = {
    "reduce_sum": ("{0} + {1}", "R(0.0)", "0"),
    "reduce_prod": ("{0} * {1}", "R(1.0)", "1"),
    "reduce_max": ("r_max({0}, {1})", "-R_INFINITY", "INT32_MIN"),
    "reduce_min": ("r_min({0}, {1})", "R_INFINITY", "INT32_MAX"),
    "reduce_and": ("{0} & {1}", "true", None),
    "reduce_or": ("{0} | {1}", "false", None),
}
"""For each reduction: its template, its initial value for real numbers or truth values, and its
initial value for integers."""


def reduced(name: str) -> Rule:
    """Return the rule of a reduction over some axes."""
    real_template, start, start_of_ints = REDUCED[name]

    def rule(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
        value, axes = values[0], params["axes"]
        assert isinstance(value, Array)
        kind, lanes, template, first = value.kind, value.lanes, real_template, start
        if kind == "int":
            if start_of_ints is None:
                raise NoFormError("it is not supported for integers")
            template, first = template.replace("r_", "i_"), start_of_ints
        rest = [d for d in range(len(value.shape)) if d != value.axis]
        over = [rest.index(d) for d in axes if d != value.axis]
        moved = np.moveaxis(value.cells, over, range(-len(over), 0)) if over else value.cells
        kept = moved.shape[: moved.ndim - len(over)]

        def chained(done: Cell, cell: Cell) -> Cell:
            return builder.compute(kind, template, (done, cell), lanes)

        cells = [reduce(chained, row) for row in moved.reshape(prod(kept), -1)]
        if value.axis in axes:
            text = template.replace("{0}", "{acc}").replace("{1}", "{0}")
            cells = [builder.compute(kind, text, (cell,), lanes, first) for cell in cells]
            return Array(out.shape, kind, None, cells_of(kept, cells))
        axis = None if value.axis is None else value.axis - sum(d < value.axis for d in axes)
        return Array(out.shape, kind, axis, cells_of(kept, cells))

    return rule


def argmin(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
    """Return the index of the smallest element, or of the first NaN if there is one."""
    value = values[0]
    if len(value.shape) > 1 or kind_of_value(value) != "real":
        raise NoFormError("it is supported only for an array of real numbers with one axis")
    cell, lanes = along(builder, value, value.shape, 0).item(), value.shape[0]
    least = builder.compute("real", "r_min({acc}, {0})", (cell,), lanes, "R_INFINITY")
    which = At(builder.names.table(np.arange(lanes), "int"), 0, 1)
    same = "({acc} < 0) & (({0} == {1}) | ({0} != {0})) ? {2} : {acc}"
    index = builder.compute("int", same, (cell, least, which), lanes, "-1")
    return Array((), "int", None, cells_of((), [index]))


def dot(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
    """Return the product of two arrays as the JAX primitive `dot_general` defines it."""
    summed, batch = params["dimension_numbers"]
    free = [
        [d for d in range(len(v.shape)) if d not in (*summed[k], *batch[k])]
        for k, v in enumerate(values)
    ]
    axes = _lane_axes(values, summed, batch, free)
    lanes = max(0 if a is None else v.shape[a] for v, a in zip(values, axes, strict=True))
    of_result = [*zip(*batch, strict=True), *((d, None) for d in free[0])]
    of_result += [(None, d) for d in free[1]]
    axis = of_result.index(axes) if axes in of_result else None
    orders = (batch[0], free[0], summed[0]), (batch[1], free[1], summed[1])
    left, right = (
        _ordered(along(builder, v, v.shape, a), v.shape, a, order)
        for v, a, order in zip(values, axes, orders, strict=True)
    )
    cells = [
        _dot_one(builder, a, b, kind_of(out.dtype), lanes, axes[0] in summed[0])
        for left_rows, right_rows in zip(left, right, strict=True)
        for a in left_rows
        for b in right_rows
    ]
    shape = tuple(n for d, n in enumerate(out.shape) if d != axis)
    return Array(out.shape, kind_of(out.dtype), axis, cells_of(shape, cells))


def _ordered(
    cells: Cells, shape: tuple[int, ...], axis: int | None, order: Sequence[Sequence[int]]
) -> Cells:
    """Transpose cells to the order of axes in `order`, and merge each group of axes into one.

    `order` lists axes of the array that the cells belong to. The array has the shape `shape`, and
    its lanes are along `axis`, which is not an axis of the cells.
    """
    dims = [d for d in range(len(shape)) if d != axis]
    groups = [[d for d in part if d != axis] for part in order]
    turned = np.transpose(cells, [dims.index(d) for group in groups for d in group])
    return turned.reshape([prod(shape[d] for d in group) for group in groups])


def _lane_axes(
    values: Sequence[Value],
    summed: Sequence[Sequence[int]],
    batch: Sequence[Sequence[int]],
    free: Sequence[Sequence[int]],
) -> tuple[int | None, int | None]:
    """Return the axis along which a product loops, as an axis of the left and of the right array.

    The loop runs along the lanes of one of the arrays. The result is None for an array without a
    corresponding axis, and for both arrays if neither has lanes.
    """
    left, right = map(axis_of, values)
    if right in free[1]:
        return None, right
    if left in free[0]:
        return left, None
    for dims in (summed, batch):
        for axis, own in zip((left, right), dims, strict=True):
            if axis is not None and axis in own:
                place = list(own).index(axis)
                return dims[0][place], dims[1][place]
    return None, None


def _dot_one(
    builder: Builder, left: Cells, right: Cells, kind: Kind, lanes: int, summed: bool
) -> Cell:
    """Return the cell of one element of a product: the sum of the products of two rows of cells.

    If `summed` is True, the sum also runs over the lanes.
    """
    terms: list[str] = []
    cells: list[Cell] = []
    for a, b in zip(left, right, strict=True):
        factors = [c for c in (a, b) if not (isinstance(c, Constant) and c.value == 1)]
        if any(isinstance(c, Constant) and c.value == 0 for c in factors):
            continue
        if not factors:
            factors = [Constant(1.0, kind)]
        terms.append(" * ".join(f"{{{len(cells) + k}}}" for k in range(len(factors))))
        cells.extend(factors)
    if not terms:
        return Constant(0.0, kind)
    if not summed:
        if terms == ["{0}"]:
            return cells[0]
        return builder.compute(kind, " + ".join(terms), tuple(cells), lanes)
    if not any(map(varies, cells)):
        terms.append(f"R({float(lanes)})")
        whole = f"({' + '.join(terms[:-1])}) * {terms[-1]}"
        return builder.compute(kind, whole, tuple(cells), 0)
    return builder.compute(kind, " + ".join(["{acc}", *terms]), tuple(cells), lanes, "R(0.0)")
