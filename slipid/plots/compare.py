"""Who wins on which floor, by how much, and where the data cannot tell."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slipid.plots import drawing
from slipid.plots.slip_models import WORDS, bars, colour_of, titled
from slipid.support.content import Content

TIED = "#cfe3f1"
SHOWN = {
    "sectors": "60-degree sectors of headings left out",
    "speeds": "one speed left out",
    "random": "random headings left out",
}


def compare_plot(found: Content, out: Path) -> Path:
    """Draw the answer to the first question of comparison.json."""
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
        density, error = axes[:, column]
        titled(density, floor, answer["runs"])
        _density(density, answer["models"])
        errors = {model: 100 * one["endpoint_error"] for model, one in answer["models"].items()}
        stds = [200 * (one["endpoint_error_se"] or 0.0) for one in answer["models"].values()]
        bars(error, errors, stds)
        error.set_xlabel("mean end-point error\n[% of displacement], less is better")
        for k, one in enumerate(answer["models"].values()):
            if one["verdict"] in ("best", "tied"):
                for ax in (density, error):
                    ax.axhspan(k - 0.5, k + 0.5, color=TIED, zorder=0)
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
    reach: list[float] = []
    for k, (model, one) in enumerate(models.items()):
        at, bar, colour = one["difference"], 2 * (one["se_clustered"] or 0.0), colour_of(model)
        ax.errorbar(at, k, xerr=bar, fmt="none", ecolor=colour, elinewidth=1.6)
        mark, size = ("*", 13.0) if one["verdict"] == "best" else ("o", 5.0)
        ax.plot(at, k, mark, ms=size, color=colour, mew=0)
        reach += [at - bar, at + bar]
    ax.axvline(0.0, color=drawing.INK, lw=0.8)
    spare = 0.06 * max(max(reach) - min(reach), 1.0)
    ax.set_xlim(min(reach) - spare, max(reach) + spare)
