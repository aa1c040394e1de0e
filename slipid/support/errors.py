"""The error for bad input of a user, and functions for the common form of its messages."""

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path

LONGEST = 500
"""Largest number of characters of a message about one mistake."""
MOST_MISTAKES = 20
"""Largest number of mistakes that a `DataError` names."""
_SHOWN = 60
"""Number of characters of the start, and of the end, of a long value in a message."""
_LONG_WORD = re.compile(r"\S{81,}")
_QUOTED = re.compile(r"(?<!\w)'[^'\n]*'")


class DataError(ValueError):
    """Error about wrong input of a user: files, options or configs.

    The message names the file, the row or column, and the remedy. It has at most `LONGEST`
    characters, whatever values of a file it shows. An error about several mistakes has a message
    for each.
    """

    def __init__(self, *messages: object) -> None:
        super().__init__(*(_bounded(str(message)) for message in messages))

    def __str__(self) -> str:
        more = len(self.args) - MOST_MISTAKES
        return "\n".join([*self.args[:MOST_MISTAKES], *[f"... ({more} more)"] * (more > 0)])


def _bounded(message: str) -> str:
    """Return a printable message of at most `LONGEST` characters.

    A longer one loses the middles of its long words and quoted values, then its last lines, then
    its end.
    """
    message = "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in message)
    if len(message) <= LONGEST:
        return message
    message = with_short_words(_QUOTED.sub(_shortened, message))
    lines = message.split("\n")
    for count in range(len(lines), 0, -1):
        more = f"\n... ({len(lines) - count} more)" if count < len(lines) else ""
        kept = "\n".join(lines[:count]) + more
        if len(kept) <= LONGEST:
            return kept
    return f"{message[: LONGEST - 3]}..."


def with_short_words(message: str) -> str:
    """Return a message without the middles of its words of over 80 characters."""
    return _LONG_WORD.sub(_shortened, message)


def _shortened(found: re.Match[str]) -> str:
    """Return a match without its middle if it is long."""
    return found[0] if len(found[0]) <= 80 else f"{found[0][:40]}...{found[0][-37:]}"


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
        path: the file.
        found: what is wrong.
        expected: what was expected instead.
        row: line number in the file (record number in Parquet), counted from 1, or the first and
            last line.
        column: name of the column, as in the file.
    """
    where = str(path)
    if isinstance(row, tuple):
        where += f" rows {row[0]}-{row[1]}" if row[0] != row[1] else f" row {row[0]}"
    elif row is not None:
        where += f" row {row}"
    if column is not None:
        where += f", column '{column}'"
    return DataError(f"{where}: {found}; expected {expected}")


@contextmanager
def refused_as(path: Path | str, expected: str) -> Iterator[None]:
    """Return a context manager in which every error of a library becomes a `DataError`.

    It is for nothing but calls of libraries that read a file from outside: an error of slipid
    itself inside it would pass for a damaged file.

    Args:
        path: the file, for the message.
        expected: expected kind of file.
    """
    try:
        yield
    except DataError:
        raise
    except Exception as error:  # libraries raise errors of dozens of types for damaged bytes
        text = " ".join(str(error).split())[:200] or type(error).__name__
        raise bad_data(path, f"cannot be read ({text})", expected) from error


def shown(value: object) -> str:
    """Return a value as messages show it, without its middle if it is long.

    Python itself writes no integers of over 4300 digits.
    """
    if isinstance(value, int) and value.bit_length() > 64:
        return f"a whole number of {value.bit_length()} bits"
    try:
        text = repr(value)
    except ValueError:
        return "a value with an integer of thousands of digits"
    return text if len(text) <= 2 * _SHOWN else f"{text[:_SHOWN]} ... {text[-_SHOWN:]}"


def did_you_mean(name: object, choices: Iterable[str]) -> str:
    """Return `, did you mean this or that?` with the choices most similar to a name.

    The string is empty if no choice is similar.
    """
    found = get_close_matches(str(name), list(choices), n=2)
    return f", did you mean {' or '.join(found)}?" if found else ""


def first_names(names: Iterable[str], none: str = "none") -> str:
    """Return the first twelve names as a string for a message, or `none` if there are no names."""
    every = list(names)
    return ", ".join(every[:12] + ["..."] * (len(every) > 12)) or none
