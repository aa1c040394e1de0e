"""Figures of motion: slip and drift over heading, and predicted and measured paths."""

from collections.abc import Callable, Mapping, Sequence
from textwrap import fill
from types import MappingProxyType
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slipid.data.runs import Runs
from slipid.data.windows import Windows
from slipid.infer.measured_windows import MeasuredWindows, by_heading
from slipid.model.geometry import Geometry
from slipid.model.robot import Robot
from slipid.plots import drawing
from slipid.predict import open_loop as replay
from slipid.predict.kinematics import Encoder
from slipid.predict.slip_models import FloorModels

ROWS = (
    ("slip", "slip: path length lost [%]"),
    ("drift", "sideways drift [deg]\n(left positive)"),
    ("yaw", "yaw drift [deg per m]\n(counter-clockwise positive)"),
)
MOST_SPEEDS = 4
"""Largest number of speeds that are drawn."""
STRAIGHT_RUNS, OTHER_RUNS = 16, 3
"""Largest numbers of runs in a panel of paths: if all runs are straight, and otherwise."""
TITLE_WIDTH = 42
"""Largest number of characters in a line of a panel's title."""
LEAST_OCTANTS = 5
"""Smallest number of octants of headings with straight segments for a panel over heading."""


def heading_figure(robot: Robot, measured: MeasuredWindows) -> Figure | None:
    """Draw slip and drift over the direction of travel, a column per floor and load set-up.

    Returns:
        None if no floor has straight segments in most directions.
    """
    octant = (measured.heading // 45.0).astype(int)
    driven = (
        octant[measured.straight & (measured.group == g)] for g in range(len(measured.groups))
    )
    columns = [g for g, found in enumerate(driven) if len(np.unique(found)) >= LEAST_OCTANTS]
    if not columns:
        return None
    made = drawing.figure(
        1.4 + 3.1 * max(len(columns), 2),
        8.2,
        "Slip and unwanted rotation over the direction of travel\n"
        "dots: camera relative to encoders; lines: predicted by the force balance",
    )
    axes = made.subplots(3, len(columns), sharex=True, sharey="row", squeeze=False)
    speeds = _speeds(measured)
    for column, g in enumerate(columns):
        _headings(robot, measured, g, speeds, list(axes[:, column]))
    for row, (_, label) in enumerate(ROWS):
        axes[row, 0].set_ylabel(label)
    handles = [
        axes[0, 0].plot([], [], color=c, marker=m, ms=4, label=f"{v:g} m/s")[0]
        for v, (c, m) in zip(speeds, drawing.STYLES, strict=False)
    ]
    made.legend(handles=handles, loc="outside right upper", frameon=False, title="speed")
    return made


def _speeds(measured: MeasuredWindows) -> list[float]:
    """Return the most frequent speeds that differ by more than a tenth, at most `MOST_SPEEDS`."""
    found: list[float] = []
    values, counts = np.unique(measured.speed[measured.straight], return_counts=True)
    for v in values[np.argsort(-counts)]:
        if v > 0 and all(abs(v - u) > 0.1 * max(u, v) + 0.005 for u in found):
            found.append(float(v))
    return sorted(found[:MOST_SPEEDS])


def _headings(
    robot: Robot, measured: MeasuredWindows, g: int, speeds: list[float], axes: Sequence[Axes]
) -> None:
    surface, load = measured.groups[g]
    mine = measured.straight & (measured.group == g)
    nearest = np.argmin(np.abs(measured.speed[:, None] - np.asarray(speeds)), axis=1)
    heading = np.linspace(0.0, 360.0, 181)
    for k, (colour, marker) in enumerate(drawing.STYLES[: len(speeds)]):
        picked = mine & (nearest == k)
        if not picked.any():
            continue
        lines = by_heading(robot, surface, load, speeds[k], heading)
        for row, values in enumerate((100 * measured.slip, measured.drift, measured.yaw)):
            x, y, ax = measured.heading[picked], values[picked], axes[row]
            ax.plot(x, y, marker, ms=3.6, color=colour, alpha=0.5, mew=0)
            ax.plot(heading, lines[:, row] * (100.0 if row == 0 else 1.0), color=colour, lw=1.6)
    for ax in axes:
        drawing.plain(ax)
        ax.axhline(0.0, color=drawing.INK, lw=0.8)
    axes[0].set_title(named(surface, load, measured.groups))
    axes[-1].set(xlabel="direction of travel [deg]\n(0 ahead, 90 left)", xticks=range(0, 361, 90))


def named(surface: str, load: str, groups: Sequence[tuple[str, str]]) -> str:
    """Return the title of a panel: the surface, and the load set-up if `groups` has several."""
    several = len({other for _, other in groups}) > 1
    return f"{surface}, load {load}" if several else surface


def runs_by_setup(data: Runs) -> dict[tuple[str, str], list[int]]:
    """Return the indices of the runs of each (floor, load set-up)."""
    groups: dict[tuple[str, str], list[int]] = {}
    for k, log in enumerate(data.logs):
        groups.setdefault((data.surface[k], log.load), []).append(k)
    return groups


def path_figure(
    robot: Robot,
    predict: Callable[[Windows], replay.Tracks],
    data: Runs,
    order: Sequence[tuple[str, str]],
    title: str,
    shape: Geometry,
    errors: Mapping[str, str] = MappingProxyType({}),
) -> Figure:
    """Draw measured and predicted paths of some runs, one panel per floor and load set-up.

    All paths start at the origin with the robot facing right.

    Args:
        robot: fitted robot.
        predict: function that predicts the paths of windows.
        data: the runs.
        order: (floor, load set-up) of the panels in order.
        title: title of the figure, which names the set of runs.
        shape: geometry with the lengths of the config, by which the encoders' paths are drawn.
        errors: text about prediction errors under a panel's name, keyed by floor; by default the
            mean end-point errors of the drawn floor's runs.
    """
    groups = runs_by_setup(data)
    names = [name for name in order if name in groups]
    paths = _paths(robot, predict, data, shape)
    made, axes = drawing.panels(len(names), 3.7, 4.3, title)
    for ax, (surface, load) in zip(axes, names, strict=True):
        runs = groups[surface, load]
        shown = [paths[k] for k in _spread(data, runs)]
        for run in shown:
            _ray(ax, run)
        text = errors.get(surface) or _errors([paths[k] for k in runs])
        ax.set_title(f"{named(surface, load, names)}\n{fill(text, TITLE_WIDTH)}", fontsize=10)
        reach = 1.08 * max(float(np.abs(p).max()) for run in shown for p in run)
        ax.set_aspect("equal")
        ax.set(xlim=(-reach, reach), xlabel="ahead of the start [m]")
        ax.set(ylim=(-reach, reach), ylabel="left of the start [m]")
    handles = [
        axes[0].plot([], [], color=drawing.INK, lw=3.2, alpha=0.35, label="camera")[0],
        axes[0].plot([], [], color=drawing.BLUE, lw=1.4, marker="o", ms=4, label="predicted")[0],
        axes[0].plot(
            [], [], ":", color=drawing.ORANGE, lw=1.2, label="encoders, lengths of the config"
        )[0],
    ]
    made.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return made


def _spread(data: Runs, runs: list[int]) -> list[int]:
    """Return the indices of some of the runs.

    If all runs have headings, the chosen runs have the most frequent speed and are evenly spread
    over headings.
    """
    heading, speed, most = data.heading[runs], data.speed[runs], OTHER_RUNS
    if np.isfinite(heading).all():
        values, counts = np.unique(np.round(speed, 3), return_counts=True)
        runs = [
            k for k, v in zip(runs, speed, strict=True) if abs(v - values[counts.argmax()]) < 1e-3
        ]
        most = STRAIGHT_RUNS
        runs.sort(key=lambda k: float(data.heading[k] % (2 * np.pi)))
    at = np.unique(np.linspace(0, len(runs), min(most, len(runs)), endpoint=False).astype(int))
    return [runs[k] for k in at]


class _Paths(NamedTuple):
    """Paths (edge, 2) of a run that start at the origin, with the robot facing along x [m]."""

    measured: np.ndarray
    predicted: np.ndarray
    encoder: np.ndarray


def _paths(
    robot: Robot, predict: Callable[[Windows], replay.Tracks], data: Runs, shape: Geometry
) -> dict[int, _Paths]:
    """Return the paths of every run, keyed by the run's index."""
    out: dict[int, _Paths] = {}
    for w in replay.replay_windows(data, robot):
        tracks = predict(w)
        encoder = replay.tracks_from_increments(
            robot, w, FloorModels(Encoder(shape=shape)).increments(w, robot)
        )
        for n, k in enumerate(tracks.run):
            yaw = float(robot.camera.yaw(jnp.asarray(robot.session_index(w.session[n]))))
            first = tracks.measured[n, 0]
            c, s = np.cos(first[2] - yaw), np.sin(first[2] - yaw)
            back = np.array([[c, s], [-s, c]])
            every = (tracks.measured, tracks.predicted, encoder.predicted)
            out[int(k)] = _Paths(*((p[n, :, :2] - first[:2]) @ back.T for p in every))
    return out


def _errors(paths: Sequence[_Paths]) -> str:
    """Return a text with mean end-point errors over the path length, of model and encoders."""
    ends = np.array([[p[-1] for p in run] for run in paths])
    path = [np.linalg.norm(np.diff(run.measured, axis=0), axis=1).sum() for run in paths]
    error = np.linalg.norm(ends[:, 1:] - ends[:, :1], axis=2) / np.maximum(path, 1e-9)[:, None]
    model, encoder = 100 * error.mean(axis=0)
    count = f"{len(paths)} runs" if len(paths) > 1 else "1 run"
    return f"{count}: off by {model:.1f} % of the path (encoders {encoder:.1f} %)"


def _ray(ax: Axes, paths: _Paths) -> None:
    ax.plot(*paths.encoder.T, ":", color=drawing.ORANGE, lw=1.0)
    ax.plot(*paths.measured.T, color=drawing.INK, lw=3.2, alpha=0.35, solid_capstyle="round")
    ax.plot(*paths.predicted.T, color=drawing.BLUE, lw=1.2)
    ax.plot(*paths.predicted[-1], "o", color=drawing.BLUE, ms=3.5)
