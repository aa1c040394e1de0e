"""Text for people: text on one line, rounded numbers, Markdown tables, templates of files.

The module also converts names of floors and load set-ups to names that are valid for ROS
parameters, C++ and files.
"""

import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.resources import files

COMMENT_WIDTH = 96
"""Largest length of a comment line, without the comment sign [characters]."""


def one_line(text: str) -> str:
    """Return text on one line; unprintable characters and repeated spaces become one space."""
    shown = "".join(c if c.isprintable() else " " for c in text)
    return " ".join(shown.split())


def short(value: float) -> str:
    """Return a number as text, rounded to four digits."""
    return f"{value:.4g}"


def interval(ends: tuple[float, float] | None) -> str:
    """Return an interval as text, rounded to four digits; an empty string for None."""
    return "" if ends is None else f"{short(ends[0])} to {short(ends[1])}"


def wrapped(text: str, width: int = COMMENT_WIDTH) -> Iterator[str]:
    """Yield a paragraph as lines of at most `width` characters; longer words stay whole."""
    lines = textwrap.wrap(one_line(text), width, break_long_words=False, break_on_hyphens=False)
    yield from lines or [""]


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(map(_cell, line)) + " |" for line in lines]


def template(name: str) -> str:
    """Return the text of a template in `slipid/exports/templates`, such as `c99/README.md`."""
    return (files(__package__) / "templates" / name).read_text()


def filled(name: str, values: Mapping[str, str | Iterable[str]]) -> str:
    """Return a template's text with every @NAME@ replaced by its value, a text or several lines."""
    texts = {k: v if isinstance(v, str) else "\n".join(v) for k, v in values.items()}
    return re.sub(r"@([A-Z]+)@", lambda match: texts[match.group(1)], template(name))


def listed(names: Sequence[str]) -> str:
    """Return names joined by commas, or "none" if there are none."""
    return ", ".join(one_line(name) for name in names) or "none"


def _cell(text: str) -> str:
    return one_line(text).replace("\\", "\\\\").replace("|", "\\|")


_WORDS = """
alignas alignof and asm auto bitand bitor bool break case catch char class compl concept const
constexpr continue decltype default delete do double else enum explicit export extern false float
for friend goto if inline int long mutable namespace new not operator or private protected public
register requires return short signed sizeof static struct switch template this throw true try
typedef typeid typename union unsigned using virtual void volatile while xor
"""
_KEYWORDS = frozenset(_WORDS.split())
"""Keywords of C++, which cannot be names of fields in a generated struct."""


def identifiers(labels: Sequence[str], kind: str) -> tuple[str, ...]:
    """Return a unique name of small letters, digits and single underscores for each label.

    The names differ even without underscores, since generate_parameter_library omits underscores in
    the names of structs. `kind` is put before a label that is not a valid name by itself.
    """
    names: list[str] = []
    for label in labels:
        plain = re.sub(r"[^a-z0-9]+", "_", label.lower()).strip("_")
        name = (
            plain
            if plain[:1].isalpha() and plain not in _KEYWORDS
            else f"{kind}_{plain}".strip("_")
        )
        count, first = 2, name
        while _without_underscores(name) in map(_without_underscores, names):
            name, count = f"{first}_v{count}", count + 1
        names.append(name)
    return tuple(names)


def _without_underscores(name: str) -> str:
    return name.replace("_", "")
