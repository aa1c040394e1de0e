"""Detection of the format of a file of rows for which no layout is known.

The format is the delimiter, and the lines of names, units and numbers.
"""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.data.reading.column_names import is_unit, unit_in
from slipid.data.reading.table import (
    MISSING,
    bytes_of,
    cell_numbers,
    cells_of,
    number_in,
    parquet_names,
    parquet_numbers,
    text_lines,
)
from slipid.support.errors import bad_data

ROWS = 50_000
"""Largest number of rows whose numbers are examined."""
_DELIMITERS = (",", ";", "\t", "|", " ")
_HEADER_LINES = 60
"""Number of first lines that are searched for the header."""
_LEAST_ROWS = 10
"""Files with fewer rows of numbers are not logs but, for example, files of settings."""
_SAMPLE_BYTES = 200_000
"""Number of first bytes of a file from which its format is determined."""


@dataclass(frozen=True)
class TableFormat:
    """Format of a file of rows.

    Attributes:
        path: path of the file.
        delimiter: character between cells; empty for Parquet.
        names_row: line with the column names, counted from 1; 0 if there is none.
        units_row: line with the units, counted from 1; 0 if there is none.
        first_data_row: first line of numbers, counted from 1.
        names: name of each column, empty if it has none.
        units: unit of each column in the row of units, empty if there is none.
    """

    path: Path
    delimiter: str
    names_row: int
    units_row: int
    first_data_row: int
    names: tuple[str, ...]
    units: tuple[str, ...]

    @property
    def signature(self) -> "TableFormat":
        """Return the format without its path; it is equal for all files of one type."""
        return replace(self, path=Path())

    def column(self, at: int) -> str | int:
        """Return the name of a column in a layout, or its position if the file has no names."""
        return self.names[at] if self.names_row else at


@dataclass(frozen=True, eq=False)
class TableNumbers:
    """Numbers of a file of rows.

    Attributes:
        format: format of the file.
        values: numbers in the cells, NaN where a cell is empty or another string.
        texts: positions of the columns that have strings in more than 2 % of their cells.
    """

    format: TableFormat
    values: Float[np.ndarray, "row column"]
    texts: frozenset[int]


def format_of(path: Path, delimiter: str | None = None) -> TableFormat:
    """Return the format of a CSV or Parquet file.

    Args:
        path: the file.
        delimiter: character between cells; None if it is unknown.

    Raises:
        DataError: the file cannot be read, is empty, or is not a log with rows of numbers.
    """
    if path.suffix == ".parquet":
        header = tuple(parquet_names(path, bytes_of(path)))
        return TableFormat(path, "", 1, 0, 2, header, ("",) * len(header))
    lines = first_lines(path)
    delimiter = delimiter or _delimiter_of(lines)
    rows = [cells_of(line, delimiter) for line in lines[:_HEADER_LINES]]
    first = _first_numbers(rows)
    _refuse_commas(path, rows[first or 0 :], delimiter, first or 0)
    if first is None or len(rows) - first < min(_LEAST_ROWS, _HEADER_LINES - first):
        raise bad_data(path, "no rows of numbers", "a log: a row of numbers for every time")
    names_row, units_row = _header_rows(rows[:first], len(rows[first]))
    top = rows[names_row - 1] if names_row else []
    if not top and first:
        _refuse_short_names(path, rows[first - 1], len(rows[first]), first)
    if not top and any(number_in(c) is None and c.lower() not in MISSING for c in rows[first]):
        expected = "a log with a row of column names, or with numbers only"
        raise bad_data(path, "text among the numbers, and no names", expected, row=first + 1)
    width = len(top) or len(rows[first])
    names = [*top, *[""] * width][:width]
    if names_row and width > 1 and not names[-1]:
        width -= 1  # no last column: every line ends with a delimiter
    units = rows[units_row - 1] if units_row else []
    units = [*units, *[""] * width][:width]
    where = (names_row, units_row, first + 1)
    return TableFormat(path, delimiter, *where, tuple(names[:width]), tuple(units))


def numbers_of(format: TableFormat) -> TableNumbers:
    """Return the numbers in the first `ROWS` rows of a file."""
    if not format.delimiter:
        numbers, texts = parquet_numbers(format.path, bytes_of(format.path), format.names)
        return TableNumbers(format, numbers[:ROWS], texts)
    lines = lines_of(format.path)
    body = [line for line in lines[format.first_data_row - 1 :][:ROWS] if line.strip()]
    values, wrong = cell_numbers(body, format.delimiter, range(len(format.names)))
    texts = frozenset(np.flatnonzero(wrong.sum(axis=0) > 0.02 * len(body)).tolist())
    return TableNumbers(format, values, texts)


def first_lines(path: Path) -> list[str]:
    """Return the complete lines in the first bytes of a text file."""
    return lines_of(path, _SAMPLE_BYTES)


def lines_of(path: Path, limit: int = -1) -> list[str]:
    """Return the lines of a text file, or the complete lines in its first `limit` bytes."""
    raw = bytes_of(path, limit)
    if len(raw) == limit and b"\n" in raw:
        raw = raw[: raw.rindex(b"\n")]
    return text_lines(path, raw)


def _delimiter_of(lines: list[str]) -> str:
    """Return the delimiter: the character whose count is the same in most lines.

    Of several such characters the most frequent one is returned.
    """

    def score(delimiter: str) -> tuple[float, int]:
        counts = Counter(line.count(delimiter) for line in lines[:_HEADER_LINES] if line.strip())
        count, times = counts.most_common(1)[0]
        return (times / sum(counts.values()) if count else 0.0, count)

    best = max(_DELIMITERS[:-1], key=score)
    if score(best)[1]:
        return best
    return " " if score(" ")[1] and score(" ")[0] > 0.5 else ","


def _first_numbers(rows: list[list[str]]) -> int | None:
    """Return the index of the first row with numbers, or None if there is none.

    Most of its cells are numbers, or those that are numbers in most rows: other columns may have
    text.
    """
    usual = Counter(len(row) for row in rows).most_common(1)[0][0]
    are = [tuple(number_in(cell) is not None for cell in row) for row in rows]
    often, times = Counter(are).most_common(1)[0]
    columns = [at for at, number in enumerate(often) if number and times > 0.5 * len(rows)]
    for k, (row, numbers) in enumerate(zip(rows, are, strict=True)):
        filled = sum(cell.lower() not in MISSING for cell in row)
        known = len(columns) > 1 and len(row) == len(often) and all(numbers[at] for at in columns)
        if len(row) >= usual - 1 and (sum(numbers) > 0.5 * filled or known):
            return k
    return None


def _header_rows(rows: list[list[str]], width: int) -> tuple[int, int]:
    """Return the row of names and the row of units, counted from 1; 0 if there is none.

    Args:
        rows: cells of the rows above the numbers.
        width: number of cells in the first row of numbers.
    """
    names = units = 0
    for k, row in enumerate(rows, start=1):
        filled = [cell for cell in row if cell]
        if len(row) < width - 1 or len(filled) < len(row) - 2:
            continue
        # Single letters are units if they are below the names; otherwise they may be names.
        counted = sum(map(bool, map(unit_in, filled))) if names else sum(map(is_unit, filled))
        if counted > 0.5 * len(filled) and (names or any(len(c) > 1 for c in filled)):
            units = k
        elif sum(number_in(cell) is None for cell in filled) > 0.5 * len(filled):
            names = k
    if names or not units:
        return names, units
    # If there are no names, units that are written out and occur only once serve as column names.
    cells = [cell for cell in rows[units - 1] if cell]
    words = any(len(cell) > 4 and cell.isalpha() for cell in cells)
    return (units, 0) if words and len(set(cells)) == len(cells) else (0, 0)


def _refuse_short_names(path: Path, above: list[str], width: int, row: int) -> None:
    """Raise `DataError` if rows have more cells than names, but at most two for each name.

    Args:
        path: the file.
        above: cells of the line above the rows of numbers.
        width: number of cells in a row of numbers.
        row: number of that line, counted from 1.
    """
    texts = [cell for cell in above if cell and number_in(cell) is None]
    if len(texts) == len(above) > 1 and len(above) < width <= 2 * len(above):
        found = f"{len(above)} names, but {width} cells in the rows below"
        expected = "as many (decimal commas, with a comma between cells as well?)"
        raise bad_data(path, found, expected, row=row)


def _refuse_commas(path: Path, body: list[list[str]], delimiter: str, first: int) -> None:
    """Raise `DataError` if numbers have decimal commas, since no layout can read them.

    Args:
        path: the file.
        body: cells of the rows of numbers.
        delimiter: character between cells.
        first: index of the first of these rows in the file.
    """
    if delimiter == ",":
        return
    for k, cells in enumerate(body[:_HEADER_LINES]):
        for cell in cells:
            whole, comma, part = cell.lstrip("+-").partition(",")
            if comma and whole.isdecimal() and part.isdecimal():
                raise bad_data(path, f"'{cell}'", "decimal points, not commas", row=first + 1 + k)
