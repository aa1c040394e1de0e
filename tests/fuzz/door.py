"""A door: something that slipid reads, a good specimen of it, and how commands read it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slipid.data.log import Log

Files = dict[str, bytes]


class Silent(Exception):
    """The failure of a reader that accepts what it should refuse."""


@dataclass(frozen=True)
class Door:
    """A kind of input.

    Attributes:
        name: of the door.
        make: writes a good specimen, one or several files, to an empty folder.
        read: reads the specimen in the working folder as commands do; the argument is the path of
            the file that is damaged, relative to that folder. It returns what was read.
        targets: globs of the files that are damaged; empty for all.
        seal: mends the checksums of damaged files, so that what lies behind them is reached.
        weight: cases of this door per case of the others, less for slow ones.
        mentions: words by which a message may name the input, beside the names of its files.
    """

    name: str
    make: Callable[[Path], None]
    read: Callable[[Path], Any]
    targets: tuple[str, ...] = ()
    seal: Callable[[Files], Files] | None = None
    weight: float = 1.0
    mentions: tuple[str, ...] = ()


def wrong_number(value: Any) -> str | None:
    """Return the place of a number that is not finite in anything that was read, or None."""
    return next(_wrong(value, "", set()), None)


def _wrong(value: Any, where: str, known: set[int]) -> Iterator[str]:
    if isinstance(value, float) and not np.isfinite(value):
        yield f"{where or 'value'} is {value}"
    if value is None or isinstance(value, str | bytes | int | float | Path) or id(value) in known:
        return
    known.add(id(value))
    if isinstance(value, Log):
        yield from _wrong_log(value, where)
    elif hasattr(value, "dtype") and hasattr(value, "shape"):
        array = np.asarray(value)
        if array.dtype.kind in "fc" and not np.isfinite(array).all():
            yield f"{where or 'array'} is not finite"
    elif isinstance(value, Mapping):
        for key, one in value.items():
            yield from _wrong(one, f"{where}.{key}", known)
    elif isinstance(value, list | tuple | set | frozenset):
        for k, one in enumerate(value):
            yield from _wrong(one, f"{where}[{k}]", known)
    elif is_dataclass(value):
        for field in fields(value):
            if hasattr(value, field.name):
                yield from _wrong(getattr(value, field.name), f"{where}.{field.name}", known)
    elif hasattr(value, "model_fields_set"):
        yield from _wrong(vars(value), where, known)


def _wrong_log(log: Log, where: str) -> Iterator[str]:
    """Yield what is wrong with a run: numbers, times, or arrays of different lengths."""
    if not np.all(np.diff(log.time) > 0):
        yield f"{where}.time does not increase"
    for field in fields(log):
        array = getattr(log, field.name)
        if not isinstance(array, np.ndarray):
            continue
        if len(array) != len(log.time):
            yield f"{where}.{field.name} has another length than the time"
        # coordinates of a pose that were not measured are nan
        unknown = np.isinf(array) if field.name == "pose" else ~np.isfinite(array)
        if unknown.any():
            yield f"{where}.{field.name} is not finite"
