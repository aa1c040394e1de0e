"""Figure of a fit to bench logs of a motor: measured and fitted signals, and residuals."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slipid.infer.bench.fit import MotorFit
from slipid.infer.bench.moments import Equation
from slipid.infer.bench.verdict import BenchFit
from slipid.infer.bench.windows import BenchWindows
from slipid.plots.drawing import BLUE, INK, ORANGE, SHADE, figure, plain, save

MAX_POINTS = 4000
"""Approximate largest number of points of a curve; longer signals are thinned."""


def bench_plots(fit: BenchFit, out: Path) -> list[Path]:
    """Write a figure of every motor, bench.png or bench_LABEL.png; return the files."""
    return [
        save(bench_figure(f), out / (f"bench_{f.label}.png" if f.label else "bench.png"))
        for f in fit.fits
    ]


def bench_figure(fit: MotorFit) -> Figure:
    """Draw each measured and fitted signal, and residuals over time, speed and current."""
    count = len(fit.equations)
    which = f"motor {fit.label}: " if fit.label else ""
    made = figure(
        13.0, 3.9 * count + 0.8, f"{which}measured (gray), and fitted from other signals (blue)"
    )
    grid = made.add_gridspec(2 * count, 3, height_ratios=[2.0, 1.2] * count)
    for k, equation in enumerate(fit.equations):
        _signals(made.add_subplot(grid[2 * k, :]), equation)
        _residuals([made.add_subplot(grid[2 * k + 1, j]) for j in range(3)], equation)
    return made


def _times(w: BenchWindows) -> np.ndarray:
    """Return the times of windows, with records placed one after the other on a time axis [s]."""
    ends = [float(w.time[w.record == k].max(initial=0.0)) for k in range(int(w.record.max()) + 1)]
    return np.asarray(w.time + np.concatenate([[0.0], np.cumsum(ends)])[w.record])


def _signals(axes: Axes, equation: Equation) -> None:
    plain(axes)
    w = equation.windows
    clock, measured = _times(w), w.measured.mean(axis=0)
    fitted = np.where(w.usable, measured - equation.residual.mean(axis=0), np.nan)
    some = slice(None, None, max(1, len(clock) // MAX_POINTS))
    axes.plot(clock[some], measured[some], color=SHADE, lw=2.2, alpha=0.6, label="measured")
    axes.plot(clock[some], fitted[some], color=BLUE, lw=0.9, label="fitted")
    axes.set(ylabel=f"{equation.channel} [{equation.unit}]", xlabel="time [s]")
    axes.legend(loc="upper right", fontsize=8, frameon=False, ncols=2)


def _residuals(panels: list[Axes], equation: Equation) -> None:
    """Draw residuals and their means in bins, over time, speed and current."""
    w = equation.windows
    speed, current, residual = (x.mean(axis=0) for x in (w.speed, w.current, equation.residual))
    weight = equation.weight.sum(axis=0) + 1e-9
    used = np.flatnonzero(w.usable)
    some = used[:: max(1, len(used) // MAX_POINTS)]
    for axes, (x, label) in zip(
        panels,
        ((_times(w), "time [s]"), (speed, "speed [rad/s]"), (current, "current [A]")),
        strict=True,
    ):
        plain(axes)
        axes.plot(x[some], residual[some], ".", color=SHADE, ms=1.5, alpha=0.4)
        bins = np.array_split(used[np.argsort(x[used], kind="stable")], 24)
        means = [np.average(residual[b], weights=weight[b]) for b in bins if len(b)]
        axes.plot([np.median(x[b]) for b in bins if len(b)], means, "o-", color=ORANGE, ms=3, lw=1)
        axes.axhline(0.0, color=INK, lw=0.6)
        axes.set(ylim=(-6 * equation.scale, 6 * equation.scale), xlabel=label)
    panels[0].set_ylabel(f"residual [{equation.unit}]")
    panels[0].set_title("residuals, and their means (orange)", fontsize=9, loc="left", color=INK)
