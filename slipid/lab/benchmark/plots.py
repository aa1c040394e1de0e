"""Plots of the end-point errors of every row of the benchmark, one panel per protocol."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from slipid.plots import drawing
from slipid.support.content import Content

OWN_PREFIX = "slipid"
"""Prefix of the names of rows that are highlighted."""


def benchmark_pictures(found: Content) -> dict[str, bytes]:
    """Draw a figure for each data set of benchmark.json; return PNG bytes by data set name."""
    made = {n: benchmark_figure(one, found["protocols"], n) for n, one in found["sets"].items()}
    return {name: drawing.png(figure) for name, figure in made.items() if figure is not None}


def benchmark_figure(one: Content, about: Content, name: str) -> Figure | None:
    """Return a figure of one data set: mean end-point errors with 90 % intervals, by protocol.

    The figure is None if no row has an end-point error.

    Args:
        one: content of a data set in benchmark.json.
        about: descriptions of the protocols, keyed by name.
        name: name of the data set.
    """
    protocols = {
        protocol: ends
        for protocol, rows in one["protocols"].items()
        if (ends := {n: row["endpoint_error"] for n, row in rows.items() if row["endpoint_error"]})
    }
    if not protocols:
        return None
    rows = max(len(ends) for ends in protocols.values())
    made, axes = drawing.panels(
        len(protocols),
        4.6,
        1.4 + 0.24 * rows,
        f"{name}: {one['about']}\nmean end-point error over the {one['over']}, 90 % intervals",
    )
    for ax, (protocol, ends) in zip(axes, protocols.items(), strict=True):
        _panel(ax, ends)
        ax.set_title(about[protocol], fontsize=9, loc="left", wrap=True)
    return made


def _panel(ax: Axes, ends: Mapping[str, Sequence[float]]) -> None:
    order = sorted(ends, key=lambda row: -ends[row][0])
    for k, row in enumerate(order):
        middle, low, high = (100 * x for x in ends[row])
        colour = drawing.ORANGE if row.startswith(OWN_PREFIX) else drawing.BLUE
        ax.plot([low, high], [k, k], color=colour, lw=1.5)
        ax.plot(middle, k, "o", color=colour, ms=4)
    ax.set_yticks(np.arange(len(order)), order, fontsize=7)
    for label in ax.get_yticklabels():
        if label.get_text().startswith(OWN_PREFIX):
            label.set_color(drawing.ORANGE)
            label.set_fontweight("bold")
    ax.set_xscale("log")
    ax.set_xlabel("end-point error, %")
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.minorticks_off()
    ax.set_ylim(-0.7, len(order) - 0.3)
