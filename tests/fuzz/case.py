"""One case: damage that follows from a seed, and the verdict on how a door takes it."""

from __future__ import annotations

import os
import re
import sys
import tempfile
import time
import traceback
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from slipid.support.errors import DataError
from tests.fuzz.damage import damaged
from tests.fuzz.door import Door, Files, Silent, wrong_number

LONGEST_MESSAGE = 500
"""Characters of a message about one mistake, which is a line."""
MOST_LINES = 21
"""Lines of an error: 20 mistakes, and how many more there are."""
MOST_SECONDS = 2.0
"""CPU time of a read."""
MOST_MB = 2048.0
"""Memory of a read beyond what the process had before."""
PACKAGE = Path(__file__).resolve().parents[2] / "slipid"
_OF_NAMED_FILES = ("No such file", "File name too long", "null byte")
"""Errors about files that the input names, which the messages then name in its place."""
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_CHANGES = (
    "os.mkdir",
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.symlink",
    "os.link",
    "os.truncate",
)


@dataclass(frozen=True)
class Verdict:
    """Result of a case.

    Attributes:
        verdict: `accepted`, `refused`, or a failure: `traceback`, `hang`, `memory`, `silent`,
            `outside`, `long`, `nameless` or `crash`.
        kind: type of the exception, or what is wrong with what was accepted.
        place: file and function of slipid where it happened.
        line: line in that file.
        message: begin of the message.
        seconds: CPU time of the read.
        megabytes: memory that the read took.
    """

    verdict: str
    kind: str = ""
    place: str = ""
    line: int = 0
    message: str = ""
    seconds: float = 0.0
    megabytes: float = 0.0

    @property
    def failed(self) -> bool:
        return self.verdict not in ("accepted", "refused")

    @property
    def signature(self) -> str:
        """Text that cases with the same cause have in common."""
        return f"{self.verdict} {self.kind} {self.place}"


def files_of_case(door: Door, specimen: Files, seed: int, k: int) -> tuple[str, bytes]:
    """Return the name and the content of the file that a case damages."""
    rng = np.random.default_rng([seed, zlib.crc32(door.name.encode()), k])
    names = targets_of(door, specimen)
    name = names[int(rng.integers(len(names)))]
    return name, damaged(name, specimen[name], rng)


def files_in(folder: Path) -> Files:
    """Return the content of all files below a folder, keyed by their paths in it."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def targets_of(door: Door, specimen: Files) -> list[str]:
    """Return the names of the files of a specimen that are damaged."""
    globs = door.targets or ("*",)
    return sorted(name for name in specimen if any(fnmatch(name, glob) for glob in globs))


class Watch:
    """An audit hook that notes what is written outside of the working folder while it is on."""

    def __init__(self) -> None:
        self.on = False
        self.found: list[str] = []
        compiled = os.environ.get("JAX_COMPILATION_CACHE_DIR", "/dev/null")
        self.allowed = (os.path.realpath(compiled), tempfile.gettempdir() + os.sep, "/dev/")
        sys.addaudithook(self._note)

    def _note(self, event: str, values: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event == "open":
            path, mode, flags = values
            if not (set(mode or "") & set("wax+") or (flags or 0) & _WRITING):
                return
        elif event in _CHANGES:
            path = values[1] if event in ("os.rename", "os.link") else values[0]
            if event == "os.mkdir" and os.path.isdir(path):
                return  # nothing is made
        else:
            return
        if isinstance(path, str | bytes):
            whole = os.path.realpath(os.fsdecode(path))
            if not whole.startswith((os.getcwd() + os.sep, *self.allowed)):
                self.found.append(f"{event} {whole}")

    @contextmanager
    def watching(self) -> Iterator[None]:
        self.found.clear()
        self.on = True
        try:
            yield
        finally:
            self.on = False


def read(door: Door, name: str, specimen: Files, watch: Watch) -> Verdict:
    """Return the verdict on a read in the working folder, whose file of this name is damaged."""
    before, began = resident_mb(forget_peak=True), time.process_time()
    try:
        with watch.watching():
            value = door.read(Path(name))
        found = _accepted(value)
    except DataError as error:
        found = _refused(door, error, specimen)
    except Silent as error:
        found = Verdict("silent", str(error)[:80])
    except MemoryError as error:
        found = Verdict("memory", "MemoryError", *place_of(error.__traceback__))
    except (Exception, SystemExit) as error:
        kind, place = type(error).__name__, place_of(error.__traceback__)
        found = Verdict("traceback", kind, *place, str(error)[:200])
    seconds, memory = time.process_time() - began, resident_mb(peak=True) - before
    if watch.found:
        event, path = watch.found[0].split(" ", 1)
        found = Verdict("outside", event, *_read_of(door), path)
    elif memory > MOST_MB:
        found = Verdict("memory", "resident", *_read_of(door))
    elif seconds > MOST_SECONDS and not found.failed:
        found = Verdict("hang", "slow", *_read_of(door), message=f"{seconds:.1f} s")
    return Verdict(**{**vars(found), "seconds": round(seconds, 4), "megabytes": round(memory, 1)})


def _accepted(value: Any) -> Verdict:
    wrong = wrong_number(value)
    if wrong is None:
        return Verdict("accepted")
    return Verdict("silent", re.sub(r"\d+", "0", wrong)[:80], message=wrong)


def too_long(message: str) -> bool:
    """Return True if a message has too many lines, or too long ones."""
    lines = message.split("\n")
    return len(lines) > MOST_LINES or max(map(len, lines)) > LONGEST_MESSAGE


def _refused(door: Door, error: DataError, specimen: Files) -> Verdict:
    message, place = str(error), place_of(error.__traceback__)
    if too_long(message):
        start = f"{len(message)} characters: {message[:200]}"
        return Verdict("long", "DataError", *place, start)
    known = {part for name in specimen for part in Path(name).parts}
    if not any(word in message for word in (*known, *door.mentions, *_OF_NAMED_FILES)):
        return Verdict("nameless", "DataError", *place, message[:200])
    return Verdict("refused", message=message)


def _read_of(door: Door) -> tuple[str, int]:
    return f"reading {door.name}", 0


def place_of(trace: TracebackType | None) -> tuple[str, int]:
    """Return the file and function, and the line, of the innermost frame in the package."""
    frames = traceback.extract_tb(trace)
    inside = [f for f in frames if Path(f.filename).is_relative_to(PACKAGE)] or frames[-1:]
    last = inside[-1]
    path = Path(last.filename)
    where = path.relative_to(PACKAGE) if path.is_relative_to(PACKAGE) else path.name
    return f"{where}:{last.name}", last.lineno or 0


def resident_mb(peak: bool = False, forget_peak: bool = False) -> float:
    """Return the memory of this process, or its peak since it was forgotten; 0 but on Linux."""
    try:
        if forget_peak:
            Path("/proc/self/clear_refs").write_text("5")
        text = Path("/proc/self/status").read_text()
    except OSError:
        return 0.0
    found = re.search(r"VmHWM:\s+(\d+)" if peak else r"VmRSS:\s+(\d+)", text)
    return int(found[1]) / 1024 if found else 0.0
