"""Text for people: words on one line, rounded numbers, Markdown tables."""

import textwrap
from collections.abc import Iterator, Sequence

WIDTH = 96
"""Longest line of a comment, its sign left out."""


def one_line(text: str) -> str:
    """Words of any origin on one line, without what no file may hold."""
    shown = "".join(c if c.isprintable() else " " for c in text)
    return " ".join(shown.split())


def short(value: float) -> str:
    """A number rounded for people, to four digits."""
    return f"{value:.4g}"


def interval(ends: tuple[float, float] | None) -> str:
    """An interval rounded for people; empty where there is none."""
    return "" if ends is None else f"{short(ends[0])} to {short(ends[1])}"


def wrapped(text: str, width: int = WIDTH) -> Iterator[str]:
    """A paragraph as lines of a comment; paths and addresses stay whole."""
    lines = textwrap.wrap(one_line(text), width, break_long_words=False, break_on_hyphens=False)
    yield from lines or [""]


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(map(_cell, line)) + " |" for line in lines]


def listed(names: Sequence[str]) -> str:
    """Names with commas, or the word that there are none."""
    return ", ".join(one_line(name) for name in names) or "none"


def _cell(text: str) -> str:
    return one_line(text).replace("\\", "\\\\").replace("|", "\\|")
