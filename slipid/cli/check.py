"""`slipid check`: what logs can tell, before any fit."""

from slipid.cli.common import ConfigFile, DataFolder, Json, MaybeOut, Quiet, emit, guarded
from slipid.support.progress import Reporter


@guarded
def check(
    config: ConfigFile,
    data: DataFolder,
    out: MaybeOut = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Read and validate logs; say what is wrong and what they can tell before anything is fitted.

    Exit code 1 where logs and config do not go together.
    """
    from slipid.job import check as job
    from slipid.plots.raw import raw_plots
    from slipid.report.estimates import show_check

    with Reporter(quiet=quiet) as report:
        logs, found = job.check(config, data, out, report)
        if out is not None:
            report.stage("drawing")
            raw_plots(logs, out)
    emit(json, found, lambda page: show_check(page, found))
    return 1 if any(f["severity"] == "wrong" for f in found["findings"]) else 0
