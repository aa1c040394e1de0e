"""Files of several kinds with the channels of a motor, opened as names of columns and rows.

The kinds are CSV and Parquet files, CSV files of oscilloscopes, JSON files of SysId, and data logs
of WPILib.
"""

import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.data.reading.column_names import unit_in
from slipid.data.reading.layout import Channel, Layout
from slipid.data.reading.oscilloscope import TIME, ScopeFormat, scope_format
from slipid.data.reading.sysid_json import read_sysid_json
from slipid.data.reading.table import (
    Table,
    bytes_of,
    cells_of,
    parquet_of,
    raw_bytes,
    read_table,
    wanted_names,
)
from slipid.data.reading.table_format import TableFormat, format_of, lines_of, numbers_of
from slipid.data.reading.wpilog import LogEntry, read_wpilog
from slipid.support.errors import bad_data, refused_as

STAMP = "timestamp"
"""Name of the column that is made of the times of a data log's records."""
_DAY_MS = 86_400_000.0
_NO_TEST = ("", "none")
"""Names of tests, in lower case, that stand for no test."""


@dataclass(frozen=True, eq=False)
class MotorFile:
    """A file with channels of motors.

    Attributes:
        format: format of the file, with the names and units of its columns.
        rows: function that returns the numbers of a layout's columns.
        texts: columns of text.
        zeros: columns that are zero in every row.
    """

    format: TableFormat
    rows: Callable[[Layout], Table]
    texts: frozenset[str] = frozenset()
    zeros: frozenset[str] = frozenset()


def motor_file(path: Path, delimiter: str | None = None) -> MotorFile:
    """Return an opened file of any kind.

    Args:
        path: the file.
        delimiter: character between the cells of a CSV file; None if it is unknown.

    Raises:
        DataError: the file cannot be read, or is not a log.
    """
    if path.suffix.lower() == ".json":
        format, table = read_sysid_json(path)
        return MotorFile(format, partial(_columns, table))
    if path.suffix.lower() == ".wpilog":
        return _of_entries(path, read_wpilog(path))
    if path.suffix != ".parquet" and (scope := scope_format(path)) is not None:
        return MotorFile(scope.format, partial(_scope_rows, scope))
    format = format_of(path, delimiter)
    numbers = numbers_of(format)
    zero = np.flatnonzero(~np.nan_to_num(numbers.values).any(axis=0)).tolist()
    texts = frozenset(format.names[at] for at in numbers.texts)
    zeros = frozenset(format.names[at] for at in zero) - texts
    return MotorFile(format, partial(_rows, format, texts), texts, zeros)


def tests_in(table: Table, fewest: int) -> list[tuple[str, Table]]:
    """Return the name and the rows of each test in a table, or all rows if there are no tests.

    Several tests of one name are numbered. Tests with fewer than `fewest` rows are left out.
    """
    if table.tests is None:
        return [("", table)]
    starts = np.flatnonzero(table.tests[1:] != table.tests[:-1]) + 1
    found: list[tuple[str, Table]] = []
    for rows in np.split(np.arange(len(table.tests)), starts):
        name = str(table.tests[rows[0]])
        if name.lower() in _NO_TEST or len(rows) < fewest:
            continue
        before = sum(other.split(" #")[0] == name for other, _ in found)
        found.append((f"{name} #{before + 1}" if before else name, table.rows(rows)))
    if not found:
        raise bad_data(table.path, "no rows of a test", f"tests of at least {fewest} rows")
    return found


def _columns(table: Table, layout: Layout) -> Table:
    """Return the columns of a layout from a table of all columns."""
    names = tuple(map(str, layout.columns))
    return replace(
        table, names=names, values=table.values[:, [table.names.index(n) for n in names]]
    )


def _rows(format: TableFormat, texts: frozenset[str], layout: Layout) -> Table:
    """Return the rows of a CSV or Parquet file, with the names of tests in a column of text.

    Times of day in milliseconds, as of VESC tool, go on after midnight.
    """
    table = read_table(format.path, layout)
    if "ms_today" in table.names:
        today = table["ms_today"]
        days = np.cumsum(np.diff(today, prepend=today[:1]) < -0.5 * _DAY_MS)
        table.values[:, table.names.index("ms_today")] += _DAY_MS * days
    named = [name for name in format.names if name in texts and "test" in name.lower()]
    if not named:
        return table
    if format.delimiter:
        at = format.names.index(named[0])
        body = lines_of(format.path)[format.first_data_row - 1 :]
        tests = [[*cells_of(line, format.delimiter), *[""] * at][at] for line in body]
    else:
        table_of_texts = parquet_of(format.path, bytes_of(format.path), named[:1])
        with refused_as(format.path, f"names of tests in the column '{named[0]}'"):
            tests = [str(cell) for cell in table_of_texts.column(named[0]).to_pylist()]
    return replace(table, tests=np.array(tests))


def _scope_rows(scope: ScopeFormat, layout: Layout) -> Table:
    """Return the rows of an oscilloscope's file, with a column of the time."""
    format = scope.format
    position = {name: at for at, name in enumerate(format.names) if name}
    made = {TIME} if scope.clock else set()

    def placed(channel: Channel) -> Channel:
        return replace(channel, columns=tuple(position[str(n)] for n in channel.columns))

    channels = {k: placed(c) for k, c in layout.channels.items() if not made & {*c.columns}}
    table = read_table(format.path, replace(layout, channels=channels))
    names = tuple(format.names[int(name)] for name in table.names)
    if scope.clock is None:
        return replace(table, names=names)
    start, step = scope.clock
    time = start + step * np.arange(len(table.values))
    values = np.concatenate([table.values, time[:, None]], axis=1)
    return replace(table, names=(*names, TIME), values=values)


def _of_entries(path: Path, entries: Mapping[str, LogEntry]) -> MotorFile:
    """Return an opened data log of WPILib."""
    names = (STAMP, *(name for name in entries if name != STAMP))
    units = ("s", *(unit_in(entries[name].unit) for name in names[1:]))
    format = TableFormat(path, "", 1, 0, 2, names, units)
    texts = frozenset(name for name in names[1:] if not entries[name].values)
    return MotorFile(format, partial(_entry_rows, path, entries), texts)


def _entry_rows(path: Path, entries: Mapping[str, LogEntry], layout: Layout) -> Table:
    """Return the rows of a data log: the times of the entry with most records, and all entries.

    Raises:
        DataError: an entry is no number, or the entries have no times in common.
    """
    header = [STAMP, *(name for name in entries if name != STAMP)]
    names = [name for name in wanted_names(path, header, layout, False) if name != STAMP]
    if wrong := next((name for name in names if not entries[name].values), None):
        raise bad_data(path, f"values of the type {entries[wrong].kind}", "numbers", column=wrong)
    samples = {name: entries[name].samples for name in names}
    clock = max((times for times, _ in samples.values()), key=len)
    columns = [_at(*samples[name], clock) for name in names]
    values = np.stack([clock, *columns], axis=1)
    digest = hashlib.sha256(raw_bytes(path)).hexdigest()
    tests = _states([*entries.values()], names, clock)
    lines = np.arange(1, len(clock) + 1)
    table = Table(path, digest, (STAMP, *names), values, lines, tests)
    table = table.rows(~np.isnan(values).any(axis=1))
    if not len(table.values):
        raise bad_data(path, f"no common times of {', '.join(names)}", "entries logged together")
    return table


def _at(
    times: Float[np.ndarray, " record"],
    values: Float[np.ndarray, " record"],
    clock: Float[np.ndarray, " row"],
) -> Float[np.ndarray, " row"]:
    """Return the values of an entry at the times of a clock, NaN before its first record.

    The values are interpolated; in a gap, an entry that is logged only when it changes keeps its
    value until one step of the clock before the next record.
    """
    step = float(np.median(np.diff(clock))) if len(clock) > 1 else 0.0
    gaps = np.flatnonzero(np.diff(times) > 3 * step)
    known = np.insert(times, gaps + 1, times[gaps + 1] - step)
    held = np.insert(values, gaps + 1, values[gaps])
    return np.interp(clock, known, held, left=np.nan)


def _states(
    entries: list[LogEntry], names: list[str], clock: Float[np.ndarray, " row"]
) -> np.ndarray | None:
    """Return the state of SysId's test at each time of a clock, or None without such an entry.

    Of several entries with states, that of the mechanism in the names of the used entries is taken.
    """
    test = re.compile(r"(quasistatic|dynamic)-")
    states = [one for one in entries if any(test.match(text) for text in one.texts)]
    if not states:
        return None
    of_names = (s for s in states if any(n.endswith(s.name.split("state-")[-1]) for n in names))
    state = next(of_names, states[0])
    order = np.argsort(state.times, kind="stable")
    at = np.searchsorted(np.array(state.times)[order], clock, side="right")
    return np.array(["none", *np.array(state.texts)[order]])[at]
