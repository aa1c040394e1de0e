"""Sums and other reductions, over cells and over lanes.

A product with a constant 0 is omitted from a sum of products. The result is the same for finite
numbers, but infinity and NaN do not propagate through such a product as they would in JAX.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import numpy as np

from slipid.exports.c99.builder import Builder
from slipid.exports.c99.elementwise import Rule, Shaped
from slipid.exports.c99.ir import (
    Array,
    At,
    Cell,
    Cells,
    Constant,
    NoFormError,
    Value,
    cells_of,
    kind_of_value,
    varies,
)
from slipid.exports.c99.jaxpr import Params
from slipid.exports.c99.sources import along
from slipid.exports.fields import Kind, kind_of

REDUCED: dict[str, tuple[str, str, str | None]] = {
    "reduce_sum": ("{0} + {1}", "R(0.0)", "0"),
    "reduce_prod": ("{0} * {1}", "R(1.0)", "1"),
    "reduce_max": ("r_max({0}, {1})", "-R_INFINITY", "INT32_MIN"),
    "reduce_min": ("r_min({0}, {1})", "R_INFINITY", "INT32_MAX"),
    "reduce_and": ("{0} & {1}", "true", None),
    "reduce_or": ("{0} | {1}", "false", None),
}
"""Template of each reduction, and its initial value for reals or truth values and for integers."""


def chained(builder: Builder, template: str, kind: Kind, cells: Cells, lanes: int) -> Cell:
    """Return the cell that results from combining cells one after the other."""
    done: Cell = cells[0]
    for cell in cells[1:]:
        count = lanes if varies(done) or varies(cell) else 0
        done = builder.compute(kind, template, (done, cell), count)
    return done


def reduced(name: str) -> Rule:
    """Return the rule of a reduction over some axes."""
    real_template, start, start_of_ints = REDUCED[name]

    def rule(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
        value, axes = values[0], params["axes"]
        assert isinstance(value, Array)
        kind, lanes, template, first = value.kind, value.lanes, real_template, start
        if kind == "int":
            if start_of_ints is None:
                raise NoFormError("of whole numbers")
            template, first = template.replace("r_", "i_"), start_of_ints
        rest = [d for d in range(len(value.shape)) if d != value.axis]
        over = [rest.index(d) for d in axes if d != value.axis]
        moved = np.moveaxis(value.cells, over, range(-len(over), 0)) if over else value.cells
        kept = moved.shape[: moved.ndim - len(over)]
        rows = moved.reshape(prod(kept), -1)
        cells = [chained(builder, template, kind, row, lanes) for row in rows]
        if value.axis in axes:
            cells = [over_lanes(builder, template, kind, cell, lanes, first) for cell in cells]
            return Array(out.shape, kind, None, cells_of(kept, cells))
        axis = None if value.axis is None else value.axis - sum(d < value.axis for d in axes)
        return Array(out.shape, kind, axis, cells_of(kept, cells))

    return rule


def over_lanes(
    builder: Builder, template: str, kind: Kind, cell: Cell, lanes: int, start: str
) -> Cell:
    """Return a cell reduced over its lanes to one number, from the initial value `start`."""
    text = template.replace("{0}", "{acc}").replace("{1}", "{0}")
    return builder.compute(kind, text, (cell,), lanes, start)


def argmin(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
    """Return the index of the first lane that has the least number or NaN."""
    value = values[0]
    if len(value.shape) > 1 or kind_of_value(value) != "real":
        raise NoFormError("an argmin of other than one axis of reals")
    cell, lanes = along(builder, value, value.shape, 0).item(), value.shape[0]
    least = builder.compute("real", "r_min({acc}, {0})", (cell,), lanes, "R_INFINITY")
    which = At(builder.names.table(np.arange(lanes), "int"), 0, 1)
    same = "({acc} < 0) & (({0} == {1}) | ({0} != {0})) ? {2} : {acc}"
    index = builder.compute("int", same, (cell, least, which), lanes, "-1")
    return Array((), "int", None, cells_of((), [index]))


def dot(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
    """Return sums of products of two arrays, as `dot_general` of JAX defines them."""
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
    """Return cells with lanes along `axis`, with one axis for each group of axes in `order`."""
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
    """Return the axes of the lanes of a product in its left and its right array.

    They are those of an array that has lanes; None where an array does not depend on the lane.
    """
    left, right = (v.axis if isinstance(v, Array) else None for v in values)
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
    laned = lanes if any(varies(c) for c in cells) else 0
    if not summed:
        if terms == ["{0}"]:
            return cells[0]
        return builder.compute(kind, " + ".join(terms), tuple(cells), laned)
    if not laned:
        terms.append(f"R({float(lanes)})")
        whole = f"({' + '.join(terms[:-1])}) * {terms[-1]}"
        return builder.compute(kind, whole, tuple(cells), 0)
    return builder.compute(kind, " + ".join(["{acc}", *terms]), tuple(cells), laned, "R(0.0)")
