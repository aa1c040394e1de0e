"""Profile likelihoods beside Laplace's parabolas."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slipid.identify.verdicts.profile import RISE, Profile
from slipid.plots import drawing


def profile_figure(found: Sequence[Profile]) -> Figure:
    """One panel per number: how fast the fit gets worse when the number is held elsewhere."""
    made, axes = drawing.panels(
        len(found),
        5.4,
        4.4,
        "How much worse the logs fit when a number is held elsewhere and all others are refitted",
    )
    for ax, profile in zip(axes, found, strict=True):
        _panel(ax, profile)
    axes[0].legend(fontsize=8, loc="upper center")
    axes[0].set_ylabel("minus log likelihood above its lowest")
    return made


def _panel(ax: Axes, p: Profile) -> None:
    ax.plot(p.value, p.likelihood, "o-", color=drawing.BLUE, label="data (own prior taken out)")
    ax.plot(p.value, p.posterior, "s--", color=drawing.GREEN, ms=4, label="data and prior")
    ax.plot(p.value, p.laplace, ":", color=drawing.INK, label="Laplace")
    ax.axhline(RISE, color=drawing.SHADE, lw=1)
    ax.text(1.0, RISE, "90 %", transform=ax.get_yaxis_transform(), ha="right", va="bottom")
    low, high = p.interval90
    low, high = p.value[0] if low is None else low, p.value[-1] if high is None else high
    ax.axvspan(low, high, color=drawing.BLUE, alpha=0.10, lw=0)
    ax.plot(p.estimate, 0.0, "X", color=drawing.ORANGE, ms=10, mec="white", label="estimate")
    ax.set_ylim(-0.15, 3.2 * RISE)
    if p.value[-1] > 20 * p.value[0] > 0:
        ax.set_xscale("log")
    unit = "" if p.unit == "1" else f" [{p.unit}]"
    ax.set_xlabel(f"{p.path}{unit}")
    head, _, rest = p.said.partition(": ")
    given = f"\ngiven {p.given}" if p.given else ""
    ax.set_title(f"{head}\n{rest}{given}", fontsize=10)
