"""Rules of primitives that slice, join and index arrays, at constant or variable indices."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import numpy as np
from jax import lax
from jax.extend.core import Primitive

from slipid.exports.c99.arithmetic import Rule, Shaped, binary
from slipid.exports.c99.builder import Builder
from slipid.exports.c99.ir import (
    Array,
    At,
    Cell,
    Constant,
    NoFormError,
    Value,
    Variable,
    axis_of,
    cells_of,
    numbered,
    read_at,
)
from slipid.exports.c99.jaxpr import Params
from slipid.exports.c99.sources import along, contiguous, rearranged

MOVES = frozenset(
    {
        *("broadcast_in_dim", "concatenate", "dynamic_slice", "expand_dims", "gather", "pad"),
        *("reshape", "rev", "slice", "split", "squeeze", "stack", "transpose", "unstack"),
    }
)
"""Primitives that only rearrange elements of arrays, provided that all indices are constant."""
SOURCES = {"gather": 1, "dynamic_slice": 1}
"""Number of leading arguments that a primitive rearranges; its further arguments are indices.
Primitives that are not listed rearrange all their arguments."""


def moved(primitive: Primitive, sources: int) -> Rule:
    """Return the rule of a primitive that rearranges the elements of its first `sources` arguments.

    Further arguments are indices and must be constant. If `sources` is 0, all arguments are
    rearranged. The primitive is applied to the elements' indices, to find the origin of each
    element of the result.
    """

    def rule(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
        taken = values[:sources] if sources else values
        starts = np.cumsum([0, *(prod(v.shape) for v in taken)])
        places = [start + numbered(v.shape) for start, v in zip(starts, taken, strict=False)]
        moved_places = primitive.bind(*places, *values[len(taken) :], **params)
        return rearranged(builder, taken, np.asarray(moved_places))

    return rule


def scatter(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
    """Return an array in which elements at constant indices are replaced."""
    old, where, new = values
    places = _scattered(numbered(old.shape), where, new.shape, params, prod(old.shape))
    return rearranged(builder, [old, new], places)


def scattered(name: str, neutral: float) -> Rule:
    """Return the rule of a primitive that changes elements at constant indices by an operation.

    `name` is the operation, "add" or "mul", and `neutral` its neutral element. Each index may occur
    only once.
    """

    def rule(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
        old, where, new = values
        size = prod(new.shape)
        places = _scattered(np.full(old.shape, size), where, new.shape, params, 0)
        others = rearranged(builder, [new, np.asarray([neutral])], places)
        return binary(name)(builder, [old, others], params, out)

    return rule


def _scattered(
    old: np.ndarray, where: Value, shape: tuple[int, ...], params: Params, fresh: int
) -> np.ndarray:
    """Return `old` with the elements at the indices `where` replaced by `fresh`, `fresh` + 1, ...

    The new numbers are source indices (places) of the elements of an array with the shape `shape`,
    in row-major order.
    """
    if isinstance(where, Array):
        raise NoFormError("indices that are not constant are not supported")
    kept = {k: params[k] for k in ("dimension_numbers", "indices_are_sorted", "mode")}
    new = fresh + numbered(shape)
    options = {**kept, "unique_indices": False}
    times = lax.scatter_add(np.zeros(old.shape, int), where, np.ones(shape, int), **options)
    if np.max(times, initial=0) > 1:
        raise NoFormError("an index that occurs twice is not supported")
    return np.asarray(lax.scatter(old, where, new, **options))


def dynamic_slice(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
    """Return the part of an array whose first indices are computed at run time."""
    whole, starts, sizes = values[0], values[1:], params["slice_sizes"]
    memory = contiguous(builder, whole)
    base = _offset(builder, [along(builder, s, (), None).item() for s in starts], whole, sizes)
    places = numbered(whole.shape)[tuple(slice(0, n) for n in sizes)]
    return read_at(memory, places, base)


def _offset(
    builder: Builder, starts: Sequence[Cell], whole: Value, sizes: Sequence[int], lanes: int = 0
) -> Variable:
    """Return the row-major index of the first element of a part of an array.

    As in JAX, a part that exceeds the array's bounds is shifted into the array. The result has
    lanes if any start index has different values in different lanes.
    """
    terms, cells = [], []
    for axis, (start, size) in enumerate(zip(starts, sizes, strict=True)):
        most, stride = whole.shape[axis] - size, prod(whole.shape[axis + 1 :])
        if most:
            terms.append(f"i_min(i_max({{{len(cells)}}}, 0), {most}) * {stride}")
            cells.append(start)
    return builder.compute("int", " + ".join(terms) or "0", tuple(cells), lanes)


def gather(builder: Builder, values: list[Value], params: Params, out: Shaped) -> Value:
    """Return parts of an array at indices computed at run time, clipped to the array's bounds."""
    whole, where = values
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    if numbers.operand_batching_dims or numbers.start_indices_batching_dims:
        raise NoFormError("batches of indices are not supported")
    if params["mode"] == lax.GatherScatterMode.FILL_OR_DROP:
        raise NoFormError("indices out of range give a fill value, which is not supported")
    memory = contiguous(builder, whole)
    batch = [d for d in range(len(out.shape)) if d not in numbers.offset_dims]
    kept = [d for d in range(len(whole.shape)) if d not in numbers.collapsed_slice_dims]
    own = axis_of(where)
    axis = None if own is None else batch[own]
    lanes = 0 if own is None else where.shape[own]
    places = along(builder, where, where.shape, own)
    strides = [prod(whole.shape[d + 1 :]) for d in range(len(whole.shape))]
    shape = tuple(n for d, n in enumerate(out.shape) if d != axis)
    rest = [d for d in range(len(out.shape)) if d != axis]
    cells: list[Cell] = []
    for at in np.ndindex(*shape):
        place = dict(zip(rest, at, strict=True))
        row = places[tuple(place[d] for d in batch if d != axis)]
        starts: list[Cell] = [Constant(0, "int")] * len(whole.shape)
        for k, d in enumerate(numbers.start_index_map):
            starts[d] = row[k]
        base = _offset(builder, starts, whole, sizes, lanes)
        inner = sum(place[o] * strides[d] for o, d in zip(numbers.offset_dims, kept, strict=True))
        read = At(memory, inner, index=base)
        cells.append(builder.compute(memory.kind, "{0}", (read,), base.lanes))
    return Array(out.shape, memory.kind, axis, cells_of(shape, cells))
