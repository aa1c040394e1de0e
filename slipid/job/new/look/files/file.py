"""What a log file looks like: where names, units and numbers stand, and the numbers themselves."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from slipid.data.reading import csv_text
from slipid.job.new.look.files.sniff import (
    EMPTY,
    HEAD,
    cells_of,
    delimiter_of,
    first_numbers,
    header_rows,
    number_in,
)
from slipid.support.errors import DataError, bad_data

if TYPE_CHECKING:
    from pyarrow import Table

ROWS = 50_000
"""Rows that are looked at for what the numbers are like."""
_FEW = 10
"""Rows of numbers from which a file can be a log: settings have fewer."""
_BEGINNING = 200_000
"""Bytes of a file that are read to see what kind it is."""
SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".log", ".parquet")
"""Of files that may be logs."""


@dataclass(frozen=True)
class Head:
    """Where things stand in a file of rows.

    Attributes:
        path: the file.
        delimiter: between its cells; empty for Parquet.
        names_row, units_row, first_data_row: as of `Layout`.
        names: of its columns, empty ones where it has none.
        units: of its columns as a row of units says, empty ones where there is none.
    """

    path: Path
    delimiter: str
    names_row: int
    units_row: int
    first_data_row: int
    names: tuple[str, ...]
    units: tuple[str, ...]

    @property
    def signature(self) -> "Head":
        """What files of one kind have in common."""
        return replace(self, path=Path())

    def column(self, at: int) -> str | int:
        """What a layout calls a column: its name, or its position."""
        return self.names[at] if self.names_row else at


@dataclass(frozen=True, eq=False)
class Numbers:
    """What is in a file of rows: its cells, NaN where they are empty or no number.

    `texts` are the columns that hold something else than numbers.
    """

    head: Head
    values: Float[np.ndarray, "row column"]
    texts: frozenset[int]


def head_of(path: Path) -> Head:
    """Where things stand in a file.

    Raises:
        DataError: it cannot be read, is empty, or is no log of rows of numbers.
    """
    if path.suffix == ".parquet":
        header = tuple(_parquet(path).column_names)
        return Head(path, "", 1, 0, 2, header, ("",) * len(header))
    lines = _lines(path, _BEGINNING)
    delimiter = delimiter_of(lines)
    rows = [cells_of(line, delimiter) for line in lines[:HEAD]]
    first = first_numbers(rows)
    _refuse_commas(path, rows[first or 0 :], delimiter, first or 0)
    if first is None or len(rows) - first < min(_FEW, HEAD - first):
        raise bad_data(path, "no rows of numbers", "a log: a row of numbers for every time")
    names_row, units_row = header_rows(rows[:first], len(rows[first]))
    top = rows[names_row - 1] if names_row else []
    if not top and any(number_in(c) is None and c.lower() not in EMPTY for c in rows[first]):
        raise bad_data(path, "texts among the numbers, and no names", "a log", row=first + 1)
    width = len(top) or len(rows[first])
    names = [*top, *[""] * width][:width]
    if names_row and width > 1 and not names[-1]:
        width -= 1  # a delimiter at the end of every line
    units = rows[units_row - 1] if units_row else []
    units = [*units, *[""] * width][:width]
    where = (names_row, units_row, first + 1)
    return Head(path, delimiter, *where, tuple(names[:width]), tuple(units))


def numbers_of(head: Head) -> Numbers:
    """The numbers of a file, its first `ROWS` rows."""
    if not head.delimiter:
        return _parquet_numbers(head)
    lines = _lines(head.path)
    body = [line for line in lines[head.first_data_row - 1 :][:ROWS] if line.strip()]
    width = len(head.names)
    try:
        columns = range(width)
        values = np.loadtxt(body, delimiter=head.delimiter, usecols=columns, ndmin=2, comments=None)
        return Numbers(head, values, frozenset())
    except ValueError:
        return _cell_by_cell(head, body)


def _cell_by_cell(head: Head, body: list[str]) -> Numbers:
    """The slow way: accepts empty cells and texts."""
    width = len(head.names)
    values = np.full((len(body), width), np.nan)
    wrong = np.zeros(width, dtype=int)
    for i, line in enumerate(body):
        for j, cell in enumerate(cells_of(line, head.delimiter)[:width]):
            number = number_in(cell)
            if number is not None:
                values[i, j] = number
            elif cell.lower() not in EMPTY:
                wrong[j] += 1
    texts = np.flatnonzero(wrong > 0.02 * len(body)).tolist()
    return Numbers(head, values, frozenset(texts))


def _lines(path: Path, limit: int = -1) -> list[str]:
    """Lines of a text file, or of its beginning, the last one whole."""
    try:
        with path.open("rb") as file:
            raw = file.read(limit)
    except OSError as error:
        raise bad_data(path, f"cannot be read ({error.strerror})", "a log of rows") from error
    if not raw.strip():
        raise bad_data(path, "the file is empty", "a header and rows of numbers")
    if len(raw) == limit and b"\n" in raw:
        raw = raw[: raw.rindex(b"\n")]
    return csv_text.text_lines(path, raw)


def _refuse_commas(path: Path, body: list[list[str]], delimiter: str, first: int) -> None:
    """Refuse decimal commas here already: no layout could read them."""
    if delimiter == ",":
        return
    for k, cells in enumerate(body[:HEAD]):
        for cell in cells:
            whole, comma, part = cell.lstrip("+-").partition(",")
            if comma and whole.isdecimal() and part.isdecimal():
                raise bad_data(path, f"'{cell}'", "decimal points, not commas", row=first + 1 + k)


def _parquet(path: Path) -> "Table":
    """A Parquet file; DataError where it is none, or has no rows."""
    try:
        import pyarrow
        import pyarrow.parquet as parquet
    except ImportError as error:
        expected = "pyarrow to read it with: pip install 'slipid[parquet]'"
        raise bad_data(path, "a Parquet file", expected) from error
    try:
        table = parquet.read_table(path)
    except (pyarrow.ArrowException, OSError) as error:
        raise bad_data(path, f"no Parquet ({error})", "a whole Parquet file") from error
    if not table.num_rows:
        raise bad_data(path, "no rows", "rows of numbers")
    return table


def _parquet_numbers(head: Head) -> Numbers:
    import pyarrow

    table = _parquet(head.path)
    values = np.full((min(table.num_rows, ROWS), table.num_columns), np.nan)
    texts = set()
    for k, name in enumerate(table.column_names):
        try:
            column = table.column(name).slice(0, ROWS).cast(pyarrow.float64())
            values[:, k] = column.to_numpy()
        except pyarrow.ArrowException:
            texts.add(k)
    return Numbers(head, values, frozenset(texts))


@dataclass(frozen=True)
class NoLog:
    """A file that might have been a log, and why it is none."""

    path: Path
    why: str


def heads_below(folder: Path) -> tuple[list[Head], list[NoLog]]:
    """Every log in a folder and below, and the files that are none.

    Raises:
        DataError: there is none.
    """
    found, not_logs = [], []
    paths = sorted(p for p in folder.rglob("*") if p.is_file() and p.suffix.lower() in SUFFIXES)
    for path in paths:
        try:
            head = head_of(path)
        except DataError as error:
            not_logs.append(NoLog(path, str(error)))
            continue
        found.append(head)
    if not found:
        there = f"no log in {len(paths)} files" if paths else "no CSV or Parquet file below it"
        listed = "".join(f"\n{one.why}" for one in not_logs[:3])
        raise DataError(f"{folder}: {there}; expected logs of a robot{listed}")
    return found, not_logs
