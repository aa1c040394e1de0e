"""Text of a CSV file: lines, names, units and cells, each checked where it stands."""

import re
from collections import Counter
from difflib import get_close_matches
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.data.reading.layout import Layout
from slipid.data.reading.units import same_unit
from slipid.support.errors import bad_data

_MISSING = {"", "nan", "na", "n/a", "null", "none"}


def text_lines(path: Path, raw: bytes) -> list[str]:
    """Lines of a file in UTF-8, with or without a byte order mark, whatever ends its lines."""
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
        found = f"byte 0x{raw[error.start]:02x}, which is no UTF-8"
        raise bad_data(
            path, found, "UTF-8 text (is the file binary or Latin-1?)", row=row
        ) from error
    return text.replace("\r\n", "\n").replace("\r", "\n").rstrip().split("\n")


def _split(line: str, delimiter: str) -> list[str]:
    return [cell.strip().strip("\"'").strip() for cell in line.split(delimiter)]


def header_cells(path: Path, lines: list[str], layout: Layout) -> list[str]:
    """Names of the columns, empty ones included; without a names row as many empty ones."""
    row = layout.names_row or layout.first_data_row
    if len(lines) < row:
        expected = f"column names in row {row}" if layout.names_row else f"numbers from row {row}"
        raise bad_data(path, f"the file ends after row {len(lines)}", expected, row=len(lines))
    line = lines[row - 1]
    cells = _split(line, layout.delimiter)
    counts = {d: line.count(d) for d in (";", ",", "\t", "|") if d != layout.delimiter}
    likely = max(counts, key=lambda d: counts[d])
    if len(cells) < 2 <= counts[likely] + 1:
        found = f"no delimiter {layout.delimiter!r}, but {counts[likely]} of {likely!r}"
        raise bad_data(path, found, f"cells separated by {layout.delimiter!r}", row=row)
    if not layout.names_row:
        return [""] * len(cells)
    try:
        [float(cell) for cell in cells if cell]
    except ValueError:
        return cells
    names = ", ".join(map(str, layout.columns[:6])) + ", ..." * (len(layout.columns) > 6)
    raise bad_data(path, "numbers", f"the column names ({names})", row=row)


def wanted_names(
    path: Path, header: list[str], layout: Layout, all_columns: bool
) -> tuple[str | int, ...]:
    """Names or positions of the columns to read, each of them there once."""
    if not layout.names_row:
        for position in layout.columns:
            if int(position) >= len(header):
                found = f"{len(header)} columns"
                expected = f"a column at position {position} (counted from 0)"
                raise bad_data(path, found, expected, row=layout.first_data_row)
        return tuple(range(len(header))) if all_columns else layout.columns
    for name in layout.columns:
        if name not in header:
            unused = [other for other in header if other not in layout.columns]
            near = get_close_matches(str(name), unused, n=2)
            hint = f"did you mean {' or '.join(near)}? It has" if near else "it has"
            expected = f"it among the names; {hint} {', '.join(filter(None, header))}"
            raise bad_data(path, "no such column", expected, row=layout.names_row, column=str(name))
    names = tuple(filter(None, header)) if all_columns else layout.columns
    for name, times in Counter(header).items():
        if times > 1 and name in names:
            found = f"{times} columns of this name"
            raise bad_data(path, found, "one", row=layout.names_row, column=name)
    return names


def check_fields(path: Path, body: list[str], header: list[str], layout: Layout) -> None:
    """Refuse rows with more or fewer cells than there are names; one trailing delimiter is fine."""
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
    wanted = f"{expected} as in the {'names' if layout.names_row else 'other rows'}"
    if not line.strip():
        raise bad_data(path, "an empty line", wanted + " cells", row=row)
    found = f"{counts[bad]} cells"
    if bad == len(body) - 1 and counts[bad] < expected:
        found += " in the last line, as if the log was cut off while it was written"
    elif layout.delimiter == "," and counts[bad] > expected and re.search(r"\d,\d", line):
        found += " (decimal commas, with a comma between cells as well?)"
    raise bad_data(path, found, wanted, row=row)


def check_units(path: Path, line: str, header: list[str], layout: Layout) -> None:
    """Refuse a units row that says another unit than the layout declares."""
    units = _split(line, layout.delimiter)
    for channel in layout.channels.values():
        for column in channel.columns:
            at = header.index(str(column))
            written = units[at] if at < len(units) else ""
            if not same_unit(written, channel.unit):
                found = f"the units row says '{written}'"
                expected = f"'{channel.unit}' as the layout {layout.name} declares"
                row = layout.units_row
                raise bad_data(path, found, expected, row=row, column=str(column))


def cell_by_cell(
    path: Path, body: list[str], names: tuple[str | int, ...], where: list[int], layout: Layout
) -> Float[np.ndarray, "row column"]:
    """The slow way, taken when the fast one fails: accepts empty cells, names the first bad one."""
    values = np.empty((len(body), len(where)))
    for i, line in enumerate(body):
        cells = _split(line, layout.delimiter)
        for j, at in enumerate(where):
            cell = cells[at]
            if cell.lower() in _MISSING:
                values[i, j] = np.nan
                continue
            try:
                # Python would read 1_000 as a thousand; no logger writes that on purpose.
                values[i, j] = float(cell.replace("_", "?"))
            except ValueError:
                comma = re.fullmatch(r"[+-]?\d+,\d+([eE][+-]?\d+)?", cell)
                more = " with a decimal point, not a decimal comma" if comma else ""
                row, column = layout.first_data_row + i, str(names[j])
                raise bad_data(
                    path, f"'{cell[:40]}'", f"a number{more}", row=row, column=column
                ) from None
    return values
