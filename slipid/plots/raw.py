"""Raw signals of a data set as pictures, one per floor and load: look before you fit."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from slipid.data.runs import Runs
from slipid.plots.drawing import figure, save


def raw_plots(data: Runs, out: Path) -> list[Path]:
    """`plot_runs` of each floor and load set-up; PNG files."""
    groups: dict[tuple[str, str], list[int]] = {}
    for k, log in enumerate(data.logs):
        groups.setdefault((log.surface or "unknown", log.load), []).append(k)
    return [
        save(plot_runs(data, runs, f"{floor}, {load}"), out / f"raw_{floor}_{load}.png")
        for (floor, load), runs in sorted(groups.items())
    ]


def plot_runs(data: Runs, runs: Sequence[int] | None = None, title: str = "as logged") -> Figure:
    """Paths, wheel speeds and currents of runs, all on one another.

    Args:
        runs: numbers of those that are shown; all by default.
    """
    runs = range(len(data)) if runs is None else runs
    wheels = data.wheel_angle.shape[1]
    made = figure(12.0, 7.0, f"{title}: {len(runs)} runs")
    axes = made.subplots(2, 1 + wheels, squeeze=False)
    for axis in axes[:, 0]:
        axis.remove()
    place = made.add_subplot(2, 1 + wheels, (1, 2 + wheels))
    for k in runs:
        rows = data.rows(k)
        t = data.time[rows] - data.time[rows][0]
        pose = data.pose[rows]
        place.plot(pose[:, 0] - pose[0, 0], pose[:, 1] - pose[0, 1], lw=0.6, color="C0", alpha=0.6)
        speed = np.gradient(data.wheel_angle[rows], t, axis=0)
        for w in range(wheels):
            axes[0, 1 + w].plot(t, speed[:, w], lw=0.3, color="C0", alpha=0.3)
            if data.current is not None:
                axes[1, 1 + w].plot(t, data.current[rows][:, w], lw=0.3, color="C1", alpha=0.3)
    place.set(xlabel="x from the start [m]", ylabel="y [m]", title="paths as logged")
    place.set_aspect("equal", adjustable="datalim")
    for w in range(wheels):
        axes[0, 1 + w].set(title=f"wheel {w + 1}", ylabel="speed [rad/s]" if w == 0 else "")
        axes[1, 1 + w].set(xlabel="time [s]", ylabel="current [A]" if w == 0 else "")
    return made
