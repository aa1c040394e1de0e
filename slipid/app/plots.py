"""Pictures of a result, as PNG files."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slipid.app import drawing
from slipid.app.plot_data import seen
from slipid.app.plots_ladder import ladder_figure
from slipid.app.plots_motion import heading_figure, path_figure
from slipid.app.plots_robot import load_figure
from slipid.app.plots_wheels import current_figure, curve_figure
from slipid.data.dataset import Dataset
from slipid.identify.result import Fit

PATHS = (
    "Where the encoders say the robot went (dotted), where the fitted robot says (blue),\n"
    "and where the camera saw it (gray): "
)


def identify_plots(fit: Fit, data: Dataset, out: Path) -> list[Path]:
    """Draw what a fit found beside the runs it was fitted to.

    Args:
        fit: of these runs.
        data: the runs.
        out: folder to write to.

    Returns:
        the files; a picture the data have nothing for is left out.
    """
    pieces = seen(fit.robot, data, int(fit.settings["windows_per_piece"]))
    figures = {
        "slip_by_heading.png": heading_figure(fit.robot, pieces),
        "paths.png": path_figure(fit.robot, data, pieces.groups, PATHS + "runs of the fit"),
        "slip_by_torque.png": curve_figure(fit, pieces),
        "current_by_traction.png": current_figure(fit.robot, pieces),
        "load_shares.png": load_figure(fit),
    }
    return [drawing.save(made, out / name) for name, made in figures.items() if made is not None]


def validate_plots(fit: Fit, data: Dataset, found: Mapping[str, Any], out: Path) -> list[Path]:
    """Draw how well runs are predicted, and some of their paths.

    Args:
        fit: that predicted.
        data: the runs it predicted.
        found: the validation file's content.
        out: folder to write to.

    Returns:
        the files.
    """
    seen_before = {sha for _, sha in fit.runs}
    new = sum(log.sha256 not in seen_before for log in data.logs)
    which = f"{new} of {len(data)} runs are new to the fit"
    names = {log.surface or "unknown": None for log in data.logs}
    order = [(floor, load) for floor in sorted(names) for load in fit.robot.body.loads]
    figures = {
        "validation_errors.png": ladder_figure(found, which),
        "validation_paths.png": path_figure(fit.robot, data, order, PATHS + which),
    }
    return [drawing.save(made, out / name) for name, made in figures.items()]
