"""Who wins on which floor, by how much, and where the data cannot tell."""

from pathlib import Path

from slipid.plots import drawing
from slipid.plots.drawing import Axes, Figure
from slipid.plots.slip_models import WORDS
from slipid.support.content import Content

TIED = "#cfe3f1"
SHOWN = {
    "sectors": "60-degree sectors of headings left out",
    "speeds": "one speed left out",
    "random": "random headings left out",
}


def compare_plot(found: Content, out: Path) -> Path:
    """Draw the first question's answer.

    Args:
        found: content of comparison.json.
        out: folder to write to.
    """
    question, answer = next(iter(found["questions"].items()))
    made = compare_figure(answer["floors"], SHOWN.get(question, question))
    return drawing.save(made, out / "comparison.png")


def compare_figure(floors: Content, which: str) -> Figure:
    """Distance to the best model in predictive density, and end-point error, a column per floor.

    Args:
        floors: of one question of comparison.json.
        which: runs that were left out, in words.
    """
    models = list(next(iter(floors.values()))["models"])
    made = drawing.figure(
        2.3 + 2.6 * max(len(floors), 2),
        2.6 + 0.52 * len(models),
        f"Which slip model is right? Runs it has not seen ({which}) decide\n"
        "star: best; shaded: the data cannot tell it from the best",
    )
    axes = made.subplots(2, len(floors), sharey=True, squeeze=False)
    for column, (floor, answer) in enumerate(floors.items()):
        density, error = axes[0, column], axes[1, column]
        name = floor.replace("@", ", load ")
        density.set_title(f"{name}\n{answer['runs']} runs", fontsize=10)
        _density(density, answer["models"])
        _error(error, answer["models"])
        for ax in (density, error):
            _mark(ax, answer["models"])
    words = [WORDS.get(m, m.replace("_", " ")) for m in models]
    for row in (0, 1):
        axes[row, 0].set_yticks(range(len(models)), words)
    axes[0, 0].set_ylim(len(models) - 0.4, -0.6)
    made.supxlabel(
        "error bars: two standard errors, runs of one 30-degree sector of headings counted as one",
        fontsize=9,
        color=drawing.SHADE,
    )
    return made


def _density(ax: Axes, models: Content) -> None:
    drawing.plain(ax)
    ax.set_xlabel("log density less the best's\n[nats per run], more is better")
    for k, (model, one) in enumerate(models.items()):
        bar = 2 * (one["se_clustered"] or 0.0)
        ax.errorbar(
            one["difference"], k, xerr=bar, fmt="none", ecolor=_colour(model), elinewidth=1.6
        )
        mark, size = ("*", 13.0) if one["verdict"] == "best" else ("o", 5.0)
        ax.plot(one["difference"], k, mark, ms=size, color=_colour(model), mew=0)
    ax.axvline(0.0, color=drawing.INK, lw=0.8)
    ends = [
        one["difference"] + sign * 2 * (one["se_clustered"] or 0.0)
        for one in models.values()
        for sign in (-1, 1)
    ]
    spare = 0.06 * max(max(ends) - min(ends), 1.0)
    ax.set_xlim(min(ends) - spare, max(ends) + spare)


def _error(ax: Axes, models: Content) -> None:
    drawing.plain(ax)
    ax.grid(False, axis="y")
    ax.set_xlabel("mean end-point error\n[% of displacement], less is better")
    values = [100 * one["endpoint_error"] for one in models.values()]
    bars = [200 * (one["endpoint_error_se"] or 0.0) for one in models.values()]
    ax.barh(
        range(len(values)),
        values,
        height=0.7,
        color=[_colour(model) for model in models],
        xerr=bars,
        error_kw={"ecolor": drawing.INK, "elinewidth": 0.9},
    )
    reach = max(v + b for v, b in zip(values, bars, strict=True))
    for k, (v, b) in enumerate(zip(values, bars, strict=True)):
        ax.text(v + b + 0.03 * reach, k, f"{v:.1f}", va="center", fontsize=8)
    ax.set_xlim(0.0, 1.22 * reach)


def _mark(ax: Axes, models: Content) -> None:
    for k, one in enumerate(models.values()):
        if one["verdict"] in ("best", "tied"):
            ax.axhspan(k - 0.5, k + 0.5, color=TIED, zorder=0)


def _colour(model: str) -> str:
    return drawing.BLUE if model == "identified" else "#8c8c8c"
