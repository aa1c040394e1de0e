"""Damage to files, the same for the same seed: what disks, editors and interrupted tools do."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

_CELLS = (
    "nan",
    "",
    "abc",
    "1e308",
    "-1e308",
    "inf",
    "9" * 400,
    "1,5",
    "0x10",
    "--",
    "1_0",
    "Ω",
    '"',
)
"""Contents that replace cells."""


def _cells(lines: list[str], rng: np.random.Generator) -> list[str]:
    """Replace single cells."""
    out = list(lines)
    for _ in range(rng.integers(1, 6)):
        row = int(rng.integers(len(out)))
        parts = re.split(r"([,;\t])", out[row])
        parts[2 * int(rng.integers((len(parts) + 1) // 2))] = str(rng.choice(_CELLS))
        out[row] = "".join(parts)
    return out


def _column(lines: list[str], rng: np.random.Generator) -> list[str]:
    """Replace all cells of a column below the first lines."""
    at, cell, first = int(rng.integers(6)), str(rng.choice([*_CELLS, "0", "5"])), rng.integers(4)
    out = list(lines[:first])
    for line in lines[first:]:
        parts = re.split(r"([,;\t])", line)
        if 2 * at < len(parts):
            parts[2 * at] = cell
        out.append("".join(parts))
    return out


def _delimiters(lines: list[str], rng: np.random.Generator) -> list[str]:
    """Exchange the delimiters of some lines."""
    other = str(rng.choice([";", ",", " ", "\t", "|", ""]))
    share = rng.choice([0.02, 0.5, 1.0])
    return [re.sub("[,;]", other, line) if rng.random() < share else line for line in lines]


def _names(lines: list[str], rng: np.random.Generator) -> list[str]:
    """Repeat the name of one column in another."""
    row = int(rng.integers(min(2, len(lines))))
    parts = re.split(r"([,;\t])", lines[row])
    a, b = rng.integers((len(parts) + 1) // 2, size=2)
    parts[2 * a] = parts[2 * b]
    return [*lines[:row], "".join(parts), *lines[row + 1 :]]


def _less(lines: list[str], rng: np.random.Generator) -> list[str]:
    """Keep the first lines only."""
    return lines[: int(rng.choice([1, 2, 3, 4, 8, 12]))]


def _headless(lines: list[str], rng: np.random.Generator) -> list[str]:
    """Remove the first lines."""
    return lines[int(rng.integers(1, 9)) :]


def _order(lines: list[str], rng: np.random.Generator) -> list[str]:
    """Move or repeat lines, so that times go back or repeat."""
    a, b = sorted(rng.integers(len(lines), size=2).tolist())
    return [
        [*lines[:a], *lines[b:], *lines[a:b]],
        [*lines[:b], *lines[a:]],
        [*lines[:2], *lines[:1:-1]],
        [*lines[:a], *lines[b:]],
    ][int(rng.integers(4))]


def _blank(lines: list[str], rng: np.random.Generator) -> list[str]:
    """Insert lines that are empty or of other kinds than the rest."""
    at = int(rng.integers(len(lines)))
    return [
        *lines[:at],
        str(rng.choice(["", "   ", ",,,", "end of log", "\0", "[[[["])),
        *lines[at:],
    ]


def _of_text(
    change: Callable[[list[str], np.random.Generator], list[str]],
) -> Callable[[bytes, np.random.Generator], bytes]:
    def damage(raw: bytes, rng: np.random.Generator) -> bytes:
        lines = raw.decode("latin-1").split("\n")
        return "\n".join(change(lines, rng)).encode("latin-1", errors="replace")

    return damage


def _flipped(raw: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(raw)
    for _ in range(rng.integers(1, 20)):
        out[int(rng.integers(len(out)))] = int(rng.integers(256))
    return bytes(out)


def _cut(raw: bytes, rng: np.random.Generator) -> bytes:
    return raw[: int(rng.integers(len(raw)))]


def _inserted(raw: bytes, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(min(len(raw), 400)))
    return raw[:at] + rng.bytes(int(rng.integers(1, 30))) + raw[at:]


def _encoded(raw: bytes, rng: np.random.Generator) -> bytes:
    text = raw.decode("latin-1")
    return [
        text.encode("utf-16"),
        text.encode("utf-8-sig"),
        b"\xb0" + raw,
        b"",
        b"\n\n",
        raw.replace(b"\n", b"\r\n"),
        raw.replace(b"\n", b"\r"),
    ][int(rng.integers(7))]


_DAMAGES = (
    *map(_of_text, (_cells, _column, _delimiters, _names, _less, _headless, _order, _blank)),
    _flipped,
    _cut,
    _inserted,
    _encoded,
)


def damaged(raw: bytes, seed: int) -> bytes:
    """The bytes of a file after the damage of a seed; some seeds damage it twice."""
    rng = np.random.default_rng(seed)
    for _ in range(1 + seed % 3 // 2):
        raw = _DAMAGES[int(rng.integers(len(_DAMAGES)))](raw or b"\n", rng)
    return raw
