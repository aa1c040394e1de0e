"""Reading of data logs of WPILib (.wpilog): entries with a name, a type and records with times.

The format is that of "WPILib Data Log File Format Specification, Version 1.0" (wpiutil,
datalog.adoc). A log that was cut off, as when a robot is switched off, is read up to its last
complete record.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.data.reading.table import raw_bytes
from slipid.support.errors import bad_data

_NUMBERS = {"double": "<d", "float": "<f", "int64": "<q", "boolean": "<?"}
_HEADER = 12
"""Bytes of the header without its extra text."""
_WORDS = {"rotation": "rev", "turn": "rev", "meter": "m", "metre": "m", "volt": "V", "amp": "A"}
_WORDS |= {"ampere": "A", "radian": "rad", "degree": "deg", "second": "s"}


@dataclass(eq=False)
class LogEntry:
    """An entry of a log and its records.

    Attributes:
        name: name of the entry, such as `NT:/drive/velocity` or `voltage-motor-drive`.
        kind: type of its values.
        metadata: text about the entry; SysIdRoutineLog writes the unit.
        times: time of each record [s].
        values: number of each record, if the type is one of numbers.
        texts: text of each record, if the type is `string`.
    """

    name: str
    kind: str
    metadata: str
    times: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)

    @property
    def unit(self) -> str:
        """Unit in the metadata, such as rev/s for "Rotation per Second"; else the metadata."""
        words = self.metadata.lower().replace(" per ", "/").split("/")
        return "/".join(_WORDS.get(word.removesuffix("s"), word) for word in words)

    @property
    def samples(self) -> tuple[Float[np.ndarray, " record"], Float[np.ndarray, " record"]]:
        """Increasing times [s] and the numbers at these times, the last of several at one time."""
        times = np.array(self.times)
        order = np.argsort(times, kind="stable")
        last = np.append(np.diff(times[order]) > 0, True)
        return times[order][last], np.array(self.values, dtype=float)[order][last]


def read_wpilog(path: Path) -> dict[str, LogEntry]:
    """Return the entries of a log that have records, of numbers or of texts, keyed by their names.

    Raises:
        DataError: the file is not a log of WPILib, or a record does not match its entry's type.
    """
    raw = raw_bytes(path)
    if raw[:6] != b"WPILOG" or len(raw) < _HEADER:
        raise bad_data(path, "no header of a data log", "a log of WPILib that begins with WPILOG")
    if raw[7] != 1:
        raise bad_data(path, f"version {raw[7]}.{raw[6]} of the format", "version 1")
    running: dict[int, LogEntry] = {}
    entries: dict[str, LogEntry] = {}
    for number, (id, time, payload) in enumerate(_records(raw), start=1):
        try:
            if id == 0:
                _control(payload, running, entries)
            elif (entry := running.get(id)) is not None:
                _append(entry, time, payload)
        except (struct.error, UnicodeDecodeError) as error:
            found = f"record {number} does not match the type of its entry ({error})"
            raise bad_data(path, found, "a log that is not damaged") from error
    kept = {name: entry for name, entry in entries.items() if entry.times}
    if not kept:
        raise bad_data(path, "no record of a number or text", "a log with entries that have values")
    return kept


def _records(raw: bytes) -> Iterator[tuple[int, float, bytes]]:
    """Yield the entry's number, the time [s] and the payload of each complete record."""
    at = _HEADER + int.from_bytes(raw[8:12], "little")
    while at < len(raw):
        bits, places = raw[at], [at + 1]
        for length in ((bits & 3) + 1, (bits >> 2 & 3) + 1, (bits >> 4 & 7) + 1):
            places.append(places[-1] + length)
        id, size, time = (int.from_bytes(raw[a:b], "little") for a, b in pairwise(places))
        at = places[-1] + size
        if at <= len(raw):
            yield id, 1e-6 * time, raw[places[-1] : at]


def _control(payload: bytes, running: dict[int, LogEntry], entries: dict[str, LogEntry]) -> None:
    """Apply a control record, which starts or finishes an entry, or replaces its metadata."""
    kind, id = struct.unpack_from("<BI", payload)
    texts, at = [], 5
    while at < len(payload):
        (length,) = struct.unpack_from("<I", payload, at)
        texts.append(payload[at + 4 : at + 4 + length].decode())
        at += 4 + length
    if kind == 0 and len(texts) == 3:
        name, type_name, metadata = texts
        running[id] = entries.setdefault(name, LogEntry(name, type_name, metadata))
    elif kind == 1:
        running.pop(id, None)
    elif kind == 2 and texts and id in running:
        running[id].metadata = texts[0]


def _append(entry: LogEntry, time: float, payload: bytes) -> None:
    """Append a record to its entry if its type is one of numbers or of text."""
    if entry.kind in _NUMBERS:
        entry.values.append(float(*struct.unpack(_NUMBERS[entry.kind], payload)))
        entry.times.append(time)
    elif entry.kind == "string":
        entry.texts.append(payload.decode())
        entry.times.append(time)
