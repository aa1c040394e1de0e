"""Blocks of which the sections of a page are made: text, tables, figures and numbers to copy."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from slipid.report.numbers import interval
from slipid.support.content import Content

Trace = dict[str, Any]
"""One series of a figure, as plotly's JavaScript library takes it."""


@dataclass(frozen=True)
class Badge:
    """A word in a colour: `good`, `weak`, `bad` or `plain`."""

    text: str
    kind: str = "plain"


Cell = str | Badge


@dataclass(frozen=True)
class TextBlock:
    """A paragraph, or a list of sentences.

    Attributes:
        sentences: the sentences.
        listed: True for a list with a bullet for each sentence.
        kind: `plain`, `note` or `warning`.
    """

    sentences: Sequence[str]
    listed: bool = False
    kind: str = "plain"
    block: str = field(default="text", init=False)


@dataclass(frozen=True)
class TableBlock:
    """A table with a caption, which says in one sentence what it shows.

    Attributes:
        caption: the sentence.
        head: headers of the columns.
        rows: cells of the rows.
        right: headers of the columns with numbers, which are aligned to the right.
        folded: True if the table opens on a click.
    """

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    right: Sequence[str] = ()
    folded: bool = False
    block: str = field(default="table", init=False)


@dataclass(frozen=True)
class FigureBlock:
    """An interactive figure.

    Attributes:
        name: identifier on the page.
        title: what the data show.
        alt: description for people who do not see the figure.
        data: series, in the form of plotly's JavaScript library; a colour may be `@ink`, `@muted`,
            `@blue` and so on, which the page replaces by that of its theme.
        layout: layout, in the same form.
        caption: how to read the figure.
        height: height [pixel].
        choices: values of y of every series, keyed by the label of a choice; empty for no choice.
        titles: title of every choice.
        minimum: smallest width [pixel]; on a narrower screen the figure scrolls.
    """

    name: str
    title: str
    alt: str
    data: Sequence[Trace]
    layout: Content
    caption: str = ""
    height: int = 360
    choices: Mapping[str, Sequence[Sequence[float | None]]] = field(default_factory=dict)
    titles: Mapping[str, str] = field(default_factory=dict)
    minimum: int = 280
    block: str = field(default="figure", init=False)

    @property
    def drawn(self) -> Content:
        """Content from which the page draws the figure."""
        return {
            "data": list(self.data),
            "layout": self.layout,
            "height": self.height,
            "choices": dict(self.choices),
            "titles": dict(self.titles),
        }


@dataclass(frozen=True)
class DrawingBlock:
    """A drawing in SVG.

    Attributes:
        title: what it shows.
        alt: description for people who do not see it.
        svg: the drawing.
        caption: how to read it.
    """

    title: str
    alt: str
    svg: str
    caption: str = ""
    block: str = field(default="drawing", init=False)


@dataclass(frozen=True)
class CopyLines:
    """Lines to copy.

    Attributes:
        title: what they are.
        text: the lines.
    """

    title: str
    text: str
    block: str = field(default="code", init=False)


@dataclass(frozen=True)
class Player:
    """Paths of runs that can be played.

    Attributes:
        runs: content of each run.
        maps: content of each floor map on which runs are drawn.
        models: labels of the models, keyed by their names.
        alt: description for people who do not see the paths.
    """

    runs: Sequence[Content]
    maps: Sequence[Content]
    models: Mapping[str, str]
    alt: str
    block: str = field(default="player", init=False)


Block = TextBlock | TableBlock | FigureBlock | DrawingBlock | CopyLines | Player


@dataclass(frozen=True)
class PageSection:
    """A section of a page.

    Attributes:
        name: identifier on the page.
        title: heading.
        blocks: content.
    """

    name: str
    title: str
    blocks: Sequence[Block]


VERDICTS = {
    "identified": "good",
    "trusted": "good",
    "weak": "weak",
    "disputed": "weak",
    "doubtful": "weak",
    "not_identified": "bad",
    "at_bound": "bad",
    "not to be trusted": "bad",
    "wrong": "bad",
    "suspicious": "weak",
}
"""Kind of the badge of each verdict."""


def badge(verdict: str) -> Badge:
    """Return a verdict as a badge."""
    return Badge(verdict.replace("_", " "), VERDICTS.get(verdict, "plain"))


class ModelStyle(NamedTuple):
    """Style of a slip model in figures.

    Attributes:
        label: label of the model.
        colour: colour of its series, a name of the theme.
        symbol: symbol of its dots.
        size: size of its dots [pixel].
    """

    label: str
    colour: str = "@muted"
    symbol: str = "x"
    size: int = 9


MODELS: Mapping[str, ModelStyle] = {
    "nominal": ModelStyle("lengths of the config", "@orange", "circle"),
    "encoder": ModelStyle("fitted lengths, no slip", "@purple", "triangle-up"),
    "calibrated": ModelStyle("calibrated kinematics", "@green", "square"),
    "contact": ModelStyle("force balance", "@blue", "diamond"),
    "identified": ModelStyle("force balance", "@blue", "diamond"),
    "selected": ModelStyle("selected model", "@ink", "circle-open", 16),
    "heading_lookup": ModelStyle("lookup by heading", "@sky", "triangle-down"),
    "paper": ModelStyle("form of the 2021 paper", "@yellow", "cross"),
    "effective_track": ModelStyle("effective track", "@sky", "triangle-down"),
}
"""Styles of slip models, keyed by name."""


def style_of(model: str) -> ModelStyle:
    """Return the style of a slip model."""
    return MODELS.get(model, ModelStyle(model.replace("_", " ")))


def label(model: str) -> str:
    """Return the label of a slip model."""
    return style_of(model).label


def colour(model: str) -> str:
    """Return the colour of a slip model."""
    return style_of(model).colour


def marker(model: str) -> Content:
    """Return the marker of a slip model."""
    style = style_of(model)
    return {"symbol": style.symbol, "size": style.size, "opacity": 1}


def number(value: float, digits: int = 4) -> str:
    """Return a number as text with some significant digits."""
    return f"{value:.{digits}g}"


def spanned(ends: Sequence[float] | None) -> str:
    """Return an interval as text, empty for None."""
    return interval(ends, " to ")


def enumerated(names: Sequence[str]) -> str:
    """Return names as a list in words."""
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} and {names[-1]}"
