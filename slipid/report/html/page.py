"""Rendering of a page as one HTML file that needs no network.

The JavaScript library and the numbers are packed with gzip, which browsers unpack: the file is
less than half as large.
"""

import gzip
import json
from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from slipid.report.html.blocks import Badge, FigureBlock, PageSection, Player
from slipid.support.content import Content
from slipid.support.extras import MissingExtra, require
from slipid.support.files import write_bytes
from slipid.support.progress import Reporter

REPORT = "report.html"
_HERE = Path(__file__).parent / "assets"


@dataclass(frozen=True)
class WebPage:
    """Content of a page.

    Attributes:
        title: heading of the page.
        badge: verdict beside the heading, None for none.
        lead: one sentence below the heading.
        sections: sections in their order.
    """

    title: str
    badge: Badge | None
    lead: str
    sections: Sequence[PageSection]


def write_page(page: WebPage, path: Path) -> Path:
    """Write a page and return its path.

    Raises:
        MissingExtra: jinja2 or plotly is not installed.
        DataError: the file cannot be written.
    """
    write_bytes(path, rendered(page).encode())
    return path


def try_page(page: WebPage, path: Path, report: Reporter) -> tuple[str, ...]:
    """Write a page and return the name of its file, or nothing if a library is missing."""
    try:
        return (write_page(page, path).name,)
    except MissingExtra as error:  # the results are already written
        report.line(str(error))
        return ()


def rendered(page: WebPage) -> str:
    """Return the HTML of a page."""
    _require("jinja2")
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(_HERE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html").render(
        page=page,
        css=(_HERE / "page.css").read_text(encoding="utf-8"),
        script=(_HERE / "page.js").read_text(encoding="utf-8"),
        plotly=_packed(_plotly()),
        content=_packed(
            json.dumps(_content(page.sections), allow_nan=False, separators=(",", ":"))
        ),
    )


def _plotly() -> str:
    """Return plotly's JavaScript library, which its Python package contains."""
    _require("plotly.offline")
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())


def _require(module: str) -> None:
    require(module, "report", f"the page {REPORT}")


def _content(sections: Iterable[PageSection]) -> Content:
    """Return the content of the figures and players, from which the page's script draws them."""
    blocks = [block for section in sections for block in section.blocks]
    return {
        "figures": {b.name: b.drawn for b in blocks if isinstance(b, FigureBlock)},
        "players": [
            {"runs": b.runs, "maps": b.maps, "models": b.models}
            for b in blocks
            if isinstance(b, Player)
        ],
    }


def _packed(text: str) -> str:
    """Return a text packed with gzip, as base64 text."""
    return b64encode(gzip.compress(text.encode(), mtime=0)).decode()
