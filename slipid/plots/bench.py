"""A motor on a bench as a picture: measured against fitted values, and the residuals."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slipid.infer.bench.fit import MotorFit
from slipid.infer.bench.moments import MomentSums
from slipid.infer.bench.verdict import BenchFit
from slipid.infer.bench.windows import BenchWindows
from slipid.plots.drawing import BLUE, INK, ORANGE, SHADE, figure, plain, save

MOST = 4000
"""Points of a curve."""


def bench_plots(fit: BenchFit, out: Path) -> list[Path]:
    """A picture of every motor: files bench.png, or bench_LABEL.png."""
    return [
        save(bench_figure(f), out / (f"bench_{f.label}.png" if f.label else "bench.png"))
        for f in fit.fits
    ]


def bench_figure(fit: MotorFit) -> Figure:
    """Voltage and current, measured and fitted; residuals over time, speed and current."""
    pairs = [("current", "A", fit.amps, fit.amps_sums)]
    if fit.volts is not None and fit.volts_sums is not None:
        pairs.insert(0, ("voltage", "V", fit.volts, fit.volts_sums))
    which = f"motor {fit.label}: " if fit.label else ""
    made = figure(
        13.0,
        3.9 * len(pairs) + 0.8,
        f"{which}measured (gray) and what the fit makes of the rest (blue)",
    )
    grid = made.add_gridspec(2 * len(pairs), 3, height_ratios=[2.0, 1.2] * len(pairs))
    for k, (name, unit, w, s) in enumerate(pairs):
        top = made.add_subplot(grid[2 * k, :])
        below = [made.add_subplot(grid[2 * k + 1, j]) for j in range(3)]
        _signals(top, name, unit, w, s)
        _residuals(below, unit, w, s)
    return made


def _clock(w: BenchWindows) -> np.ndarray:
    """Time with the records one after the other [s]."""
    ends = [float(w.time[w.record == k].max(initial=0.0)) for k in range(int(w.record.max()) + 1)]
    return np.asarray(w.time + np.concatenate([[0.0], np.cumsum(ends)])[w.record])


def _signals(axes: Axes, name: str, unit: str, w: BenchWindows, s: MomentSums) -> None:
    plain(axes)
    clock, left = _clock(w), w.both.left
    fitted = left - (s.even.residual + s.odd.residual) / 2
    some = slice(None, None, max(1, len(clock) // MOST))
    used = np.where(w.usable, fitted, np.nan)
    axes.plot(clock[some], left[some], color=SHADE, lw=2.2, alpha=0.6, label="measured")
    axes.plot(clock[some], used[some], color=BLUE, lw=0.9, label="fitted")
    axes.set(ylabel=f"{name} [{unit}]", xlabel="time [s]")
    axes.legend(loc="upper right", fontsize=8, frameon=False, ncols=2)


def _residuals(panels: list[Axes], unit: str, w: BenchWindows, s: MomentSums) -> None:
    """What is left, point by point, and its mean in bins."""
    clock, both = _clock(w), w.both
    good = np.flatnonzero(w.usable)
    left = (s.even.residual + s.odd.residual) / 2
    limit = 6 * s.scale
    for axes, (x, what) in zip(
        panels,
        ((clock, "time [s]"), (both.speed, "speed [rad/s]"), (both.current, "current [A]")),
        strict=True,
    ):
        plain(axes)
        some = good[:: max(1, len(good) // MOST)]
        axes.plot(x[some], left[some], ".", color=SHADE, ms=1.5, alpha=0.4)
        bins = np.array_split(good[np.argsort(x[good], kind="stable")], 24)
        weight = s.even.weight + s.odd.weight
        means = [np.average(left[b], weights=weight[b] + 1e-9) for b in bins if len(b)]
        axes.plot([np.median(x[b]) for b in bins if len(b)], means, "o-", color=ORANGE, ms=3, lw=1)
        axes.axhline(0.0, color=INK, lw=0.6)
        axes.set(ylim=(-limit, limit), xlabel=what)
    panels[0].set_ylabel(f"left [{unit}]")
    panels[0].set_title("what is left, and its mean (orange)", fontsize=9, loc="left", color=INK)
