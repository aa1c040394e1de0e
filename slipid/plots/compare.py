"""Figures that compare slip models: their errors, and the best model on every floor."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slipid.plots import drawing
from slipid.support.content import Content

TIED = "#cfe3f1"
SHOWN = {
    "sectors": "60-degree sectors of headings held out",
    "speeds": "one speed held out",
    "random": "random headings held out",
}
MODEL_NAMES = {
    "identified": "identified (force balance)",
    "nominal": "encoders, sizes as in the config",
    "encoder": "encoders, sizes as fitted",
    "calibrated": "calibrated kinematics",
    "linear": "slip ~ torque",
    "affine": "slip ~ 1 + torque",
    "svr": "slip ~ 1 + torque, SVR",
    "quadratic": "slip ~ 1 + torque + torque²",
    "saturating": "slip ~ saturating torque",
    "monotone_spline": "slip ~ monotone curve of torque",
    "affine_current": "slip ~ 1 + current",
    "heading_lookup": "lookup by heading",
    "effective_track": "effective radius and track",
    "instantaneous_centres": "instantaneous centres",
    "full_linear": "general linear kinematics",
    "paper": "form of the 2021 paper, refitted",
}


def compare_plot(found: Content, out: Path) -> Path:
    """Write a figure of the ranking for the first kind of held-out runs in comparison.json."""
    question, answer = next(iter(found["questions"].items()))
    made = compare_figure(answer["floors"], SHOWN.get(question, question))
    return drawing.save(made, out / "comparison.png")


def compare_figure(floors: Content, which: str) -> Figure:
    """Draw the log predictive densities (upper panels) and end-point errors (lower) on each floor.

    The densities are drawn relative to that of the best model.

    Args:
        floors: content of comparison.json by floor, for one kind of held-out runs.
        which: description of the held-out runs.
    """
    models = list(next(iter(floors.values()))["models"])
    made = drawing.figure(
        2.3 + 2.6 * max(len(floors), 2),
        2.6 + 0.52 * len(models),
        f"Slip models ranked by held-out runs ({which})\n"
        "star: best; shaded: not significantly worse than the best",
    )
    axes = made.subplots(2, len(floors), sharey=True, squeeze=False)
    for column, (floor, answer) in enumerate(floors.items()):
        density, error = axes[:, column]
        _set_title(density, floor, answer["runs"])
        _density(density, answer["models"])
        errors = {model: 100 * one["endpoint_error"] for model, one in answer["models"].items()}
        stds = [200 * (one["endpoint_error_se"] or 0.0) for one in answer["models"].values()]
        _bars(error, errors, stds)
        error.set_xlabel("mean end-point error\n[% of displacement], lower is better")
        for k, one in enumerate(answer["models"].values()):
            if one["verdict"] in ("best", "tied"):
                for ax in (density, error):
                    ax.axhspan(k - 0.5, k + 0.5, color=TIED, zorder=0)
    for row in (0, 1):
        axes[row, 0].set_yticks(range(len(models)), _readable(models))
    axes[0, 0].set_ylim(len(models) - 0.4, -0.6)
    made.supxlabel(
        "error bars: two standard errors, clustered by 30-degree sectors of headings",
        fontsize=9,
        color=drawing.SHADE,
    )
    return made


def _density(ax: Axes, models: Content) -> None:
    drawing.plain(ax)
    ax.set_xlabel("log density less that of the best\n[nats per run], higher is better")
    reach: list[float] = []
    for k, (model, one) in enumerate(models.items()):
        at, bar, colour = one["difference"], 2 * (one["se_clustered"] or 0.0), _colour_of(model)
        ax.errorbar(at, k, xerr=bar, fmt="none", ecolor=colour, elinewidth=1.6)
        mark, size = ("*", 13.0) if one["verdict"] == "best" else ("o", 5.0)
        ax.plot(at, k, mark, ms=size, color=colour, mew=0)
        reach += [at - bar, at + bar]
    ax.axvline(0.0, color=drawing.INK, lw=0.8)
    spare = 0.06 * max(max(reach) - min(reach), 1.0)
    ax.set_xlim(min(reach) - spare, max(reach) + spare)


def validation_figure(found: Content, which: str) -> Figure:
    """Draw the mean end-point error of every model on every floor of a validation file.

    Args:
        found: content of the file.
        which: description of its runs.
    """
    floors = found["summary"]
    models = list(next(iter(floors.values())))
    width = 2.7 * len(floors) + 2.4
    title = f"End-point errors of open-loop predictions against the camera; {which}"
    made = drawing.figure(max(width, 8.8), 1.7 + 0.32 * len(models), title)
    axes = made.subplots(1, len(floors), sharey=True, squeeze=False)[0]
    for ax, (floor, by) in zip(axes, floors.items(), strict=True):
        _bars(ax, {model: 100 * by[model]["endpoint_error_mean"] for model in models})
        _set_title(ax, floor, by[models[0]]["runs"])
        ax.set_xlabel("mean end-point error\n[% of the camera's displacement]")
    axes[0].set_yticks(range(len(models)), _readable(models))
    axes[0].invert_yaxis()
    return made


def _readable(models: Sequence[str]) -> list[str]:
    """Return the names of models in words."""
    return [MODEL_NAMES.get(model, model.replace("_", " ")) for model in models]


def _set_title(ax: Axes, floor: str, runs: int) -> None:
    """Set the title of a panel: floor, load set-up and number of runs."""
    ax.set_title(f"{floor.replace('@', ', load ')}\n{runs} runs", fontsize=10)


def _colour_of(model: str) -> str:
    """Return the colour of a model: gray, except for the identified one."""
    return drawing.BLUE if model == "identified" else "#a8a8a8"


def _bars(ax: Axes, error: Mapping[str, float], half: Sequence[float] | None = None) -> None:
    """Draw a bar per model, labelled with its error; `half` is half the length of error bars."""
    drawing.plain(ax)
    ax.grid(False, axis="y")
    values, colours = list(error.values()), [_colour_of(model) for model in error]
    drawn = ax.barh(
        range(len(values)), values, 0.75, color=colours, xerr=half, error_kw={"elinewidth": 0.9}
    )
    ax.bar_label(drawn, [f"{v:.1f}" for v in values], padding=3, fontsize=9)
    ax.set_xlim(0.0, 1.22 * max(np.add(values, 0.0 if half is None else half)))
