"""Sums and other reductions, over cells and over lanes.

A product with a constant 0 is omitted from a sum of products. The result is the same for finite
numbers, but infinity and NaN do not propagate through such a product as they would in JAX.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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

REDUCED = {
    "reduce_sum": ("{0} + {1}", "R(0.0)"),
    "reduce_prod": ("{0} * {1}", "R(1.0)"),
    "reduce_max": ("r_max({0}, {1})", "-R_INFINITY"),
    "reduce_min": ("r_min({0}, {1})", "R_INFINITY"),
    "reduce_and": ("{0} & {1}", "true"),
    "reduce_or": ("{0} | {1}", "false"),
}


def chained(builder: Builder, template: str, kind: Kind, cells: Cells, lanes: int) -> Cell:
    """Return the cell that results from combining cells one after the other."""
    done: Cell = cells[0]
    for cell in cells[1:]:
        count = lanes if varies(done) or varies(cell) else 0
        done = builder.compute(kind, template, (done, cell), count)
    return done


def reduced(name: str) -> Rule:
    """Return the rule of a reduction over some axes."""
    template, start = REDUCED[name]

    def rule(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
        value, axes = values[0], params["axes"]
        assert isinstance(value, Array)
        kind, own = value.kind, template
        first = _of_ints(start) if kind == "int" else start
        if kind == "int":
            own = template.replace("r_", "i_")
        lanes = 0 if value.axis is None else value.shape[value.axis]
        rest = [d for d in range(len(value.shape)) if d != value.axis]
        over = [rest.index(d) for d in axes if d != value.axis]
        moved = np.moveaxis(value.cells, over, range(-len(over), 0)) if over else value.cells
        kept = moved.shape[: moved.ndim - len(over)]
        rows = moved.reshape(prod(kept), -1)
        cells = [chained(builder, own, kind, row, lanes) for row in rows]
        if value.axis in axes:
            cells = [over_lanes(builder, own, kind, cell, lanes, first) for cell in cells]
            return Array(out.shape, kind, None, cells_of(kept, cells))
        axis = None if value.axis is None else value.axis - sum(d < value.axis for d in axes)
        return Array(out.shape, kind, axis, cells_of(kept, cells))

    return rule


def _of_ints(start: str) -> str:
    """Return the initial value of a reduction of whole numbers, from that of reals."""
    known = {"R(0.0)": "0", "R(1.0)": "1", "R_INFINITY": "INT32_MAX", "-R_INFINITY": "INT32_MIN"}
    if start not in known:
        raise NoFormError("of whole numbers")
    return known[start]


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
    (by_left, by_right), (batch_left, batch_right) = params["dimension_numbers"]
    left, right = values
    free_left = [d for d in range(len(left.shape)) if d not in (*by_left, *batch_left)]
    free_right = [d for d in range(len(right.shape)) if d not in (*by_right, *batch_right)]
    axes = _dot_axes(left, right, (by_left, by_right), (batch_left, batch_right), out.shape)
    rows = []
    for value, axis, order in (
        (left, axes.left, (batch_left, free_left, by_left)),
        (right, axes.right, (batch_right, free_right, by_right)),
    ):
        cells = along(builder, value, value.shape, axis)
        dims = [d for d in range(len(value.shape)) if d != axis]
        sizes = [[value.shape[d] for d in part if d != axis] for part in order]
        turned = np.transpose(cells, [dims.index(d) for part in order for d in part if d != axis])
        rows.append(turned.reshape([prod(s) for s in sizes]))
    shape = tuple(n for d, n in enumerate(out.shape) if d != axes.out)
    cells_out = [
        _dot_one(builder, a, b, kind_of(out.dtype), axes.lanes, axes.summed)
        for left_rows, right_rows in zip(*rows, strict=True)
        for a in left_rows
        for b in right_rows
    ]
    return Array(out.shape, kind_of(out.dtype), axes.out, cells_of(shape, cells_out))


@dataclass(frozen=True)
class _DotAxes:
    """Axes of the lanes in a product of two arrays.

    Attributes:
        left: axis of the lanes in the left array; None where it has no lanes.
        right: axis of the lanes in the right array; None where it has no lanes.
        out: axis of the lanes in the result; None where it has no lanes.
        lanes: number of lanes.
        summed: whether the products are summed over the lanes.
    """

    left: int | None = None
    right: int | None = None
    out: int | None = None
    lanes: int = 0
    summed: bool = False


def _dot_axes(
    left: Value,
    right: Value,
    by: tuple[Sequence[int], Sequence[int]],
    batch: tuple[Sequence[int], Sequence[int]],
    shape: tuple[int, ...],
) -> _DotAxes:
    free = [
        [d for d in range(len(v.shape)) if d not in (*by[k], *batch[k])]
        for k, v in enumerate((left, right))
    ]
    laned = [v.axis if isinstance(v, Array) else None for v in (left, right)]
    start = len(batch[0])
    for k in (1, 0):
        axis = laned[k]
        if axis is not None and axis in free[k]:
            out = start + (len(free[0]) if k else 0) + free[k].index(axis)
            return _DotAxes(None if k else axis, axis if k else None, out, shape[out])
    for dims, summed in ((by, True), (batch, False)):
        for k, value in enumerate((left, right)):
            axis = laned[k]
            if axis is not None and axis in dims[k]:
                place = list(dims[k]).index(axis)
                both = dims[0][place], dims[1][place]
                return _DotAxes(*both, None if summed else place, value.shape[axis], summed)
    return _DotAxes()


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
