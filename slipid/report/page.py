"""A page of text for people, and the common style of its tables."""

from collections.abc import Callable, Iterable, Sequence
from io import StringIO
from typing import TypeVar

from rich.console import Console
from rich.table import Table
from rich.text import Text

from slipid.data.check.findings import listed
from slipid.support.content import Content

COLOUR = {
    "identified": "green",
    "weak": "yellow",
    "disputed": "yellow",
    "not_identified": "red",
    "at_bound": "magenta",
}

SEVERITY = {"wrong": "bold red", "suspicious": "yellow", "note": "dim"}
"""Colours of a check's findings, by severity."""
WIDTH = 140
"""Width of text that is not written to a terminal [characters]."""
Shown = TypeVar("Shown")


class Page:
    """Text of tables and unbroken sentences, which is printed or kept in memory.

    Args:
        kept: True to keep the text, for the property `text`, instead of printing it.
    """

    def __init__(self, kept: bool = False) -> None:
        # Without `force_jupyter`, rich would print a kept page to a notebook, with colours.
        file, plain = (StringIO(), False) if kept else (None, None)
        self._console = Console(
            highlight=False, file=file, force_terminal=plain, force_jupyter=plain
        )
        if not self._console.is_terminal:  # A file or a pipe has no width.
            self._console.width = WIDTH

    @property
    def text(self) -> str:
        """The kept text, without blanks at the ends of lines; empty if the page prints."""
        written = self._console.file
        lines = written.getvalue().splitlines() if isinstance(written, StringIO) else []
        return "\n".join(line.rstrip() for line in lines)

    def table(self, table: Table) -> None:
        self._console.print(table)

    def line(self, text: str = "") -> None:
        self._console.print(text, markup=False, soft_wrap=True)

    def notes(self, sentences: Iterable[str]) -> None:
        """Write each sentence as a note on its own line."""
        for sentence in sentences:
            self.line(f"note: {sentence}")

    def findings(self, found: Iterable[Content]) -> None:
        """Write findings of a check with their remedies; colours show the severity."""
        for one in found:
            remedy = f"\n    {one['remedy']}" if one["remedy"] else ""
            where = f" (in {listed(one['runs'])})" if one["runs"] else ""
            text = Text.assemble((f"{one['severity']}: ", SEVERITY[one["severity"]]))
            self._console.print(text.append(f"{one['found']}{where}{remedy}"), soft_wrap=True)


def text_of(show: Callable[[Page, Shown], None], found: Shown) -> str:
    """Return the text that `show` writes to a page about `found`."""
    page = Page(kept=True)
    show(page, found)
    return page.text


def table(columns: Sequence[str], title: str | None = None, right: Sequence[str] = ()) -> Table:
    """Return an empty table without rules; the columns named in `right` are right-aligned."""
    made = Table(title=title, title_justify="left", show_edge=False, pad_edge=False, box=None)
    for name in columns:
        made.add_column(name, justify="right" if name in right else "left")
    return made


def verdict(word: str, colour: dict[str, str] = COLOUR) -> str:
    """Return a verdict with rich's markup for its colour."""
    shade = colour.get(word, "dim")
    return f"[{shade}]{word.replace('_', ' ')}[/{shade}]"


def percent(x: float | None) -> str:
    """Return a fraction as text in percent with two decimal places; empty for None."""
    return "" if x is None else f"{100 * x:.2f} %"
