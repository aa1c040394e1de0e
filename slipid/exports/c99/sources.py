"""Arrays of cells: access to single elements, rearrangement, and change of the axis of lanes.

The words lane, row, cell, source and place are defined in `slipid.exports.c99.ir`.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import numpy as np

from slipid.exports.c99.builder import Builder
from slipid.exports.c99.ir import (
    LOOP_FROM,
    Array,
    At,
    Cell,
    Cells,
    Constant,
    Memory,
    Value,
    Variable,
    axis_of,
    cells_of,
    holds,
    kind_of_value,
    longest,
    numbered,
    rows_of,
    varies,
)
from slipid.exports.fields import kind_of

MOST_UNROLLED = 64
"""Largest number of elements of an array that is unrolled in C instead of becoming a loop."""


class Sources:
    """Elements of source arrays, flattened and concatenated; a place is an index of an element.

    Attributes:
        kind: kind of the numbers.
    """

    def __init__(self, builder: Builder, sources: Sequence[Value]):
        self._builder, self._sources = builder, sources
        self._starts = np.cumsum([0, *(prod(s.shape) for s in sources)])
        self.kind = kind_of_value(sources[0])
        self._ones: dict[int, Cell] = {}

    def _source(self, place: int) -> tuple[Value, int]:
        k = int(np.searchsorted(self._starts, place, side="right")) - 1
        return self._sources[k], place - int(self._starts[k])

    def _cell(self, place: int) -> tuple[Cell, int]:
        """Return the cell that contains the element with index `place`, and the element's lane."""
        source, inner = self._source(place)
        if not isinstance(source, Array):
            return Constant(source.reshape(-1)[inner].item(), kind_of(source.dtype)), 0
        at = list(np.unravel_index(inner, source.shape))
        lane = 0 if source.axis is None else int(at.pop(source.axis))
        return source.cells[tuple(at)], lane

    def best_axis(self, places: np.ndarray) -> int | None:
        """Return the best axis of lanes for an array of the elements with indices `places`.

        It is the axis along which most rows are already a cell of a source, if at least half of all
        elements are in such rows. Otherwise it is the longest axis. An array with at most
        `MOST_UNROLLED` different elements and axes shorter than 2 `LOOP_FROM` is unrolled instead,
        and the result is None.
        """
        ready = {axis: self._ready_rows(places, axis) for axis in range(places.ndim)}
        axis = max(ready, key=lambda a: (ready[a], places.shape[a], a), default=None)
        if axis is not None and 2 * ready[axis] * places.shape[axis] >= places.size > 0:
            return axis
        large = (
            len(np.unique(places)) > MOST_UNROLLED or max(places.shape, default=0) >= 2 * LOOP_FROM
        )
        return longest(places.shape) if large else None

    def _ready_rows(self, places: np.ndarray, axis: int) -> int:
        """Return the number of rows along an axis that are already a cell of a source."""
        rows = np.moveaxis(places, axis, -1)
        if rows.shape[-1] < 2:
            return 0
        flat = rows.reshape(-1, rows.shape[-1])
        return sum(self._ready_cell(row) is not None for row in flat)

    def _ready_cell(self, row: np.ndarray) -> Cell | None:
        """Return the cell of a source whose lanes have the indices (places) `row`, or None."""
        source, _ = self._source(int(row[0]))
        if not isinstance(source, Array) or source.axis is None or source.lanes != len(row):
            return None
        cell, lane = self._cell(int(row[0]))
        whole = row[0] + prod(source.shape[source.axis + 1 :]) * np.arange(len(row))
        return cell if lane == 0 and np.array_equal(row, whole) else None

    def one(self, place: int) -> Cell:
        """Return a cell for the single element with index `place`."""
        if place not in self._ones:
            self._ones[place] = self._one(place)
        return self._ones[place]

    def _one(self, place: int) -> Cell:
        cell, lane = self._cell(place)
        if not varies(cell):
            return cell
        if isinstance(cell, Variable):
            return At(cell.memory, lane)
        assert isinstance(cell, At)
        if cell.table is not None:
            return At(cell.memory, int(np.frombuffer(cell.table.values, dtype=np.int64)[lane]))
        return At(cell.memory, cell.offset + cell.stride * lane, index=cell.index)

    def row(self, row: np.ndarray) -> Cell:
        """Return a cell whose lanes are the elements with the indices (places) `row`."""
        ready = self._ready_cell(row)
        if ready is not None:
            return ready
        cells = [self.one(int(place)) for place in row]
        if all(cell == cells[0] for cell in cells):
            return cells[0]
        if all(isinstance(cell, Constant) for cell in cells):
            values = np.array([cell.value for cell in cells if isinstance(cell, Constant)])
            return At(self._builder.names.table(values, self.kind), 0, 1)
        places = _places(cells)
        if places is None and (source := self._laned_source(row)) is not None:
            moved = contiguous(self._builder, source)
            cells = [At(moved, self._source(int(place))[1]) for place in row]
            places = _places(cells)
        if places is None:
            return At(self.copied(row), 0, 1)
        first = cells[0]
        assert isinstance(first, At)
        strides = np.diff(places)
        if (strides == strides[0]).all():
            return At(first.memory, int(places[0]), int(strides[0]), first.index)
        if first.index is not None:
            return At(self.copied(row), 0, 1)
        return At(first.memory, 0, table=self._builder.names.table(places, "int"))

    def _laned_source(self, row: np.ndarray) -> Value | None:
        """Return the source that contains all elements with indices `row`, if it has lanes."""
        source, *others = (self._source(int(place))[0] for place in row)
        same = all(other is source for other in others)
        return source if same and axis_of(source) is not None else None

    def copied(self, places: np.ndarray) -> Memory:
        """Return memory that holds exactly the elements with indices `places`, in this order.

        The elements are copied only if no memory holds them in this way.
        """
        cells = [self.one(int(place)) for place in places]
        offsets = _places(cells)
        first = cells[0]
        if offsets is not None and isinstance(first, At) and first.index is None:
            whole = first.memory.size == len(cells)
            if whole and np.array_equal(offsets, np.arange(len(cells))):
                return first.memory
        memory = self._builder.array(self.kind, len(cells), tuple(dict.fromkeys(cells)))
        start = 0
        for group in _runs(cells):
            self._copy(memory, start, group)
            start += len(group)
        return memory

    def _copy(self, memory: Memory, start: int, group: list[Cell]) -> None:
        """Copy a single cell, or evenly spaced cells, to memory, beginning at index `start`."""
        first, *rest = group
        if not rest:
            self._builder.fill(memory, f"{{memory}}[{start}] = {{0}};", first)
            return
        second = rest[0]
        assert isinstance(first, At)
        assert isinstance(second, At)
        many = At(first.memory, first.offset, second.offset - first.offset, first.index)
        self._builder.fill(memory, f"{{memory}}[{start} + l] = {{0}};", many, len(group))


def contiguous(builder: Builder, value: Value) -> Memory:
    """Return memory that holds an array in row-major order; the array is stored there if needed."""
    if not isinstance(value, Array):
        return builder.names.table(value, kind_of(value.dtype))
    key = id(value.cells)
    if key not in builder.contiguous:
        builder.contiguous[key] = value, _contiguous(builder, value)
    return builder.contiguous[key][1]


def _contiguous(builder: Builder, value: Array) -> Memory:
    flat = tuple(value.cells.reshape(-1))
    if isinstance(flat[0], At) and holds(flat[0].memory, value):
        return flat[0].memory
    places = numbered(value.shape)
    if value.axis is None:
        return Sources(builder, [value]).copied(places.reshape(-1))
    stride = prod(value.shape[value.axis + 1 :])
    memory = builder.array(value.kind, places.size, flat, value.lanes)
    for start, cell in zip(np.take(places, 0, value.axis).reshape(-1), flat, strict=True):
        builder.fill(memory, f"{{memory}}[{start} + {stride} * l] = {{0}};", cell)
    return memory


def _places(cells: Sequence[Cell]) -> np.ndarray | None:
    """Return the cells' offsets in memory; None unless all have the same memory and `At.index`."""
    first = cells[0]
    for cell in cells:
        if not isinstance(cell, At) or not isinstance(first, At):
            return None
        if cell.memory != first.memory or cell.index is not first.index:
            return None
    return np.array([cell.offset for cell in cells if isinstance(cell, At)])


def _runs(cells: Sequence[Cell]) -> list[list[Cell]]:
    """Divide cells, in their order, into groups that can each be copied by one loop or statement.

    A group has three or more evenly spaced cells of the same memory, or it is a single cell.
    """
    runs: list[list[Cell]] = []
    for cell in cells:
        offsets = _places([*runs[-1][-2:], cell]) if runs else None
        if offsets is not None and len(set(np.diff(offsets))) == 1:
            runs[-1].append(cell)
        else:
            runs.append([cell])
    return [part for run in runs for part in ([run] if len(run) > 2 else [[c] for c in run])]


def rearranged(
    builder: Builder, sources: Sequence[Value], places: np.ndarray, axis: int | None = -1
) -> Value:
    """Return a new array of elements of the sources.

    Args:
        builder: builder of the code.
        sources: arrays that the elements come from.
        places: for every element of the result, its index in the flattened and concatenated
            sources.
        axis: axis of the result's lanes, None for no lanes; the default -1 means the axis that
            `Sources.best_axis` returns.
    """
    constants = [np.ravel(s) for s in sources if not isinstance(s, Array)]
    if len(constants) == len(sources):
        return np.concatenate(constants)[places]
    known = Sources(builder, sources)
    if axis == -1:
        axis = known.best_axis(places)
    rows = rows_of(places, axis)
    flat = rows.reshape(-1, rows.shape[-1])
    cells = [known.one(int(row[0])) if axis is None else known.row(row) for row in flat]
    return Array(places.shape, known.kind, axis, cells_of(rows.shape[:-1], cells))


def along(builder: Builder, value: Value, shape: tuple[int, ...], axis: int | None) -> Cells:
    """Broadcast a value to a shape, make `axis` the axis of its lanes, and return its cells."""
    if not isinstance(value, Array):
        rows = rows_of(np.broadcast_to(value, shape), axis)
        cells = [_row_of_constants(builder, row) for row in rows.reshape(-1, rows.shape[-1])]
        return cells_of(rows.shape[:-1], cells)
    if value.axis == axis and value.shape == shape:
        return value.cells
    moved = rearranged(builder, [value], np.broadcast_to(numbered(value.shape), shape), axis)
    assert isinstance(moved, Array)
    return moved.cells


def _row_of_constants(builder: Builder, row: np.ndarray) -> Cell:
    """Return a cell for a row of constants: a table, or a single constant if all are equal."""
    kind = kind_of(row.dtype)
    if row.tobytes() == len(row) * row[:1].tobytes():
        return Constant(row[0].item(), kind)
    return At(builder.names.table(row, kind), 0, 1)
