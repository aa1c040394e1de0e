"""Figures of logs before a fit, and of the results of a fit and of a validation."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrow, Polygon

from slipid.data.runs import Runs
from slipid.infer.measured_windows import MeasuredWindows, measured_windows
from slipid.infer.result import Fit
from slipid.infer.verdicts.estimates import Estimate
from slipid.plots import drawing
from slipid.plots.drawing import add_warning, figure, save, save_all
from slipid.plots.motion import heading_figure, path_figure, runs_by_setup
from slipid.plots.wheels import current_figure, curve_figure
from slipid.predict.validation import Validation
from slipid.support.progress import Tell, silent


def raw_plots(data: Runs, out: Path) -> list[Path]:
    """Write a figure of the logged signals for each floor and load set-up; return the files."""
    return [
        save(plot_runs(data, runs, f"{floor}, {load}"), out / f"raw_{floor}_{load}.png")
        for (floor, load), runs in sorted(runs_by_setup(data).items())
    ]


def plot_runs(data: Runs, runs: Sequence[int] | None = None, title: str = "as logged") -> Figure:
    """Draw paths, wheel speeds and currents of all runs in the same axes.

    Args:
        data: all runs.
        runs: indices of the runs that are drawn; None for all.
        title: beginning of the figure's title.
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


def load_figure(fit: Fit) -> Figure | None:
    """Draw the fraction of the weight on each wheel, one panel per load set-up.

    Returns:
        None if the load shares of all load set-ups are fixed.
    """
    loads = fit.robot.body.loads
    found = [fit.parameters[f"robot.load_share@{load}"] for load in loads]
    if all(e.interval90 is None for e in found):
        return None
    made, axes = drawing.panels(
        len(loads), 5.2, 4.7, "Share of the weight on each wheel, seen from above (90 % interval)"
    )
    for ax, load, estimate in zip(axes, loads, found, strict=True):
        _robot(ax, fit, estimate)
        ax.set_title(f"load {load}")
    return made


def _robot(ax: Axes, fit: Fit, estimate: Estimate) -> None:
    """Draw the robot from above with the load share of each wheel; x is up and y to the left."""
    shape = fit.robot.geometry
    base, radius = float(shape.base_radius), float(shape.wheel_radius)
    place = np.asarray(shape.place) * base
    reach = float(np.linalg.norm(place, axis=1).max())
    ax.add_patch(Circle((0, 0), reach * 0.93, fc="#f2f2f2", ec=drawing.SHADE, lw=1.2))
    start, length, wide = 0.42 * reach, 0.25 * reach, 0.02 * reach
    ax.add_patch(FancyArrow(0, start, 0, length, width=wide, fc=drawing.SHADE, ec="none"))
    ax.text(0.06 * reach, 0.5 * reach, "ahead", color=drawing.INK, fontsize=9)
    share = np.asarray(estimate.value, float)
    angles = np.asarray(shape.drive_angle)
    for k, (p, angle) in enumerate(zip(place, angles, strict=True)):
        along = np.array([np.cos(angle), np.sin(angle)])
        side = np.array([-along[1], along[0]]) * 0.35 * radius
        ends = (radius * along + side, radius * along - side)
        corners = [_xy(p + corner) for corner in (*ends, -ends[0], -ends[1])]
        size = reach * 0.62 * np.sqrt(share[k])
        ax.add_patch(Circle(_xy(p), size, fc=drawing.BLUE, alpha=0.25, ec="none"))
        ax.add_patch(Polygon(corners, fc=drawing.INK, ec="none"))
        ax.text(*_xy(p * [1.75, 1.95]), _label(k, estimate), ha="center", va="center", fontsize=10)
    ax.plot(*_xy(share @ place), "X", color=drawing.ORANGE, ms=11, mec="white")
    ahead, left = 1000 * (share @ place)
    where = f"{abs(ahead):.0f} mm {'ahead of' if ahead > 0 else 'behind'} the middle"
    if abs(left) >= 0.5:
        where += f" and {abs(left):.0f} mm to the {'left' if left > 0 else 'right'}"
    text = f"cross: centre of weight, {where}"
    ax.text(0, -2.3 * reach, text, ha="center", fontsize=9, color=drawing.ORANGE)
    ax.set(xlim=(-2.2 * reach, 2.2 * reach), ylim=(-2.4 * reach, 1.6 * reach), aspect="equal")
    ax.grid(False)
    ax.axis("off")


def _xy(p: np.ndarray | Sequence[float]) -> tuple[float, float]:
    """Return the position on the page of a body position (x, y); x is up and y to the left."""
    return -float(p[1]), float(p[0])


def _label(k: int, estimate: Estimate) -> str:
    text = f"wheel {k + 1}\n{100 * estimate.value[k]:.1f} %"
    if estimate.interval90 is not None:
        low, high = estimate.interval90[k]
        text += f"\n({100 * low:.1f} to {100 * high:.1f})"
    return text


PATHS = "Paths by the encoders (dotted), by the fitted robot (blue)\nand by the camera (gray): "


FIGURES: dict[str, Callable[[Fit, Runs, MeasuredWindows], Figure | None]] = {
    "slip_by_heading": lambda fit, data, measured: heading_figure(fit.robot, measured),
    "paths": lambda fit, data, measured: path_figure(
        fit.robot,
        fit.tracks,
        data,
        measured.groups,
        PATHS + "runs of the fit, predicted by the model selected on each floor",
        fit.config_shape,
        {floor: one.sentence for floor, one in fit.selection.items()},
    ),
    "slip_by_torque": lambda fit, data, measured: curve_figure(fit, measured),
    "current_by_traction": lambda fit, data, measured: current_figure(measured),
    "load_share": lambda fit, data, measured: load_figure(fit),
}
"""Functions that draw the figures of a fit, keyed by name; they return None if data are missing."""


def identify_plots(
    fit: Fit, data: Runs, out: Path, warning: str | None = None, tell: Tell = silent
) -> list[Path]:
    """Write all `FIGURES` that the runs of the fit have data for; return the files.

    If the fit cannot be trusted, `warning` is added to the title of each figure. `tell` reports the
    progress.
    """
    measured = measured_windows(fit.robot, data, fit.channels.windows)
    made: dict[str, Figure | None] = {}
    for count, (name, draw) in enumerate(FIGURES.items(), start=1):
        made[name] = draw(fit, data, measured)
        tell(count, len(FIGURES))
    if warning is not None:
        for figure in filter(None, made.values()):
            add_warning(figure, warning)
    return save_all(made, out)


def picture(fit: Fit, data: Runs, name: str) -> Figure:
    """Return the figure with this name.

    Raises:
        ValueError: there is no such figure, or the runs lack the data for it.
    """
    if name not in FIGURES:
        raise ValueError(f"no figure '{name}'; expected one of {', '.join(FIGURES)}")
    made = FIGURES[name](fit, data, measured_windows(fit.robot, data, fit.channels.windows))
    if made is None:
        raise ValueError(
            f"figure '{name}': the runs lack the data for it; expected currents, fitted load "
            "shares, or straight runs in most directions, as the figure needs"
        )
    return made


def validate_plots(fit: Fit, data: Runs, found: Validation, out: Path) -> list[Path]:
    """Write figures of a validation's errors and of some predicted paths; return the files."""
    names = dict.fromkeys(data.surface)
    order = [(floor, load) for floor in sorted(names) for load in fit.robot.body.loads]
    figures = {
        "validation_errors": found.plot(),
        "validation_paths": path_figure(
            fit.robot, fit.tracks, data, order, PATHS + found.which, fit.config_shape
        ),
    }
    return save_all(figures, out)
