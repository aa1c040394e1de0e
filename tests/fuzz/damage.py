"""Damage to a file by its kind: to its bytes, its lines and numbers, and what it contains."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import PurePath

import numpy as np

from tests.fuzz import archives, hostile
from tests.helpers import damaged_files

Damage = Callable[[bytes, np.random.Generator], bytes]
_NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?")
_NUMBERS = (
    *(b"nan", b"inf", b"-inf", b"-1", b"0", b"1e308", b"1e-320", b"1" + b"0" * 400, b"9" * 5000),
    *(b"", b"x", b"1e999", b"0x10", b"1_0", b"1,5", b'"', b"1e18", b"-1e18", b"99999999999"),
)
_EXTREMES = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
_TREES = (".json", ".geojson", ".toml", ".yaml")
_TEXTS = (*_TREES, ".csv", ".txt", ".msg")


def _flipped(raw: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(raw)
    for _ in range(int(rng.integers(1, 6))):
        out[int(rng.integers(len(out)))] ^= 1 << int(rng.integers(8))
    return bytes(out)


def _random(raw: bytes, rng: np.random.Generator) -> bytes:
    at, size = int(rng.integers(len(raw))), int(rng.integers(1, 40))
    return raw[:at] + rng.bytes(size) + raw[at + size :]


def _cut(raw: bytes, rng: np.random.Generator) -> bytes:
    return raw[: int(rng.integers(len(raw)))]


def _headless(raw: bytes, rng: np.random.Generator) -> bytes:
    return raw[int(rng.integers(1, len(raw) + 1)) :]


def _inserted(raw: bytes, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(len(raw)))
    return raw[:at] + rng.bytes(int(rng.integers(1, 30))) + raw[at:]


def _repeated(raw: bytes, rng: np.random.Generator) -> bytes:
    a, b = sorted(rng.integers(len(raw) + 1, size=2).tolist())
    return raw[:b] + raw[a:b] * int(rng.integers(1, 4)) + raw[b:]


def _zeroed(raw: bytes, rng: np.random.Generator) -> bytes:
    a, b = sorted(rng.integers(len(raw) + 1, size=2).tolist())
    b = min(b, a + 4096)
    return raw[:a] + bytes(b - a) + raw[b:]


def _swapped(raw: bytes, rng: np.random.Generator) -> bytes:
    a, b, c = sorted(rng.integers(len(raw) + 1, size=3).tolist())
    return raw[:a] + raw[b:c] + raw[a:b] + raw[c:]


def _removed(raw: bytes, rng: np.random.Generator) -> bytes:
    a, b = sorted(rng.integers(len(raw) + 1, size=2).tolist())
    return raw[:a] + raw[b:]


def _length(raw: bytes, rng: np.random.Generator) -> bytes:
    """Write an extreme number where a length may be."""
    form = str(rng.choice(["<B", "<H", "<I", "<Q", ">I"]))
    size = struct.calcsize(form)
    if len(raw) <= size:
        return b""
    near = min(len(raw), 600) if rng.random() < 0.5 else len(raw)
    at = int(rng.integers(max(1, near - size)))
    value = _EXTREMES[int(rng.integers(len(_EXTREMES)))] & (256**size - 1)
    return raw[:at] + struct.pack(form, value) + raw[at + size :]


def _half(raw: bytes, rng: np.random.Generator) -> bytes:
    """Write a floating-point number that is not finite where a number may be."""
    form = str(rng.choice(["<d", "<f"]))
    value = float(rng.choice([np.nan, np.inf, 3e38, -1.0, 1e-40]))
    at = int(rng.integers(max(1, len(raw) - 8))) // 4 * 4
    return raw[:at] + struct.pack(form, value) + raw[at + struct.calcsize(form) :]


def _number(raw: bytes, rng: np.random.Generator) -> bytes:
    """Replace one number of a text."""
    found = [m.span() for m in _NUMBER.finditer(raw)]
    if not found:
        return raw[1:]
    a, b = found[int(rng.integers(len(found)))]
    return raw[:a] + _NUMBERS[int(rng.integers(len(_NUMBERS)))] + raw[b:]


def _word(raw: bytes, rng: np.random.Generator) -> bytes:
    """Replace one word of a text by another one, or by an odd one."""
    found = [m.span() for m in re.finditer(rb"[A-Za-z_]\w*", raw)]
    if not found:
        return raw[1:]
    (a, b), (c, d) = (found[int(k)] for k in rng.integers(len(found), size=2))
    odd = (b"", b"x" * 2000, b"\xff\xfe", b"\0", "é".encode(), b"None", b"true", b"-")
    word = raw[c:d] if rng.random() < 0.5 else odd[int(rng.integers(len(odd)))]
    return raw[:a] + word + raw[b:]


def _line(raw: bytes, rng: np.random.Generator) -> bytes:
    """Repeat or remove a line."""
    lines = raw.split(b"\n")
    at = int(rng.integers(len(lines)))
    again = [lines[at]] * int(rng.choice([0, 2, 3]))
    return b"\n".join([*lines[:at], *again, *lines[at + 1 :]])


def _as_disks_do(raw: bytes, rng: np.random.Generator) -> bytes:
    return damaged_files.damaged(raw, int(rng.integers(2**31)))


_BYTES: tuple[Damage, ...] = (
    *(_flipped, _flipped, _random, _cut, _headless, _inserted, _repeated, _zeroed, _swapped),
    *(_removed, _length, _length, _length, _half),
)
_TEXT: tuple[Damage, ...] = (_number, _number, _word, _line, _as_disks_do, _as_disks_do)


def _tree(suffix: str) -> Damage:
    def damage(raw: bytes, rng: np.random.Generator) -> bytes:
        try:
            return hostile.written(suffix, hostile.hurt(hostile.read(suffix, raw), rng))
        except Exception:  # a file damaged before
            return _line(raw, rng)

    return damage


def damages_of(name: str) -> tuple[tuple[Damage, ...], ...]:
    """Return the groups of damages for a file of this name, of which each is as likely."""
    suffix = PurePath(name).suffix
    if suffix == ".values":  # values that come out of another file: their text is not damaged
        return ((_tree(".json"),),)
    if suffix in _TREES:
        return ((_tree(suffix),), (_tree(suffix),), (_tree(suffix),), _TEXT, _BYTES)
    if suffix in _TEXTS:
        return (_TEXT, _TEXT, _BYTES)
    if suffix in (".npz", ".zip"):
        return (archives.DAMAGES, archives.DAMAGES, _BYTES)
    return (_BYTES,)


def damaged(name: str, raw: bytes, rng: np.random.Generator) -> bytes:
    """Return the bytes of a file after damage of its kind, one time in four after two of them."""
    groups, out = damages_of(name), raw
    for _ in range(10):
        group = groups[int(rng.integers(len(groups)))]
        out = group[int(rng.integers(len(group)))](out or b"\n", rng)
        if out != raw and rng.random() < 0.75:
            break
    return out
