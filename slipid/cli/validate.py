"""`slipid validate`: predict runs open loop with a fit, and compare with the logged poses."""

from pathlib import Path

from slipid.cli.common import DataFolder, Json, OutFolder, Quiet, emit, for_robots
from slipid.support.content import Content
from slipid.support.progress import Reporter


@for_robots
def validate(out: OutFolder, data: DataFolder, json: Json = None, quiet: Quiet = False) -> int:
    """Predict runs open loop with the fit and with simpler models; compare with logged poses."""
    from slipid.report.estimates import show_validation

    with Reporter(quiet=quiet) as report:
        found = run(out, data, report)
    emit(json, found, lambda page: show_validation(page, found))
    return 0


def run(out: Path, data: Path, report: Reporter) -> Content:
    """Return the content of the validation file of runs, and draw their pictures.

    Arguments are those of `slipid.app.compare.validate`.
    """
    from slipid.app.compare import validate
    from slipid.plots.fit import validate_plots

    fit, dataset, found = validate(out, data, report)
    report.stage("drawing")
    drawn = validate_plots(fit, dataset, found, out)
    report.line(f"in {out}: {', '.join(path.name for path in drawn)}")
    return found.to_json()
