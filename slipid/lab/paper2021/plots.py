"""Reproduction of the 2021 paper: its results as JSON, and its figures 2, 3, 4 and 7."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slipid.data.log import Log
from slipid.data.reading.reader import read_runs
from slipid.lab.paper2021.result import COMMANDED_SIDES, SquareTrack, find_folder, regenerate
from slipid.lab.paper2021.table import FittedForm, MotorTable, deployed_slip
from slipid.plots import drawing
from slipid.support.files import write_json

_SURFACE = {"gray": ("#666666", "o"), "blue": (drawing.BLUE, "^"), "red": (drawing.ORANGE, "s")}
_PAPER, _OURS, _THIRD = drawing.PURPLE, drawing.INK, drawing.GREEN
_TRACK = {"encoders": drawing.ORANGE, "slip_model": "#E69F00", "compensation": drawing.BLUE}
_AXIS = {"current": "motor current I / A", "torque": "torque variable M at the motor shaft / N m"}


def run(data_dir: Path, out: Path) -> list[Path]:
    """Reproduce the paper: write `paper.json` and one PNG per figure, and return the files.

    Args:
        data_dir: folder that holds robotino2021 (and robotino2022), or robotino2021 itself.
        out: folder to write to; made if absent.

    Raises:
        DataError: if the 2021 data set is absent or broken.
    """
    folder = find_folder(data_dir)
    result = regenerate(folder, runs_2022(folder.parent / "robotino2022"))
    report = out / "paper.json"
    write_json(report, result.as_dict())
    figures = {
        "figure2_slip_current_whole_field": figure2(result.field),
        "figure3_slip_current_torque_by_surface": figure3(result.motors),
        "figure4_slip_torque_models": figure4(result.motors[1]),
        "figure7_tracks": figure7(result.tracks),
    }
    return [report, *drawing.save_all(figures, out)]


def runs_2022(folder: Path) -> tuple[Log, ...] | None:
    """Return the 2022 runs, each on one surface; None if the folder contains none."""
    pattern = "one_surface/*/*.csv"
    return read_runs(folder, pattern, "robotino2022").logs if any(folder.glob(pattern)) else None


def figure2(field: MotorTable) -> Figure:
    """Return figure 2: slip over current of motor 1 on the whole site, with both fitted lines."""
    points = field.samples
    made = drawing.figure(
        7.2, 4.8, f"Figure 2: whole site, motor 1, {len(points)} half-second means"
    )
    axes = made.subplots()
    axes.plot(points.current, points.slip, ".", color="#56B4E9", ms=3.5, alpha=0.55, zorder=1)
    _medians(axes, points.current, points.slip, drawing.BLUE, "o", "median of 0.15 A bins", 0.15)
    _model(axes, field.stored, "paper's SVR", _PAPER, "-", 1.55)
    _model(axes, field.forms["affine in I"], "least squares", _OURS, "--", 1.55)
    _slip_axes(axes, "current", 2.0)
    axes.legend(loc="lower right", fontsize=9, framealpha=0.95)
    return made


def figure3(motors: dict[int, MotorTable]) -> Figure:
    """Return figure 3: slip over current and over torque, by surface, one column per motor."""
    made = drawing.figure(
        11.5,
        7.0,
        "Figure 3: slip of each wheel on three surfaces. Lines join medians of bins;\n"
        "samples outside 0 < s ≤ 1 are dropped, as in the paper",
    )
    panels = made.subplots(2, len(motors), squeeze=False)
    limits = {"current": 2.1, "torque": 0.5}
    for row, what in enumerate(limits):
        for column, (motor, table) in enumerate(motors.items()):
            axes = panels[row, column]
            for surface, part in table.by_surface.items():
                colour, marker = _SURFACE[surface]
                x = getattr(part, what)
                axes.plot(x, part.slip, marker, color=colour, ms=2, alpha=0.25, mec="none")
                label = f"{surface} ({len(part)})"
                _medians(axes, x, part.slip, colour, marker, label, limits[what] / 14)
            if what == "current":
                _deployed(axes, motor)
                axes.set_title(f"motor {motor}", fontsize=11)
            _slip_axes(axes, what, limits[what])
            if column:
                axes.set_ylabel("")
            axes.legend(loc="lower right", fontsize=8, framealpha=0.95)
    return made


def figure4(table: MotorTable) -> Figure:
    """Return figure 4: slip of motor 1 over the torque variable, with its fitted models."""
    made = drawing.figure(7.2, 4.8, f"Figure 4: motor 1, {len(table.samples)} half-second means")
    axes = made.subplots()
    for surface, part in table.by_surface.items():
        colour, marker = _SURFACE[surface]
        axes.plot(part.torque, part.slip, marker, color=colour, ms=2.5, alpha=0.35, mec="none")
        axes.plot([], [], marker, color=colour, ms=5, label=f"{surface} ({len(part)})")
    _model(axes, table.forms["linear in M"], "paper's linear model", _THIRD, "-.", 0.5)
    _model(axes, table.stored, "paper's quadratic SVR", _PAPER, "-", 0.5)
    _model(axes, table.forms["quadratic in M"], "least squares", _OURS, "--", 0.5)
    _slip_axes(axes, "torque", 0.5)
    axes.legend(loc="lower right", fontsize=8, framealpha=0.95)
    return made


def figure7(tracks: tuple[SquareTrack, ...]) -> Figure:
    """Return figure 7: camera tracks on the commanded rectangle, headings and closure errors."""
    made = drawing.figure(
        12.0, 5.7, "Figure 7: the same commanded rectangle, followed with three controllers"
    )
    panels = list(made.subplots(1, len(tracks), squeeze=False)[0])
    for axes, track in zip(panels, tracks, strict=True):
        _draw_track(axes, track)
    for axes in panels[1:]:
        axes.set_ylabel("")
    made.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    return made


def _draw_track(axes: Axes, track: SquareTrack) -> None:
    colour = _TRACK[track.file.name]
    xy = _floor(track)
    long, short = COMMANDED_SIDES
    rectangle = np.array([[0, 0], [0, long], [short, long], [short, 0], [0, 0]])
    axes.plot(*rectangle.T, ":", color="#888888", lw=1.5, label="commanded")
    axes.plot(*xy.T, color=colour, lw=2)
    side = xy[: track.file.side_frames]
    axes.plot(*side.T, color=colour, lw=6, alpha=0.4, label="first side")
    # arrows are 160 mm of path apart: at equal times, they would overlap while the robot rests
    travel = np.cumsum(np.hypot(*np.diff(xy, axis=0, prepend=xy[:1]).T))
    every = np.searchsorted(travel, np.arange(80.0, travel[-1], 160.0))
    # logged headings are 90 deg ahead of right-handed ones on the floor
    angle = np.radians(track.heading[every] - 90.0)
    arrows = 90.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    axes.quiver(
        *xy[every].T, *arrows.T, angles="xy", scale_units="xy", scale=1, width=0.008, zorder=4
    )
    axes.plot(*xy[0], "o", color="white", mec="black", ms=10, zorder=5, label="start")
    axes.plot(*xy[-1], "s", color="black", ms=9, zorder=5, label="end")
    axes.plot([], [], ">", color="black", ms=6, label="robot's heading")
    axes.set_aspect("equal")
    axes.set(xlim=(-250, 1000), xlabel="right of the start / mm")
    axes.set(ylim=(-100, 1250), ylabel="forward of the start / mm")
    axes.set_title(
        f"{track.file.label}\n"
        f"side 1: gained {track.displacement:.0f} of {long:.0f} mm\n"
        f"path {track.path_length:.0f} mm, printed {track.file.printed_path_length:.0f} mm\n"
        f"end {track.closure:.0f} mm from start, "
        f"heading {track.heading[0]:.0f}° to {track.heading[-1]:.0f}°",
        fontsize=9,
    )


def _floor(track: SquareTrack) -> np.ndarray:
    """Return positions relative to the start in right-handed axes on the floor [mm].

    In the image, y points down.
    """
    step = track.position - track.position[0]
    return np.stack([-step[:, 0], step[:, 1]], axis=1)


def _model(
    axes: Axes, form: FittedForm | None, name: str, colour: str, style: str, limit: float
) -> None:
    """Draw a model of slip from 0 to a limit of its regressor, if there is one."""
    if form is not None:
        x = np.linspace(0.0, limit, 200)
        label = f"{name}: {_formula(form)}, RMSE {form.rmse:.3f}"
        axes.plot(x, form.slip(x), style, color=colour, lw=2.2, label=label, zorder=5)


def _medians(
    axes: Axes, x: np.ndarray, slip: np.ndarray, colour: str, marker: str, label: str, width: float
) -> None:
    """Draw the median slip in each bin of x, `width` wide, that has at least 8 points."""
    bins = np.floor(x / width).astype(int)
    filled = [b for b in np.unique(bins) if np.count_nonzero(bins == b) >= 8]
    centre = [np.median(x[bins == b]) for b in filled]
    middle = [np.median(slip[bins == b]) for b in filled]
    axes.plot(centre, middle, marker + "-", color=colour, ms=6, mec="white", label=label, zorder=3)


def _deployed(axes: Axes, motor: int) -> None:
    current = np.linspace(0.0, 2.1, 421)
    slip = deployed_slip(np.tile(current[:, None], (1, 3)))[:, motor - 1]
    axes.plot(current, slip, color=_PAPER, lw=2, label="deployed on the robot", zorder=4)


def _formula(form: FittedForm) -> str:
    symbol = "M" if form.regressor == "torque" else "I"
    powers = ("", f" {symbol}", f" {symbol}²")[form.first_power :]
    terms = [f"{c:+.3f}{power}" for c, power in zip(form.coefficients, powers, strict=False)]
    return "s = " + " ".join(f"{term[0]} {term[1:]}" for term in terms).removeprefix("+ ")


def _slip_axes(axes: Axes, what: str, limit: float) -> None:
    axes.set(xlim=(0.0, limit), ylim=(0.0, 1.0), xlabel=_AXIS[what], ylabel="slip s")
    axes.grid(alpha=0.3)
