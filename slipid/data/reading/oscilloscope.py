"""Layouts of the CSV files of oscilloscopes: lines of settings, then the samples of each channel.

Known are the files of Rigol, Siglent, Keysight and older Tektronix oscilloscopes; those of newer
Tektronix ones have ordinary column names above their samples.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from slipid.data.reading.table import cells_of, number_in
from slipid.data.reading.table_format import TableFormat, first_lines
from slipid.support.errors import bad_data

TIME = "time"
"""Name that is given to the time, in seconds."""
_UNITS = {"volt": "V", "v": "V", "ampere": "A", "amp": "A", "a": "A", "second": "s", "s": "s"}
_LONGEST_S = 1e9
"""Largest start and step of an oscilloscope's time [s]."""
_LINES = 60
"""Number of first lines that may be settings."""
_SETTINGS = ("horizontal", "vertical", "record", "sample", "analog", "model")
"""First words of lines of settings."""
_CLOCK = re.compile(r"t0\s*=\s*(\S+?)s?\s*,\s*tInc\s*=\s*(\S+?)s?\s*(,|$)", re.IGNORECASE)


@dataclass(frozen=True)
class ScopeFormat:
    """Format of an oscilloscope's file.

    Attributes:
        format: format of the file; its columns are read by their positions. A column `TIME` that
            the file lacks stands behind the others.
        clock: time of the first sample and time between samples, if the file lacks a column of the
            time [s].
    """

    format: TableFormat
    clock: tuple[float, float] | None = None


def scope_format(path: Path) -> ScopeFormat | None:
    """Return the format of an oscilloscope's CSV file, or None for another file."""
    lines = first_lines(path)[:_LINES]
    rows = [cells_of(line, ",") for line in lines]
    if rows[0][0] == "Record Length" and len(rows[0]) > 4 and _numbers(rows[0][3:5]) is not None:
        source = next((row[1] for row in rows if row[0] == "Source" and len(row) > 1), "") or "CH1"
        return _made(path, 0, ["", "", "", TIME, source], ["", "", "", "s", "V"])
    if (found := _CLOCK.search(lines[0])) and (clock := _numbers([found[1], found[2]])):
        names = cells_of(lines[0][: found.start()].rstrip(", "), ",")
        return _made(path, 1, names, ["" for _ in names], clock)
    for k, row in enumerate(rows[:-1]):
        if row[0].lower() not in ("second", "sequence") or number_in(rows[k + 1][0]) is None:
            continue
        above = rows[k - 1] if k else [""]
        settings = above[0].lower().startswith(_SETTINGS)
        if above[0].lower() not in ("", "x", "x-axis", "source", "time") and not settings:
            return None
        if above[0] == "" or settings:
            above = []
        if row[0].lower() == "second":
            names = [name or f"CH{j}" for j, name in enumerate(_padded(above, len(row)))]
            return _made(path, k + 1, [TIME, *names[1:]], row)
        lower = [cell.lower() for cell in above]
        if "start" in lower and "increment" in lower and len(row) >= len(lower) - 1:
            width = lower.index("start")
            if clock := _numbers([row[width], row[lower.index("increment")]]):
                return _made(path, k + 1, above[:width], row[:width], clock)
    return None


def _padded(cells: list[str], width: int) -> list[str]:
    """Return cells with empty ones behind them, so that there are `width`."""
    return [*cells, *[""] * width][:width]


def _numbers(cells: list[str]) -> tuple[float, float] | None:
    """Return two numbers, or None if the cells are not numbers."""
    first, second = (number_in(cell) for cell in cells)
    return None if first is None or second is None else (first, second)


def _made(
    path: Path,
    header: int,
    names: list[str],
    units: list[str],
    clock: tuple[float, float] | None = None,
) -> ScopeFormat:
    """Return a format with `header` lines above the samples.

    Raises:
        DataError: the clock is impossible.
    """
    if clock and not (abs(clock[0]) < _LONGEST_S and 0 < clock[1] < _LONGEST_S):
        found = f"samples every {clock[1]:g} s from {clock[0]:g} s"
        raise bad_data(path, found, "a start and a step of the time", row=max(header, 1))
    units = [_UNITS.get(unit.lower(), "") for unit in _padded(units, len(names))]
    if clock:
        names, units = [*names, TIME], [*units, "s"]
    format = TableFormat(path, ",", 0, 0, header + 1, tuple(names), tuple(units))
    return ScopeFormat(format, clock)
