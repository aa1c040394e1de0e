"""Doors that fail on purpose, each in one manner: what the verdicts are tested with."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from slipid.support.errors import DataError
from tests.fuzz.door import Door

GOOD = b"the good file\n"


def _specimen(folder: Path) -> None:
    (folder / "a.bin").write_bytes(GOOD)


def _busy(path: Path) -> None:
    begin = time.process_time()
    while time.process_time() < begin + 2.2:
        pass


def _endless(path: Path) -> None:
    time.sleep(60)


def _large(path: Path) -> Any:
    return np.ones(3 << 27)


def _outside(path: Path) -> None:
    (Path("..") / "outside.txt").write_text("x")


class _Long(DataError):
    def __str__(self) -> str:  # messages of a DataError are cut to what is allowed
        return "a.bin: " + "x" * 500


def _long(path: Path) -> None:
    raise _Long


def _nameless(path: Path) -> None:
    raise DataError("something is wrong")


def _clear(path: Path) -> None:
    raise DataError(f"{path}: damaged; expected a good file")


def _not_finite(path: Path) -> Any:
    return {"x": np.array([1.0, np.nan])}


_FAULTS: dict[str, Callable[[Path], Any]] = {
    "traceback": lambda path: {}["a key"],
    "silent": _not_finite,
    "long": _long,
    "nameless": _nameless,
    "outside": _outside,
    "memory": _large,
    "hang": _busy,
    "crash": lambda path: os.abort(),
    "refused": _clear,
}


def _trap(name: str, fault: Callable[[Path], Any]) -> Door:
    def read(path: Path) -> Any:
        return None if path.read_bytes() == GOOD else fault(path)

    return Door(name, _specimen, read)


ENDLESS = _trap("endless", _endless)
TRAPS = tuple(_trap(name, fault) for name, fault in _FAULTS.items())
