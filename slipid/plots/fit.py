"""Pictures of a result, as PNG files."""

from collections.abc import Callable
from pathlib import Path

from matplotlib.figure import Figure

from slipid.data.runs import Runs
from slipid.identify.compare.validation import Validation
from slipid.identify.result import Fit
from slipid.plots.drawing import save_all, warned
from slipid.plots.load import load_figure
from slipid.plots.motion import heading_figure, path_figure
from slipid.plots.seen import Seen, seen
from slipid.plots.wheels import current_figure, curve_figure

PATHS = (
    "Where the encoders say the robot went (dotted), where the fitted robot says (blue),\n"
    "and where the camera saw it (gray): "
)


PICTURES: dict[str, Callable[[Fit, Runs, Seen], Figure | None]] = {
    "slip_by_heading": lambda fit, data, pieces: heading_figure(fit.robot, pieces),
    "paths": lambda fit, data, pieces: path_figure(
        fit.contact, data, pieces.groups, PATHS + "runs of the fit"
    ),
    "slip_by_torque": lambda fit, data, pieces: curve_figure(fit, pieces),
    "current_by_traction": lambda fit, data, pieces: current_figure(pieces),
    "load_share": lambda fit, data, pieces: load_figure(fit),
}
"""Pictures of a fit by name."""


def identify_plots(fit: Fit, data: Runs, out: Path, warning: str | None = None) -> list[Path]:
    """Files of all `PICTURES` that the runs, those of the fit, have something for.

    What is said of a fit that is not to be used stands in the title of each.
    """
    pieces = seen(fit.robot, data, fit.channels.windows)
    made = {name: draw(fit, data, pieces) for name, draw in PICTURES.items()}
    if warning is not None:
        for figure in filter(None, made.values()):
            warned(figure, warning)
    return save_all(made, out)


def picture(fit: Fit, data: Runs, name: str) -> Figure:
    """One picture by name; ValueError where there is none, or the runs have nothing for it."""
    if name not in PICTURES:
        raise ValueError(f"no picture '{name}'; there are {', '.join(PICTURES)}")
    made = PICTURES[name](fit, data, seen(fit.robot, data, fit.channels.windows))
    if made is None:
        raise ValueError(f"picture '{name}': the runs have nothing for it")
    return made


def validate_plots(fit: Fit, data: Runs, found: Validation, out: Path) -> list[Path]:
    """Files of how well runs are predicted, as the validation found, and some of their paths."""
    names = {log.surface or "unknown": None for log in data.logs}
    order = [(floor, load) for floor in sorted(names) for load in fit.robot.body.loads]
    figures = {
        "validation_errors": found.plot(),
        "validation_paths": path_figure(fit.contact, data, order, PATHS + found.which),
    }
    return save_all(figures, out)
