"""ULog files (PX4) written byte by byte."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path


def write_ulog(
    path: Path,
    formats: Mapping[str, str],
    messages: Sequence[tuple[str, int, bytes]],
) -> Path:
    """Write messages (topic, with `:1` for its second instance; number of its id; bytes).

    `formats` has the fields of each format, such as `uint64_t timestamp;float[2] wheel_speed;`.
    """
    out = [b"ULog\x01\x12\x35\x01", struct.pack("<Q", 0), _record("B", bytes(40))]
    out += [_record("F", f"{name}:{fields}".encode()) for name, fields in formats.items()]
    known: set[int] = set()
    for topic, number, data in messages:
        name, _, instance = topic.partition(":")
        if number not in known:
            known.add(number)
            added = struct.pack("<BH", int(instance or 0), number) + name.encode()
            out.append(_record("A", added))
        out.append(_record("D", struct.pack("<H", number) + data))
    path.write_bytes(b"".join(out))
    return path


def _record(kind: str, data: bytes) -> bytes:
    return struct.pack("<HB", len(data), ord(kind)) + data
