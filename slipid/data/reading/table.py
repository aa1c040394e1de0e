"""From the bytes of a CSV or Parquet file to columns of numbers, or to the cell that is wrong."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from slipid.data.reading import csv_text
from slipid.data.reading.layout import Channel, Layout
from slipid.support.errors import bad_data


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of one file as they are in it: no unit converted, nothing repaired.

    Attributes:
        path: the file.
        sha256: hash of its bytes.
        names: names of the columns read, or their positions.
        values: the cells, NaN where a cell is empty.
        lines: line number in the file of each row of `values` (record number for Parquet), from 1.
    """

    path: Path
    sha256: str
    names: tuple[str | int, ...]
    values: Float[np.ndarray, "row column"]
    lines: Int[np.ndarray, " row"]

    def __getitem__(self, name: str | int) -> Float[np.ndarray, " row"]:
        return self.values[:, self.names.index(name)]

    def stacked(self, channel: Channel) -> Float[np.ndarray, "row column"]:
        """Cells of a channel's columns, side by side."""
        return self.values[:, [self.names.index(c) for c in channel.columns]]

    def rows(self, which: slice | np.ndarray) -> "Table":
        """The table with some of its rows."""
        return replace(self, values=self.values[which], lines=self.lines[which])


def read_table(path: Path, layout: Layout, *, all_columns: bool = False) -> Table:
    """Numbers of a CSV or Parquet file, each cell checked.

    Args:
        layout: where names and numbers are, and which columns are wanted.
        all_columns: read every column of the file and not only those the layout uses.

    Raises:
        DataError: names the file, the row or column, what is there and what was expected.
    """
    raw = _bytes(path)
    sha256 = hashlib.sha256(raw).hexdigest()
    if path.suffix == ".parquet":
        names, values = _parquet(path, raw, layout, all_columns)
        return Table(path, sha256, names, values, 1 + np.arange(len(values)))
    text = csv_text.text_lines(path, raw)
    header = csv_text.header_cells(path, text, layout)
    names = csv_text.wanted_names(path, header, layout, all_columns)
    body = text[layout.first_data_row - 1 :]
    if not body:
        raise bad_data(path, "no row of numbers after the header", "data", row=len(text))
    csv_text.check_fields(path, body, header, layout)
    if layout.units_row:
        csv_text.check_units(path, text[layout.units_row - 1], header, layout)
    where = [header.index(str(name)) if layout.names_row else int(name) for name in names]
    try:
        values = np.loadtxt(body, delimiter=layout.delimiter, usecols=where, ndmin=2, comments=None)
    except ValueError:
        values = csv_text.cell_by_cell(path, body, names, where, layout)
    lines_read = layout.first_data_row + np.arange(len(values))
    return Table(path, sha256, names, values, lines_read)


def _bytes(path: Path) -> bytes:
    if path.is_dir():
        raise bad_data(path, "a folder", "a CSV or Parquet file")
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise bad_data(path, f"cannot be read ({error.strerror})", "a readable file") from error
    if not raw.strip():
        raise bad_data(path, "the file is empty", "a header and rows of numbers")
    return raw


def _parquet(
    path: Path, raw: bytes, layout: Layout, all_columns: bool
) -> tuple[tuple[str | int, ...], Float[np.ndarray, "row column"]]:
    try:
        import pyarrow
        import pyarrow.parquet as parquet
    except ImportError as error:
        expected = "pyarrow to read it with: pip install 'slipid[parquet]'"
        raise bad_data(path, "a Parquet file", expected) from error
    try:
        table = parquet.read_table(pyarrow.BufferReader(raw))
    except pyarrow.ArrowException as error:
        raise bad_data(path, f"no Parquet ({error})", "a whole Parquet file") from error
    header = list(table.column_names)
    layout = replace(layout, names_row=layout.names_row or 1)
    names = csv_text.wanted_names(path, header, layout, all_columns)
    if table.num_rows == 0:
        raise bad_data(path, "no rows", "rows of numbers")
    columns = []
    for name in names:
        column = table.column(name)
        try:
            columns.append(column.cast(pyarrow.float64()).to_numpy())
        except pyarrow.ArrowException as error:
            found = f"values of type {column.type}"
            raise bad_data(path, found, "numbers", column=str(name)) from error
    return names, np.column_stack(columns)
