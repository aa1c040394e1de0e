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

SEVERITY = {"wrong": "bold red", "suspicious": "yellow"}
"""Colours of a check's findings, by severity."""
WIDTH = 80
"""Width of text that is not written to a terminal [characters]."""
MOST_NOTES = 5
"""Largest number of notes on a page."""
Shown = TypeVar("Shown")


Item = TypeVar("Item")


class Page:
    """Text of tables and unbroken sentences, which is printed or kept in memory.

    Notes are written at its end, the most important first, and at most `MOST_NOTES`.

    Args:
        kept: True to keep the text, for the property `text`, instead of printing it.
        rest: where all notes are, for the sentence about those that are left out.
    """

    def __init__(self, kept: bool = False, rest: str = "the attributes of this result") -> None:
        # Without `force_jupyter`, rich would print a kept page to a notebook, with colours.
        file, plain = (StringIO(), False) if kept else (None, None)
        self._console = Console(
            highlight=False, file=file, force_terminal=plain, force_jupyter=plain
        )
        if not self._console.is_terminal:  # A file or a pipe has no width.
            self._console.width = WIDTH
        self._rest, self._notes = rest, list[str]()

    @property
    def text(self) -> str:
        """The kept text, without blanks at the ends of lines; empty if the page prints."""
        self.end()
        written = self._console.file
        lines = written.getvalue().splitlines() if isinstance(written, StringIO) else []
        return "\n".join(line.rstrip() for line in lines)

    def table(self, table: Table) -> None:
        """Write a table below its title, which is a line of its own, however narrow the table."""
        title, table.title = table.title, None
        if title:
            self._console.print(title, markup=False, soft_wrap=True)
        self._console.print(table)

    def line(self, text: str = "") -> None:
        self._console.print(text, markup=False, soft_wrap=True)

    def notes(self, sentences: Iterable[str], first: bool = False) -> None:
        """Keep sentences for the notes at the end of the page, the most important first.

        With `first`, they come before the notes that the page already has.
        """
        at = 0 if first else len(self._notes)
        self._notes[at:at] = [one for one in sentences if one not in self._notes]

    def end(self) -> None:
        """Write the notes."""
        notes, self._notes = self._notes, []
        for sentence in notes[:MOST_NOTES]:
            self.line(f"note: {sentence}")
        if (more := len(notes) - MOST_NOTES) > 0:
            self.line(f"{more} more note{'s' if more > 1 else ''} in {self._rest}")

    def findings(self, found: Iterable[Content]) -> None:
        """Write findings of a check with their remedies; colours show the severity.

        Findings of the least severity become notes.
        """
        for one in found:
            where = f" (in {listed(one['runs'])})" if one["runs"] else ""
            if one["severity"] == "note":
                remedy = f"; {one['remedy']}" if one["remedy"] else ""
                self.notes([f"{one['found']}{where}{remedy}"])
                continue
            remedy = f"\n    {one['remedy']}" if one["remedy"] else ""
            text = Text.assemble((f"{one['severity']}: ", SEVERITY[one["severity"]]))
            self._console.print(text.append(f"{one['found']}{where}{remedy}"), soft_wrap=True)


def text_of(show: Callable[[Page, Shown], None], found: Shown) -> str:
    """Return the text that `show` writes to a page about `found`."""
    page = Page(kept=True)
    show(page, found)
    return page.text


def table(columns: Sequence[str], title: str | None = None, right: Sequence[str] = ()) -> Table:
    """Return an empty table without rules; the columns named in `right` are right-aligned.

    Where a cell is too wide for the page it goes on in the next line, and nothing is cut off.
    """
    made = Table(title=title, title_justify="left", show_edge=False, pad_edge=False, box=None)
    for name in columns:
        made.add_column(name, justify="right" if name in right else "left", overflow="fold")
    return made


def heading(made: Table, text: str) -> None:
    """Add a row with the name that the first cells of the next rows have in common."""
    made.add_row(Text(text, style="bold"))


class Groups:
    """Names of parameters in a table, below headings with the first part of their paths."""

    def __init__(self, made: Table) -> None:
        self._table, self._group = made, ""

    def name(self, path: str) -> str:
        """Return the name of a parameter for its row; a new group gets its heading before."""
        group, name = _split(path)
        if group != self._group:
            heading(self._table, group)
            self._group = group
        return in_two_lines(name) if "/" in path else f"  .{name}"


def in_two_lines(ratio: str) -> str:
    """Return the path of a ratio with its two parameters below each other."""
    return ratio.replace("/", " /\n  ")


def grouped(items: Iterable[Item], path: Callable[[Item], str]) -> list[Item]:
    """Return items with those together whose paths have the same first part."""
    every = list(items)
    groups = [_split(path(one))[0] for one in every]
    return sorted(every, key=lambda one: groups.index(_split(path(one))[0]))


def _split(path: str) -> tuple[str, str]:
    """Return the first part of a parameter's path, and its name; ratios are one group."""
    group, _, name = ("ratios", "", path) if "/" in path else path.rpartition(".")
    return group, name


def counted(names: Sequence[str], most: int = 6) -> str:
    """Return the first names, and the number of further ones."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def verdict(word: str, colour: dict[str, str] = COLOUR) -> str:
    """Return a verdict with rich's markup for its colour."""
    shade = colour.get(word, "dim")
    return f"[{shade}]{word.replace('_', ' ')}[/{shade}]"


def percent(x: float | None) -> str:
    """Return a fraction as text in percent with two decimal places; empty for None."""
    return "" if x is None else f"{100 * x:.2f} %"
