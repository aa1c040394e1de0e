"""Every model's error side by side."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slipid.plots import drawing
from slipid.support.content import Content

WORDS = {
    "identified": "identified (force balance)",
    "encoder": "encoders alone",
    "constant": "one slip for all",
    "linear": "slip ~ torque",
    "affine": "slip ~ 1 + torque",
    "svr": "slip ~ 1 + torque, SVR",
    "quadratic": "slip ~ 1 + torque + torque²",
    "saturating": "slip ~ saturating torque",
    "monotone_spline": "slip ~ any rising curve of torque",
    "affine_current": "slip ~ 1 + current",
    "heading_lookup": "lookup by heading",
    "paper": "form of 2021, refitted",
}


def ladder_figure(found: Content, which: str) -> Figure:
    """Mean end-point error of every model on every floor of a validation file, a bar each.

    Args:
        which: runs these are, in words.
    """
    floors = found["summary"]
    models = list(next(iter(floors.values())))
    width = 2.7 * len(floors) + 2.4
    made = drawing.figure(
        max(width, 8.8),
        1.7 + 0.32 * len(models),
        f"How far from the camera's end each model ends, open loop; {which}",
    )
    axes = made.subplots(1, len(floors), sharey=True, squeeze=False)[0]
    for ax, (floor, by) in zip(axes, floors.items(), strict=True):
        bars(ax, {model: 100 * by[model]["endpoint_error_mean"] for model in models})
        titled(ax, floor, by[models[0]]["runs"])
        ax.set_xlabel("mean end-point error\n[% of the camera's displacement]")
    axes[0].set_yticks(range(len(models)), [WORDS.get(m, m.replace("_", " ")) for m in models])
    axes[0].invert_yaxis()
    return made


def titled(ax: Axes, floor: str, runs: int) -> None:
    """Name a panel by its floor and the number of runs."""
    ax.set_title(f"{floor.replace('@', ', load ')}\n{runs} runs", fontsize=10)


def colour_of(model: str) -> str:
    """Colour of a model: only the identified one stands out."""
    return drawing.BLUE if model == "identified" else "#a8a8a8"


def bars(ax: Axes, error: Mapping[str, float], half: Sequence[float] | None = None) -> None:
    """A bar per model with its number, and half the length of its error bar."""
    drawing.plain(ax)
    ax.grid(False, axis="y")
    values, colours = list(error.values()), [colour_of(model) for model in error]
    drawn = ax.barh(
        range(len(values)), values, 0.75, color=colours, xerr=half, error_kw={"elinewidth": 0.9}
    )
    ax.bar_label(drawn, [f"{v:.1f}" for v in values], padding=3, fontsize=9)
    ax.set_xlim(0.0, 1.22 * max(np.add(values, 0.0 if half is None else half)))
