"""A page of text, and what its tables share."""

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
"""Colours of what a check of logs and config says."""
WIDTH = 140
"""Of text that no terminal shows [characters]."""
Shown = TypeVar("Shown")


class Page:
    """Text for people, on standard output or kept: tables, and sentences that are not wrapped.

    Args:
        kept: whether the text is kept for `text` instead of printed.
    """

    def __init__(self, kept: bool = False) -> None:
        self._console = Console(highlight=False)
        if kept:  # a notebook claims to be a terminal with colours, and shows what is to be kept
            self._console = Console(
                highlight=False,
                width=WIDTH,
                file=StringIO(),
                force_terminal=False,
                force_jupyter=False,
            )
        elif not self._console.is_terminal:  # a file or a pipe has no width: do not wrap
            self._console = Console(highlight=False, width=WIDTH)

    @property
    def text(self) -> str:
        """What was written to a page that keeps it; lines end without blanks."""
        written = self._console.file
        lines = written.getvalue().splitlines() if isinstance(written, StringIO) else []
        return "\n".join(line.rstrip() for line in lines)

    def table(self, table: Table) -> None:
        self._console.print(table)

    def line(self, text: str = "") -> None:
        self._console.print(text, markup=False, soft_wrap=True)

    def notes(self, sentences: Iterable[str]) -> None:
        """Sentences a reader must know."""
        for sentence in sentences:
            self.line(f"note: {sentence}")

    def findings(self, found: Iterable[Content]) -> None:
        """What was found wrong, in colour, and what was not checked."""
        for one in found:
            remedy = f"\n    {one['remedy']}" if one["remedy"] else ""
            where = f" (in {listed(one['runs'])})" if one["runs"] else ""
            said = Text.assemble((f"{one['severity']}: ", SEVERITY[one["severity"]]))
            self._console.print(said.append(f"{one['found']}{where}{remedy}"), soft_wrap=True)


def text_of(show: Callable[[Page, Shown], None], found: Shown) -> str:
    """The text that a function writes to a page about something."""
    page = Page(kept=True)
    show(page, found)
    return page.text


def table(columns: Sequence[str], title: str | None = None, right: Sequence[str] = ()) -> Table:
    """Table without lines; the columns named in `right` are numbers."""
    made = Table(title=title, title_justify="left", show_edge=False, pad_edge=False, box=None)
    for name in columns:
        made.add_column(name, justify="right" if name in right else "left")
    return made


def verdict(word: str, colour: dict[str, str] = COLOUR) -> str:
    """A verdict in its colour."""
    shade = colour.get(word, "dim")
    return f"[{shade}]{word.replace('_', ' ')}[/{shade}]"


def percent(x: float | None) -> str:
    """A share, with two places; nothing where it is not known."""
    return "" if x is None else f"{100 * x:.2f} %"
