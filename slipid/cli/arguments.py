"""Checks of the words of a command line before they are converted: empty, unprintable and NaN."""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

from slipid.support.errors import DataError, shown

EXPECTED = {"DIR": "a folder", "FILE": "a file", "NAME": "a name"}
"""Words of messages for the metavars of values."""


def refuse_odd(
    command: Callable[..., object], params: Sequence[Any], given: Mapping[str, object]
) -> None:
    """Raise `DataError` for a value that is empty, has control characters, or is no number.

    Converted values no longer show it: an empty path is that of the working folder, and Typer calls
    NaN too large. A single control character is accepted, as a tab separates cells; paths are
    checked where they are used.

    Args:
        command: function of the command.
        params: options and arguments of the command, as Typer declares them.
        given: words for each of them, keyed by the name of the function's parameter.
    """
    for param in params:
        named = param.param_type_name == "option"
        metavar = str(param.metavar or "a value")
        expected = EXPECTED.get(metavar, metavar if named else "a value")
        name = param.opts[0] if named else metavar
        for text in _texts(given.get(param.name)):
            if not text.strip(" "):
                raise DataError(f"{name} is empty; expected {expected}")
            odd = len(text) > 1 and any(ord(c) < 32 or 127 <= ord(c) < 160 for c in text)
            if odd and not _has_kind(command, param.name, Path):
                raise DataError(f"{name} {shown(text)}; expected printable characters")
            if text.lower().lstrip("+-") == "nan" and _has_kind(command, param.name, float, int):
                raise DataError(f"{name}: nan; expected a number")


def _texts(given: object) -> Iterator[str]:
    """Return the words that were given for one option, which may be repeated, or argument."""
    if isinstance(given, str):
        yield given
    elif isinstance(given, list | tuple):
        for one in given:
            yield from _texts(one)


def _has_kind(command: Callable[..., object], name: str, *kinds: type) -> bool:
    """Return True if a parameter of a command's function is, if given, of one of these types."""
    hint = get_type_hints(inspect.unwrap(command)).get(name)
    return not {*kinds}.isdisjoint({hint, *get_args(hint)})
