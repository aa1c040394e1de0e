"""`slipid validate`: open-loop prediction of runs."""

from pathlib import Path
from typing import TYPE_CHECKING

from slipid.cli.common import DataFolder, Json, OutFolder, Quiet, emit, guarded
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from slipid.job.validate import Validated


@guarded
def validate(out: OutFolder, data: DataFolder, json: Json = None, quiet: Quiet = False) -> int:
    """Predict runs open loop and compare with the camera, model by model."""
    from slipid.report.near import show_validation

    with Reporter(quiet=quiet) as report:
        done = run(out, data, report)
    emit(json, done.content, lambda page: show_validation(page, done.content))
    return 0


def run(out: Path, data: Path, report: Reporter) -> "Validated":
    """The prediction and its pictures; arguments as of `slipid.job.validate.validate`."""
    from slipid.job.validate import validate
    from slipid.plots.fit import validate_plots

    done = validate(out, data, report)
    report.stage("drawing")
    drawn = validate_plots(done.fit, done.dataset, done.content, out)
    report.line(f"in {out}: {', '.join(path.name for path in drawn)}")
    return done
