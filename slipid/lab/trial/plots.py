"""Figure of a trial: the paths of every controller over the floor, and their errors."""

from pathlib import Path
from textwrap import wrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from slipid.data.floor_map import FloorMap
from slipid.lab.trial.trial import TrialResult
from slipid.plots.drawing import INK, ORANGE, SERIES, SHADE, figure, plain, save
from slipid.support.content import Content

SURFACE_COLOURS = ("#f7f7f4", "#dcdcd6", "#bdbdb4", "#a3a399", "#8c8c82", "#77776d")
"""Colours of surfaces, in the order of the map's surfaces."""
FAINT = SERIES[4]
"""Colour of the paths from all starts but the highlighted one, which is orange."""
ERRORS = {
    "closure_error_median": "closure error [mm]",
    "cross_track_rmse": "cross-track rms [mm]",
    "first_side_along_track_mm": "first side or quarter, along-track [mm]",
}


def trial_plot(trial: TrialResult, path: Path) -> Path:
    """Write a figure of a trial to a file and return the file.

    For every controller it shows the paths from all starts, moved to a common start pose, and
    highlights the run from a typical start over the map; bars show medians of errors.
    """
    content = trial.content
    names = list(content["summary"])
    rows = -(-len(names) // 3)
    path_name = f"{content['path'].capitalize()} at {content['speed_m_s']:g} m/s"
    title = f"{path_name} on the {content['plant']}: {_verdict(content)}"
    drawing = figure(13.0, 3.1 * rows + 3.4, title)
    grid = drawing.add_gridspec(rows + 1, 3, height_ratios=[1.0] * rows + [1.1])
    one = _typical_start(content)
    for k, name in enumerate(names):
        axes = drawing.add_subplot(grid[k // 3, k % 3])
        _paths_panel(axes, name, trial, one)
    _legend(drawing, trial.floor)
    for k, (key, label) in enumerate(ERRORS.items()):
        _bars(drawing.add_subplot(grid[rows, k]), content["summary"], key, label)
    return save(drawing, path)


def _verdict(content: Content) -> str:
    """Return the part of the title that names the best controller, or those that do not differ."""
    best = content["closes_best"]
    if best is None:
        return f"{', '.join(content['not_told_apart'])} do not differ significantly"
    ratio = content["summary"][best].get("to_encoder", {}).get("closure_error_median", {})
    return f"{best} closes best" + (f", {100 * ratio['value']:.0f} % of encoders'" if ratio else "")


def _typical_start(content: Content) -> int:
    """Return the index of the start whose closure error is nearest to the median.

    The runs compared are those of the controller `encoder` or, without it, of the first one.
    """
    first = "encoder" if "encoder" in content["summary"] else next(iter(content["summary"]))
    runs = [r for r in content["runs"] if r["controller"] == first]
    middle = content["summary"][first]["closure_error_median"]
    return int(np.argmin([abs(r["closure_mm"] - middle) for r in runs]))


def _paths_panel(axes: Axes, name: str, trial: TrialResult, one: int) -> None:
    """Draw the paths of a controller from all starts, in the axes of their start poses.

    The path from start `one` is highlighted, over the floor as seen from that start.
    """
    runs = [r for r in trial.content["runs"] if r["controller"] == name]
    wanted, floor = trial.wanted[name], trial.floor
    own = [
        (trial.paths[f"{name}/start{k:02d}"][:, :2] - r["start"][:2]) @ _rotation(r["start"][2])
        for k, r in enumerate(runs)
    ]
    (left, low), (right, high) = wanted.min(axis=0) - 0.35, wanted.max(axis=0) + 0.35
    x, y = np.linspace(left, right, 320), np.linspace(low, high, 220)
    start = runs[one]["start"]
    places = start[:2] + np.stack(np.meshgrid(x, y), -1) @ _rotation(start[2]).T
    kinds = max(len(floor.surfaces), 2)
    tints = ListedColormap(SURFACE_COLOURS[:kinds])
    axes.pcolormesh(x, y, floor.at(places), cmap=tints, vmin=0, vmax=kinds - 1)
    for p in own:
        axes.plot(*p.T, color=FAINT, lw=0.5, alpha=0.6)
    axes.plot(*wanted.T, "--", color=INK, lw=1.0)
    axes.plot(*own[one].T, color=ORANGE, lw=1.8)
    axes.plot(*own[one][-1], "o", color=ORANGE, ms=5)
    row = trial.content["summary"][name]
    closes, off = row["closure_error_median"], row["heading_error_deg"]
    done = f"{100 * row['finished_share']:.0f} % finish"
    title = f"{name}: {closes:.0f} mm, {off:.0f} deg off, {done}"
    about = "\n".join(wrap(trial.content["controllers"][name], 44))
    axes.set_title(f"{title}\n{about}", fontsize=8, loc="left")
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), aspect="equal")
    axes.tick_params(labelsize=7)


def _legend(drawing: Figure, floor: FloorMap) -> None:
    """Add the legend of floor tints and lines."""
    patches = [
        Patch(facecolor=tint, edgecolor=SHADE, label=name)
        for name, tint in zip(floor.surfaces, SURFACE_COLOURS, strict=False)
    ]
    typical = "typical start of `encoder`"
    lines = [
        Line2D([], [], color=INK, ls="--", lw=1.0, label="wanted"),
        Line2D([], [], color=FAINT, lw=1.0, label="every start"),
        Line2D([], [], color=ORANGE, lw=1.8, marker="o", ms=5, label=typical),
    ]
    drawing.legend(handles=[*patches, *lines], loc="outside lower center", ncols=8, fontsize=8)


def _rotation(heading: float) -> np.ndarray:
    """Return the rotation matrix from body axes at a heading [rad] to world axes."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s], [s, c]])


def _bars(axes: Axes, table: Content, key: str, label: str) -> None:
    """Draw a bar with its 90 % interval for the median error `key` of each controller."""
    names = list(table)
    value = np.array([table[n][key] for n in names])
    low, high = np.array([table[n]["interval90"][key] or [np.nan] * 2 for n in names]).T
    at = np.arange(len(names))[::-1]
    axes.barh(at, value, color="#9bb8cf", height=0.7)
    axes.hlines(at, low, high, color=INK, lw=1.2)
    axes.set_yticks(at, names, fontsize=8)
    intervals = ", 90 % interval" if np.isfinite(low).any() else ""
    axes.set_xlabel(f"{label}\nmedian of {table[names[0]]['runs']} starts{intervals}", fontsize=8)
    axes.tick_params(axis="x", labelsize=8, color=SHADE)
    plain(axes)
