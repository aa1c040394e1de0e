"""Figure of a fit to bench logs of a motor: measured and simulated signals, and residuals."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slipid.infer.bench.fit import MotorFit
from slipid.infer.bench.signals import FittedSignal, fitted_signals
from slipid.infer.bench.verdict import BenchFit
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
    """Draw each measured and simulated signal, and residuals over time, speed and current."""
    signals = fitted_signals(fit)
    count = len(signals)
    which = f"motor {fit.label}: " if fit.label else ""
    given = "voltage" if fit.has_voltage else "current"
    made = figure(
        13.0, 3.9 * count + 0.8, f"{which}measured (gray), and simulated from the {given} (blue)"
    )
    grid = made.add_gridspec(2 * count, 3, height_ratios=[2.0, 1.2] * count)
    for k, signal in enumerate(signals):
        _overlay(made.add_subplot(grid[2 * k, :]), signal)
        _residuals([made.add_subplot(grid[2 * k + 1, j]) for j in range(3)], signal)
    return made


def _overlay(axes: Axes, signal: FittedSignal) -> None:
    plain(axes)
    some = slice(None, None, max(1, len(signal.time) // MAX_POINTS))
    clock = signal.time[some]
    axes.plot(clock, signal.measured[some], color=SHADE, lw=2.2, alpha=0.6, label="measured")
    axes.plot(clock, signal.fitted[some], color=BLUE, lw=0.9, label="simulated")
    axes.set(ylabel=f"{signal.channel} [{signal.unit}]", xlabel="time [s]")
    axes.legend(loc="upper right", fontsize=8, frameon=False, ncols=2)


def _residuals(panels: list[Axes], signal: FittedSignal) -> None:
    """Draw residuals and their means in bins, over time, speed and current."""
    residual, weight = signal.residual, signal.weight + 1e-9
    used = np.arange(len(residual))
    some = used[:: max(1, len(used) // MAX_POINTS)]
    for axes, (x, label) in zip(
        panels,
        (
            (signal.time, "time [s]"),
            (signal.speed, "speed [rad/s]"),
            (signal.current, "current [A]"),
        ),
        strict=True,
    ):
        plain(axes)
        axes.plot(x[some], residual[some], ".", color=SHADE, ms=1.5, alpha=0.4)
        bins = np.array_split(used[np.argsort(x[used], kind="stable")], 24)
        means = [np.average(residual[b], weights=weight[b]) for b in bins if len(b)]
        axes.plot([np.median(x[b]) for b in bins if len(b)], means, "o-", color=ORANGE, ms=3, lw=1)
        axes.axhline(0.0, color=INK, lw=0.6)
        axes.set(ylim=(-6 * signal.scale, 6 * signal.scale), xlabel=label)
    panels[0].set_ylabel(f"residual [{signal.unit}]")
    panels[0].set_title("residuals, and their means (orange)", fontsize=9, loc="left", color=INK)
