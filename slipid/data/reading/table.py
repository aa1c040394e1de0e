"""Reading of the numbers of a CSV or Parquet file; an error names the wrong cell."""

import csv
import hashlib
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from slipid.data.reading.containers import refuse_other
from slipid.data.reading.layout import Channel, Layout
from slipid.data.reading.units import same_unit
from slipid.support.errors import bad_data, first_names, refused_as
from slipid.support.extras import missing
from slipid.support.files import PIPE, read_bytes

if TYPE_CHECKING:
    from pyarrow import Table as ParquetTable
    from pyarrow.parquet import ParquetFile

_DATE = re.compile(r"\d{4}[-/]\d{2}[-/]\d{2}[T ]\d{2}:")
MISSING = {"", "nan", "na", "n/a", "null", "none"}
"""Contents of cells, in lower case, that mean a missing number."""
MOST_CELLS = 2**26
"""Largest number of cells to read of a Parquet file, which may be compressed a million times."""
_PARQUET = "a complete Parquet file"


@dataclass(frozen=True, eq=False)
class Table:
    """Numbers of one file, unchanged, without conversion of units.

    Attributes:
        path: path of the file.
        sha256: SHA-256 hash of the file's bytes.
        names: names of the columns that were read, or their positions as strings if they have no
            names.
        values: numbers in the cells, NaN where a cell is empty.
        lines: line number in the file of each row of `values` (record number for Parquet), from 1.
        tests: name of the test in which each row was logged; None if the rows have no such names.
    """

    path: Path
    sha256: str
    names: tuple[str, ...]
    values: Float[np.ndarray, "row column"]
    lines: Int[np.ndarray, " row"]
    tests: Shaped[np.ndarray, " row"] | None = None

    def __getitem__(self, name: str) -> Float[np.ndarray, " row"]:
        return self.values[:, self.names.index(name)]

    def stacked(self, channel: Channel) -> Float[np.ndarray, "row column"]:
        """Return the cells of a channel's columns, side by side."""
        return self.values[:, [self.names.index(str(c)) for c in channel.columns]]

    def rows(self, which: slice | np.ndarray) -> "Table":
        """Return the table with the selected rows."""
        tests = None if self.tests is None else self.tests[which]
        return replace(self, values=self.values[which], lines=self.lines[which], tests=tests)


def read_table(path: Path, layout: Layout, *, all_columns: bool = False) -> Table:
    """Return the numbers of a CSV or Parquet file, each cell checked.

    Args:
        path: the file.
        layout: layout with the lines of names and numbers, and with the columns to read.
        all_columns: True to read all columns of the file, not only those that the layout uses.

    Raises:
        DataError: the file does not match the layout; the message names the file, the row or
            column, what is there and what was expected.
    """
    raw = bytes_of(path)
    sha256 = hashlib.sha256(raw).hexdigest()
    if path.suffix == ".parquet":
        names = wanted_names(path, parquet_names(path, raw), layout, all_columns)
        values, texts = parquet_numbers(path, raw, names)
        for at in sorted(texts):
            raise bad_data(path, "values of another type", "numbers", column=names[at])
        return Table(path, sha256, names, values, 1 + np.arange(len(values)))
    text = text_lines(path, raw)
    header = header_cells(path, text, layout)
    names = wanted_names(path, header, layout, all_columns)
    body = text[layout.first_data_row - 1 :]
    if not body:
        raise bad_data(path, "no row of numbers after the header", "data", row=len(text))
    check_fields(path, body, header, layout)
    if layout.units_row:
        check_units(path, text[layout.units_row - 1], header, layout)
    check_dates(path, body[0], header, layout)
    where = [header.index(name) for name in names]
    values, wrong = cell_numbers(body, layout.delimiter, where)
    for i, j in np.argwhere(wrong)[:1].tolist():
        cell = cells_of(body[i], layout.delimiter)[where[j]]
        comma = re.fullmatch(r"[+-]?\d+,\d+([eE][+-]?\d+)?", cell)
        expected = "a number" + " with a decimal point, not a decimal comma" * bool(comma)
        row = layout.first_data_row + i
        raise bad_data(path, f"'{cell[:40]}'", expected, row=row, column=names[j])
    return Table(path, sha256, names, values, layout.first_data_row + np.arange(len(values)))


def bytes_of(path: Path, limit: int = -1) -> bytes:
    """Return the bytes of a file, or the first `limit` of them.

    Raises:
        DataError: the file cannot be read, is empty, or is of a kind that is not read.
    """
    if not path.is_dir():
        refuse_other(path)
    return raw_bytes(path, limit)


def raw_bytes(path: Path, limit: int = -1) -> bytes:
    """Return the bytes of a file of any kind, or the first `limit` of them.

    Raises:
        DataError: the file cannot be read, or is empty.
    """
    if path.exists() and not path.is_file():
        found = "a folder" if path.is_dir() else PIPE
        raise bad_data(path, found, "a CSV or Parquet file")
    try:
        with path.open("rb") as file:
            raw = file.read(limit)
    except OSError as error:
        expected = "a CSV or Parquet file that can be opened; check its permissions"
        raise bad_data(path, f"cannot be read ({error.strerror})", expected) from error
    if not raw.strip():
        raise bad_data(path, "the file is empty", "a header and rows of numbers")
    return raw


def _parquet_file(path: Path, raw: bytes) -> "ParquetFile":
    """Return an opened Parquet file; raise `DataError` if it is damaged or pyarrow is missing."""
    try:
        import pyarrow
        import pyarrow.parquet as parquet
    except ImportError as error:
        raise missing("parquet", f"{path}: a Parquet file", error) from error
    with refused_as(path, _PARQUET):
        return parquet.ParquetFile(pyarrow.BufferReader(raw))


def parquet_names(path: Path, raw: bytes) -> list[str]:
    """Return the names of the columns of a Parquet file, without decoding their cells.

    Raises:
        DataError: the bytes are not a Parquet file, it has no rows, or pyarrow is missing.
    """
    file = _parquet_file(path, raw)
    if not file.metadata.num_rows:
        raise bad_data(path, "no rows", "rows of numbers")
    with refused_as(path, "names of columns in UTF-8"):
        return list(file.schema_arrow.names)


def parquet_of(path: Path, raw: bytes, names: Sequence[str]) -> "ParquetTable":
    """Return the named columns in the bytes of a Parquet file; each name occurs once in the file.

    Raises:
        DataError: the bytes are not a Parquet file, the columns have more than `MOST_CELLS` cells,
            or pyarrow is missing.
    """
    file = _parquet_file(path, raw)
    with refused_as(path, _PARQUET):
        # a column of structures is stored as several columns, whose paths begin with its name
        stored = [file.schema.column(k).path for k in range(file.metadata.num_columns)]
        count = sum(p.startswith(f"{name}.") or p == name for p in stored for name in names)
        cells = file.metadata.num_rows * count
        if not 0 <= cells <= MOST_CELLS:
            found = f"{cells} cells in the {len(names)} columns to read"
            raise bad_data(path, found, f"at most {MOST_CELLS}; split the file")
        table = file.read(columns=list(names)).select(list(names))
        table.validate(full=True)
    return table


def parquet_numbers(
    path: Path, raw: bytes, names: Sequence[str]
) -> tuple[Float[np.ndarray, "row column"], frozenset[int]]:
    """Return the numbers in columns of a Parquet file, and the positions of those of other types.

    Dates and durations become seconds, dates since 1970 in UTC. A column of another type, such as
    strings, has NaN for its numbers.
    """
    import pyarrow

    table = parquet_of(path, raw, names)
    values, texts = np.full((table.num_rows, table.num_columns), np.nan), set()
    for k, column in enumerate(table.columns):
        try:
            if pyarrow.types.is_timestamp(column.type) or pyarrow.types.is_duration(column.type):
                per_second = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[column.type.unit]
                whole, part = np.divmod(column.cast(pyarrow.int64()).to_numpy(), per_second)
                values[:, k] = whole + part / per_second
                continue
            values[:, k] = column.cast(pyarrow.float64()).to_numpy()
        except pyarrow.ArrowException:
            texts.add(k)
    return values, frozenset(texts)


def text_lines(path: Path, raw: bytes) -> list[str]:
    """Return the lines of a text file from its bytes; raise `DataError` unless they are UTF-8.

    A byte order mark is removed; any kind of line end is accepted.
    """
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise bad_data(path, "text in UTF-16", "UTF-8", row=1)
    if b"\0" in raw:
        row = raw.count(b"\n", 0, raw.index(b"\0")) + 1
        raise bad_data(
            path, "a binary file (zero bytes in it)", "text with one row per line", row=row
        )
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = raw.count(b"\n", 0, error.start) + 1
        found = f"byte 0x{raw[error.start]:02x}, which is not UTF-8"
        raise bad_data(
            path, found, "UTF-8 text (is the file binary or Latin-1?)", row=row
        ) from error
    return text.replace("\r\n", "\n").replace("\r", "\n").rstrip().split("\n")


def named_rows(path: Path, expected: str) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """Return the names of the columns of a CSV table, and the line number and cells of each row.

    Cells are keyed by the names. Cells that a row lacks are absent.

    Raises:
        DataError: the file cannot be read, is not CSV text in UTF-8, or a row has too many cells.
    """
    lines = text_lines(path, read_bytes(path, expected))
    with refused_as(path, expected):
        rows = csv.DictReader(lines, skipinitialspace=True)
        names = [name.strip() for name in rows.fieldnames or ()]
        rows.fieldnames = names
        found = [(rows.line_num, cells) for cells in rows]
    for line, cells in found:
        if None in cells:
            raise bad_data(path, "too many cells", f"{len(names)}", row=line)
    return names, [(n, {k: v for k, v in row.items() if v is not None}) for n, row in found]


def cells_of(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line, without blanks and quotes around them."""
    return [cell.strip().strip("\"'").strip() for cell in line.split(delimiter)]


def number_in(cell: str) -> float | None:
    """Return the number in a cell, or None if the cell is not a number.

    A date with a time of day (ISO 8601, also as pandas writes it) is the number of seconds since
    1970, in UTC if it names no zone.
    """
    try:
        # Python would accept 1_000 as a number, which is surely a damaged cell.
        return float(cell) if "_" not in cell else None
    except ValueError:
        return _seconds_since_1970(cell)


def _seconds_since_1970(cell: str) -> float | None:
    """Return the seconds since 1970 of a date with a time of day, or None for other text."""
    if not _DATE.match(cell):
        return None
    try:
        date = datetime.fromisoformat(cell.replace("/", "-"))
    except ValueError:
        return None
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def _number(cell: str) -> float:
    """Return the number in a cell with a date, for `numpy.loadtxt`; raise `ValueError` if none."""
    number = number_in(cell.strip().strip("\"'"))
    if number is None:
        raise ValueError(cell)
    return number


def header_cells(path: Path, lines: list[str], layout: Layout) -> list[str]:
    """Return the name of every column, empty if it has none; positions if the file has no names.

    Raises:
        DataError: the file ends before the row of names, another delimiter is used, or the names
            are numbers.
    """
    row = layout.names_row or layout.first_data_row
    if len(lines) < row:
        expected = f"column names in row {row}" if layout.names_row else f"numbers from row {row}"
        raise bad_data(path, f"the file ends after row {len(lines)}", expected, row=len(lines))
    line = lines[row - 1]
    cells = cells_of(line, layout.delimiter)
    others = {line.count(d): d for d in (";", ",", "\t", "|") if d != layout.delimiter}
    if len(cells) == 1 and max(others):
        other = others[max(others)]
        found = f"no delimiter {layout.delimiter!r}, but {max(others)} of {other!r}"
        expected = (
            f"cells separated by {layout.delimiter!r}, or delimiter = {other!r} in the layout"
        )
        raise bad_data(path, found, f"{expected}, and decimal points", row=row)
    if not layout.names_row:
        return [str(position) for position in range(len(cells))]
    if all(number_in(cell) is not None for cell in cells if cell):
        expected = f"the column names ({first_names(map(str, layout.columns))})"
        raise bad_data(path, "numbers instead of column names", expected, row=row)
    return cells


def wanted_names(
    path: Path, header: list[str], layout: Layout, all_columns: bool
) -> tuple[str, ...]:
    """Return the names of the columns to read, or their positions as strings.

    Raises:
        DataError: a column of the layout is missing, or a name occurs more than once.
    """
    used = tuple(map(str, layout.columns))
    row, count = layout.names_row or layout.first_data_row, Counter(header)
    for name in used:
        if name not in header:
            near = get_close_matches(name, [other for other in header if other not in used], n=2)
            hint = f"did you mean {' or '.join(near)}? The file has" if near else "the file has"
            expected = f"it among the column names; {hint} {', '.join(filter(None, header))}"
            raise bad_data(path, "no such column", expected, row=row, column=name)
    names = tuple(filter(None, header)) if all_columns else used
    for name in names:
        if count[name] > 1:
            found = f"{count[name]} columns of this name"
            raise bad_data(path, found, "one", row=row, column=name)
    return names


def check_fields(path: Path, body: list[str], header: list[str], layout: Layout) -> None:
    """Raise `DataError` if a row has a wrong number of cells; a trailing delimiter is allowed."""
    counts = np.array([line.count(layout.delimiter) for line in body]) + 1
    expected = len(header)
    if (counts == expected).all():
        return
    if (counts == expected + 1).all() and all(line.endswith(layout.delimiter) for line in body):
        return
    if (counts == expected - 1).all() and header[-1] == "":
        return
    usual = int(np.bincount(counts).argmax())
    if usual == expected or not layout.names_row:
        expected = usual
    bad = int(np.flatnonzero(counts != expected)[0])
    row, line = layout.first_data_row + bad, body[bad]
    wanted = f"{expected} cells, as in {'the row of names' if layout.names_row else 'other rows'}"
    if not line.strip():
        raise bad_data(path, "an empty line", wanted, row=row)
    found = f"{counts[bad]} cells"
    if bad == len(body) - 1 and counts[bad] < expected:
        found += " in the last line, as if the log was cut off while it was written"
    elif layout.delimiter == "," and counts[bad] > expected and re.search(r"\d,\d", line):
        found += " (decimal commas, with a comma between cells as well?)"
    raise bad_data(path, found, wanted, row=row)


def check_units(path: Path, line: str, header: list[str], layout: Layout) -> None:
    """Raise `DataError` if the row of units has another unit than the layout declares."""
    units = cells_of(line, layout.delimiter)
    for channel in layout.channels.values():
        for column in channel.columns:
            at = header.index(str(column))
            written = units[at] if at < len(units) else ""
            if not same_unit(written, channel.unit):
                found = f"the unit in the file is '{written}'"
                expected = f"'{channel.unit}' as declared in the layout"
                row = layout.units_row
                raise bad_data(path, found, expected, row=row, column=str(column))


def check_dates(path: Path, line: str, header: list[str], layout: Layout) -> None:
    """Raise `DataError` if a time in the first row is a date, and its declared unit is not s."""
    cells, time = cells_of(line, layout.delimiter), layout.channels.get("time")
    if time is None or same_unit(time.unit, "s"):
        return
    for column in time.columns:
        at = header.index(str(column))
        if at < len(cells) and _seconds_since_1970(cells[at]) is not None:
            found = f"the date '{cells[at]}' in a column with the unit '{time.unit}'"
            expected = "unit = 's' for the channel time: dates become seconds since 1970"
            raise bad_data(path, found, expected, row=layout.first_data_row, column=str(column))


def cell_numbers(
    body: Sequence[str], delimiter: str, where: Sequence[int]
) -> tuple[Float[np.ndarray, "row column"], Bool[np.ndarray, "row column"]]:
    """Return the numbers in some columns of lines, and whether each cell is another string.

    Numbers are NaN where a cell is empty or another string.

    Args:
        body: lines of the file.
        delimiter: character between cells.
        where: positions of the columns.
    """
    wrong = np.zeros((len(body), len(where)), dtype=bool)
    first = enumerate(cells_of(body[0], delimiter)) if body else ()
    dates = [at for at, cell in first if at in where and _DATE.match(cell)]
    try:
        values = np.loadtxt(
            body,
            delimiter=delimiter,
            usecols=where,
            ndmin=2,
            comments=None,
            converters=dict.fromkeys(dates, _number),
        )
        return values, wrong[: len(values)]
    except ValueError:
        values = np.full(wrong.shape, np.nan)
    for i, line in enumerate(body):
        cells = cells_of(line, delimiter)
        for j, at in enumerate(where):
            cell = cells[at] if at < len(cells) else ""
            number = number_in(cell)
            values[i, j] = np.nan if number is None else number
            wrong[i, j] = number is None and cell.lower() not in MISSING
    return values, wrong
