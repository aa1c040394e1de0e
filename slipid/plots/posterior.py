"""Figures of posterior draws and of profile likelihoods, compared with a Gaussian approximation.

The Gaussian approximation of the posterior has the curvature of the loss at the fit.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slipid.infer.posterior.diagnosis import Posterior
from slipid.infer.verdicts.profile import RISE, Profile
from slipid.plots import drawing

MOST_PANELS = 6
"""Largest number of pairs of parameters that are drawn."""


def posterior_plots(found: Posterior, out: Path) -> list[Path]:
    """Write all `FIGURES` of a posterior; return the files."""
    return drawing.save_all({f"posterior_{k}": draw(found) for k, draw in FIGURES.items()}, out)


def interval_figure(found: Posterior) -> Figure:
    """Draw 90 % intervals of parameters, from posterior draws and from the fit's covariance.

    The intervals are drawn relative to the prior mean, in units of the prior standard deviation.
    """
    fit, z = found.fit, found.flat
    chosen = np.flatnonzero(fit.space.where(lambda e: e.session is None)).tolist()
    mean, std = fit.verdict_space.prior_mean[chosen], fit.verdict_space.prior_std[chosen]
    low, middle, high = (np.quantile(z[:, chosen], (0.05, 0.5, 0.95), axis=0) - mean) / std
    half = 1.645 * np.sqrt(np.diag(fit.covariance))[chosen] / std
    fitted = (fit.z[chosen] - mean) / std
    made = drawing.figure(
        8.8,
        1.6 + 0.2 * len(chosen),
        "Posterior of each parameter relative to its prior\n"
        "(0: prior mean; gray band: its 90 % interval)",
    )
    ax = made.subplots()
    drawing.plain(ax)
    at = np.arange(len(chosen))
    ax.axvspan(-1.645, 1.645, color="#eeeeee", zorder=0)
    ax.errorbar(fitted, at - 0.18, xerr=half, fmt="none", color=drawing.SHADE, lw=1.2)
    ax.errorbar(
        middle, at + 0.18, xerr=[middle - low, high - middle], fmt=".", color=drawing.BLUE, lw=1.6
    )
    ax.plot([], [], color=drawing.BLUE, lw=1.6, label="draws of the posterior, 90 %")
    ax.plot([], [], color=drawing.SHADE, lw=1.2, label="Gaussian approximation, 90 %")
    ax.set_yticks(at, [fit.space.names[k] for k in chosen], fontsize=8)
    ax.set_ylim(len(chosen) - 0.4, -0.6)
    ax.set_xlabel("prior standard deviations (of the logarithm for positive parameters)")
    ax.legend(loc="lower right", fontsize=8)
    return made


def pair_figure(found: Posterior) -> Figure:
    """Draw the pairs of parameters whose posterior draws deviate most from an ellipse."""
    fit, z = found.fit, found.flat
    pairs = curved_pairs(z)
    made, axes = drawing.panels(
        len(pairs),
        2.9,
        2.7,
        "Parameters that depend on each other along a curve: draws (dots)\n"
        "and the 90 % ellipse of the Gaussian approximation",
    )
    some = z[:: max(1, len(z) // 1500)]
    for ax, (i, j) in zip(axes, pairs, strict=True):
        ax.plot(some[:, i], some[:, j], ".", ms=2, color=drawing.BLUE, alpha=0.4)
        _ellipse(ax, fit.z[[i, j]], fit.covariance[np.ix_([i, j], [i, j])])
        for name, put in ((fit.space.names[i], ax.set_xlabel), (fit.space.names[j], ax.set_ylabel)):
            put(name.removeprefix("surface."), fontsize=8)
    return made


FIGURES = {"intervals": interval_figure, "pairs": pair_figure}
"""Functions that draw the figures of a posterior, keyed by name."""


def curved_pairs(z: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs of coordinates whose draws have the strongest curved dependence.

    In the first pair, the square of one coordinate explains most of the other. Each coordinate is
    in at most one pair.
    """
    t = (z - z.mean(axis=0)) / (z.std(axis=0) + 1e-300)
    linear = t.T @ t / len(t)
    square = t**2 - 1
    cubic = (t**3).mean(axis=0)
    square = square - t * cubic  # part of the square that is not correlated with the coordinate
    square /= square.std(axis=0) + 1e-300
    strength = np.abs(square.T @ t / len(t)) * (1 - np.eye(len(linear)))
    found: list[tuple[int, int]] = []
    for flat in np.argsort(-strength, axis=None):
        i, j = (int(k) for k in np.unravel_index(flat, strength.shape))
        if not {i, j} & {k for pair in found for k in pair}:
            found.append((i, j))
    return found[:MOST_PANELS]


def _ellipse(ax: Axes, middle: np.ndarray, covariance: np.ndarray) -> None:
    turn = np.linspace(0, 2 * np.pi, 100)
    root = np.linalg.cholesky(covariance) * np.sqrt(4.605)
    x, y = middle[:, None] + root @ np.stack([np.cos(turn), np.sin(turn)])
    ax.plot(x, y, color=drawing.ORANGE, lw=1.4)


def profile_figure(found: Sequence[Profile]) -> Figure:
    """Draw a panel per profile: the rise of the loss over the value at which a parameter is fixed.

    All other parameters are fitted again at each value.
    """
    made, axes = drawing.panels(
        len(found),
        5.4,
        4.4,
        "Rise of the loss if a parameter is fixed at another value and all others are refitted",
    )
    for ax, profile in zip(axes, found, strict=True):
        _panel(ax, profile)
    axes[0].legend(fontsize=8, loc="upper center")
    axes[0].set_ylabel("minus log likelihood above its minimum")
    return made


def _panel(ax: Axes, p: Profile) -> None:
    ax.plot(p.value, p.likelihood, "o-", color=drawing.BLUE, label="data (without this prior)")
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
    head, _, rest = p.sentence.partition(": ")
    given = f"\ngiven {p.given}" if p.given else ""
    ax.set_title(f"{head}\n{rest}{given}", fontsize=10)
