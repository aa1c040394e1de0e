"""Series and layouts of figures, in the form of plotly's JavaScript library.

Colours begin with @ and are replaced by those of the page's theme, light or dark. All of them can
be distinguished with any colour vision (Okabe and Ito).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from slipid.report.html.blocks import Trace
from slipid.support.content import Content

SERIES = ("@blue", "@orange", "@green", "@purple", "@sky", "@yellow")
SYMBOLS = ("circle", "triangle-up", "square", "diamond", "cross", "x")
"""Colours and markers of series without a fixed meaning."""
Values = Sequence[Any] | Float[np.ndarray, " value"]


def dots(x: Values, y: Values, name: str, shade: str, **more: Any) -> Trace:
    """Return a series of dots; `more` has further properties of the series."""
    marker = {"color": shade, "size": 5, "opacity": 0.55, **more.pop("marker", {})}
    return {**_series(x, y, name, "markers", more), "marker": marker}


def line(x: Values, y: Values, name: str, shade: str, **more: Any) -> Trace:
    """Return a line; `more` has further properties of the series."""
    style = {"color": shade, "width": 2, **more.pop("line", {})}
    return {**_series(x, y, name, "lines", more), "line": style}


def band(x: Values, low: Values, high: Values, name: str, shade: str, **more: Any) -> Trace:
    """Return a filled band between two curves."""
    there, back = list(x), list(x)[::-1]
    edge = [*list(low), *list(high)[::-1]]
    return {
        **_series([*there, *back], edge, name, "lines", more),
        "fill": "toself",
        "fillcolor": shade,
        "line": {"width": 0, "color": shade},
        "opacity": 0.3,
        "hoverinfo": "skip",
    }


def errors(
    x: Values, y: Values, spread: tuple[Values, Values], name: str, shade: str, **more: Any
) -> Trace:
    """Return dots with horizontal error bars; `spread` has their lengths to both sides."""
    made = dots(x, y, name, shade, **more)
    made["marker"] |= {"size": 9, "opacity": 1.0}
    below, above = map(list, spread)
    lengths = {"type": "data", "symmetric": False, "array": above, "arrayminus": below}
    return made | {"error_x": lengths | {"color": shade, "thickness": 2, "width": 5}}


def _series(x: Values, y: Values, name: str, mode: str, more: Content) -> Trace:
    return {"type": "scatter", "x": list(x), "y": list(y), "name": name, "mode": mode, **more}


def axis(title: str, **more: Any) -> Content:
    """Return an axis with a title."""
    return {"title": {"text": title}, "automargin": True, **more}


def logarithmic() -> Content:
    """Return what makes an axis logarithmic, with labels at 1, 2 and 5 of every decade."""
    ticks = [round(step * 10.0**power, 3) for power in range(-3, 4) for step in (1, 2, 5)]
    return {"type": "log", "tickvals": ticks, "ticktext": [f"{tick:g}" for tick in ticks]}


def panels(count: int, titles: Sequence[str], across: int) -> tuple[Content, list[str], int]:
    """Return layout, names of the axes and number of rows of a grid of panels.

    Args:
        count: number of panels.
        titles: title of each panel.
        across: largest number of panels in a row.
    """
    columns = min(count, across)
    rows = -(-count // columns)
    layout: Content = {"annotations": []}
    names = []
    gap_x, gap_y = 0.09, 0.3 / max(rows, 1) if rows > 1 else 0.0
    width = (1 - gap_x * (columns - 1)) / columns
    height = (1 - gap_y * (rows - 1)) / rows
    for k in range(count):
        row, column = divmod(k, columns)
        left, top = column * (width + gap_x), 1 - row * (height + gap_y)
        name = str(k + 1) if k else ""
        names.append(name)
        layout[f"xaxis{name}"] = {"domain": [left, left + width], "anchor": f"y{name}"}
        layout[f"yaxis{name}"] = {"domain": [top - height, top], "anchor": f"x{name}"}
        layout["annotations"].append(
            {
                "text": titles[k],
                "x": left + width / 2,
                "y": top,
                "xref": "paper",
                "yref": "paper",
                "xanchor": "center",
                "yanchor": "bottom",
                "showarrow": False,
            }
        )
    return layout, names, rows


def onto(trace: Trace, name: str) -> Trace:
    """Return a series that is drawn in the panel with axes of this name."""
    return trace | {"xaxis": f"x{name}", "yaxis": f"y{name}"}
