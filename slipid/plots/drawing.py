"""Functions and colours shared by all figures; figures need no display."""

import io
import math
from collections.abc import Mapping
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from slipid.support.files import write_bytes

BLUE, ORANGE, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
INK, SHADE = "#222222", "#888888"
SERIES = (BLUE, ORANGE, GREEN, PURPLE, "#56B4E9", "#E69F00")
"""Colours of series, from Okabe and Ito, which people with any colour vision can distinguish."""
STYLES = tuple(zip(SERIES, ("o", "^", "s", "D", "v", "P"), strict=True))
"""Colour and marker of each series."""


def figure(width: float, height: float, title: str) -> Figure:
    """Return an empty figure of this size [inch] with a title."""
    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(made)
    made.suptitle(title, fontsize=13, x=0.01, ha="left", color=INK)
    return made


def add_warning(made: Figure, text: str) -> None:
    """Put a warning above the title of a figure; both turn orange."""
    title = made.get_suptitle()
    made.suptitle(f"{text}\n{title}", fontsize=13, x=0.01, ha="left", color=ORANGE)


def panels(count: int, width: float, height: float, title: str) -> tuple[Figure, list[Axes]]:
    """Return a figure with `count` panels of the same size [inch], in rows of at most four."""
    columns = min(count, 4 if count != 5 else 3)
    rows = math.ceil(count / columns)
    # at least 8.8 inch, so that the title has room above a single panel
    made = figure(max(width * columns, 8.8), height * rows + 0.6, title)
    axes = list(made.subplots(rows, columns, squeeze=False).flat)
    for spare in axes[count:]:
        spare.remove()
    for ax in axes[:count]:
        plain(ax)
    return made, axes[:count]


def plain(axes: Axes) -> None:
    """Give axes a light grid, and remove their top and right edges."""
    axes.grid(color="#dddddd", lw=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def png(made: Figure) -> bytes:
    """Return the figure as the bytes of a PNG file."""
    buffer = io.BytesIO()
    made.savefig(buffer, format="png", dpi=110, metadata={"Software": "slipid"})
    return buffer.getvalue()


def save(made: Figure, path: Path) -> Path:
    """Write the figure as PNG atomically; return the path."""
    write_bytes(path, png(made))
    return path


def save_all(figures: Mapping[str, Figure | None], out: Path) -> list[Path]:
    """Write each figure that is not None to `out/NAME.png`; return the files."""
    return [save(made, out / f"{name}.png") for name, made in figures.items() if made is not None]
