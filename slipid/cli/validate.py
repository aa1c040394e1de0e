"""`slipid validate`: open-loop prediction of runs."""

from pathlib import Path
from typing import TYPE_CHECKING

from slipid.cli.common import DataFolder, Json, OutFolder, Quiet, emit, guarded
from slipid.support.content import Content
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from slipid.job.validate import Validated


@guarded
def validate(out: OutFolder, data: DataFolder, json: Json = None, quiet: Quiet = False) -> int:
    """Predict runs open loop and compare with the camera, model by model."""
    with Reporter(quiet=quiet) as report:
        done = run(out, data, report)
    emit(json, done.content, lambda: show(done.content))
    return 0


def run(out: Path, data: Path, report: Reporter) -> "Validated":
    """The prediction and its pictures; arguments as of `slipid.job.validate.validate`.

    Raises:
        DataError: no fit there, or logs that it cannot predict.
    """
    from slipid.job.validate import validate
    from slipid.plots.fit import validate_plots

    done = validate(out, data, report)
    report.stage("drawing")
    drawn = validate_plots(done.fit, done.dataset, done.content, out)
    report.line(f"in {out}: {', '.join(path.name for path in drawn)}")
    return done


def show(found: Content) -> None:
    """Print the summary of a validation file: one row per floor and model."""
    from slipid.report.page import Page, percent, table

    columns = ("surface", "model", "end-point error", "median", "length", "heading")
    made = table((*columns, "in 90 %", "runs"))
    for surface, models in found["summary"].items():
        for model, s in models.items():
            heading = s["heading_error_median_deg"]
            made.add_row(
                surface,
                model,
                percent(s["endpoint_error_mean"]),
                percent(s["endpoint_error_median"]),
                percent(s["length_error_mean"]),
                "" if heading is None else f"{heading:.2f} deg",
                percent(s["coverage90"]),
                str(s["runs"]),
            )
    Page().table(made)
