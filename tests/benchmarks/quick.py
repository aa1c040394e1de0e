"""The quick form of every benchmark, in which all of its code runs and nothing is judged.

SLIPID_BENCH_QUICK=1 asks for it: few runs, seeds and steps, a thinned copy of the real logs, and a
made fit where SLIPID_FIT names none. `assert QUICK or ...` is for what only the full form can tell.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

QUICK = os.environ.get("SLIPID_BENCH_QUICK", "") not in ("", "0")
"""Whether this is the quick form."""
MANY, KEPT = 20, 7
"""A folder with more than `MANY` logs keeps one of `KEPT` in the quick form."""


def quick(full: T, small: T) -> T:
    """Return the second of two values in the quick form, the first one otherwise."""
    return small if QUICK else full


def thinned(data: Path, into: Path) -> Path:
    """Return a folder with links to all files of another one, but to few of many 2022 logs."""
    for path in sorted(data.iterdir()):
        if path.name == "robotino2022":
            _thinned(path, into / path.name)
        else:
            (into / path.name).symlink_to(path.resolve())
    return into


def _thinned(folder: Path, into: Path) -> None:
    into.mkdir()
    paths = sorted(folder.iterdir())
    files = [path for path in paths if path.is_file()]
    for path in files[:: KEPT if len(files) > MANY else 1]:
        (into / path.name).symlink_to(path.resolve())
    for path in paths:
        if path.is_dir():
            _thinned(path, into / path.name)
