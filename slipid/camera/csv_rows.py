"""Rows of CSV files that users write: measured points, and times of frames."""

from pathlib import Path

from slipid.data.reading.table import cells_of
from slipid.support.errors import DataError
from slipid.support.files import read_bytes


def csv_rows(path: Path, expected: str) -> list[tuple[int, list[str]]]:
    """Return each row of a CSV file as its line number and its cells; `#` lines are omitted.

    Cells are separated by commas, semicolons or tabs, whichever is most frequent in the first row.

    Args:
        path: the file.
        expected: description of the file's content, for messages.

    Raises:
        DataError: the file cannot be read, or is not text in UTF-8.
    """
    try:
        text = read_bytes(path, expected).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not CSV text in UTF-8; expected {expected}") from error
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if not line.startswith("#")]
    first = next((line for _, line in lines if line.strip()), "")
    delimiter = max(",;\t", key=first.count)
    return [(k, cells_of(line, delimiter)) for k, line in lines]
