"""The error for bad input, and the common form of its messages."""

from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path


class DataError(ValueError):
    """Error about unreadable user data; the message names file, row or column, and the remedy."""


def bad_data(
    path: Path | str,
    found: str,
    expected: str,
    *,
    row: int | tuple[int, int] | None = None,
    column: str | None = None,
) -> DataError:
    """Return a `DataError` in the common form `file row 12, column 'x': found; expected ...`.

    Args:
        row: line number in the file, counted from 1 (in Parquet the record), or first and last.
        column: name of the column, as the file has it.
    """
    where = str(path)
    if isinstance(row, tuple):
        where += f" rows {row[0]}-{row[1]}" if row[0] != row[1] else f" row {row[0]}"
    elif row is not None:
        where += f" row {row}"
    if column is not None:
        where += f", column '{column}'"
    return DataError(f"{where}: {found}; expected {expected}")


def did_you_mean(name: object, choices: Iterable[str]) -> str:
    """Return `, did you mean this or that?` where choices are spelled alike, else an empty text."""
    found = get_close_matches(str(name), list(choices), n=2)
    return f", did you mean {' or '.join(found)}?" if found else ""


def first_names(names: Iterable[str], none: str = "none") -> str:
    """Return the first dozen names for a message, or `none` where there are none."""
    every = list(names)
    return ", ".join(every[:12] + ["..."] * (len(every) > 12)) or none
