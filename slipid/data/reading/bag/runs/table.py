"""Runs by a table of their times."""

import csv
from pathlib import Path

from slipid.data.reading.bag.layout import RunRule
from slipid.data.reading.bag.runs.stretch import Stretch
from slipid.support.errors import bad_data, near

COLUMNS = ("start", "end", "surface", "load", "name", "bag")
"""Columns that a table of runs may have; the first two it must have."""


def by_table(path: Path, rule: RunRule, zero: float) -> list[Stretch]:
    """Runs in a CSV file.

    Args:
        path: the bag; rows whose column `bag` names another are left out.
        rule: names the table.
        zero: time that its times count from [s].

    Raises:
        DataError: the table is missing or wrong; the message names the row.
    """
    file = path.parent / str(rule.table)
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        expected = f"a CSV table of runs with the columns {', '.join(COLUMNS[:2])}"
        raise bad_data(file, f"cannot be read ({error})", expected) from error
    reader = csv.DictReader(lines, skipinitialspace=True)
    names = reader.fieldnames or []
    for name in names:
        if name not in COLUMNS:
            found = f"column '{name}'{near(name, COLUMNS)}"
            raise bad_data(file, found, f"columns of {', '.join(COLUMNS)}", row=1)
    if missing := [name for name in COLUMNS[:2] if name not in names]:
        raise bad_data(file, f"no column '{missing[0]}'", "the columns start and end", row=1)
    found_runs = []
    for cells in reader:
        row = reader.line_num
        if (cells.get("bag") or path.name) not in (path.name, path.stem):
            continue
        start, end = (_time(file, row, name, cells[name]) for name in COLUMNS[:2])
        if not start < end:
            raise bad_data(file, f"a run from {start:g} to {end:g} s", "start before end", row=row)
        suffix = f"#{cells['name']}" if cells.get("name") else ""
        surface, load = cells.get("surface") or None, cells.get("load") or None
        found_runs.append(Stretch(zero + start, zero + end, suffix, surface, load))
    return found_runs


def _time(file: Path, row: int, column: str, cell: str | None) -> float:
    try:
        return float(cell or "")
    except ValueError as error:
        found = f"'{cell or ''}'"
        raise bad_data(file, found, "a time in seconds", row=row, column=column) from error
