"""Arrays of cells: taken apart, put together anew, and brought to the same lanes."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import numpy as np

from slipid.control.export.c99.lowering.builder import Builder
from slipid.control.export.c99.lowering.ir import (
    Array,
    At,
    Cell,
    Cells,
    Number,
    Value,
    cells_of,
)
from slipid.control.export.c99.lowering.sources import Sources
from slipid.control.export.fields import kind_of


def rearranged(
    builder: Builder, sources: Sequence[Value], places: np.ndarray, axis: int | None = -1
) -> Value:
    """The array whose numbers stand at these places of all sources, flat and one after the other.

    Args:
        builder: of the code; sources: arrays.
        places: of every number of the result.
        axis: of the result's lanes, None for none; by default the one that costs least.
    """
    known = Sources(builder, sources)
    if known.constant:
        return known.numbers[places]
    if axis == -1:
        axis = known.best_axis(places)
    if axis is None:
        cells = [known.one(int(k)) for k in places.reshape(-1)]
        return Array(places.shape, known.kind, None, cells_of(places.shape, cells))
    rows = np.moveaxis(places, axis, -1)
    cells = [known.row(row) for row in rows.reshape(-1, rows.shape[-1])]
    return Array(places.shape, known.kind, axis, cells_of(rows.shape[:-1], cells))


def along(builder: Builder, value: Value, shape: tuple[int, ...], axis: int | None) -> Cells:
    """Cells of a value spread over a shape, with lanes along an axis."""
    if not isinstance(value, Array):
        value = np.broadcast_to(value, shape)
        if axis is None:
            flat = [Number(x, kind_of(value.dtype)) for x in value.reshape(-1).tolist()]
            return cells_of(shape, flat)
        rows = np.moveaxis(value, axis, -1)
        cells = [_table(builder, row) for row in rows.reshape(-1, rows.shape[-1])]
        return cells_of(rows.shape[:-1], cells)
    if value.axis == axis and value.shape == shape:
        return value.cells
    places = np.arange(prod(value.shape)).reshape(value.shape)
    moved = rearranged(builder, [value], np.broadcast_to(places, shape), axis)
    assert isinstance(moved, Array)
    return moved.cells


def _table(builder: Builder, row: np.ndarray) -> Cell:
    """A row of constants."""
    kind = kind_of(row.dtype)
    if row.tobytes() == len(row) * row[:1].tobytes():
        return Number(row[0].item(), kind)
    return At(builder.names.table(row, kind), 0, 1)
