"""`slipid compare`: judge slip models on each floor by their predictions of held-out runs."""

from typing import Annotated

from slipid.cli.common import ConfigFile, DataFolder, Json, Out, Quiet, emit, for_robots, option
from slipid.support.progress import Reporter


@for_robots
def compare(
    config: ConfigFile,
    data: DataFolder,
    out: Out,
    folds: Annotated[
        str, option("NAMES", "Kinds of held-out runs, separated by commas.")
    ] = "sectors,speeds,random",
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Find the best slip model for each floor by cross-validation, if the data can decide it.

    Every model is fitted without the held-out runs and then judged by its predictions of them.
    Writes comparison.json and a picture. Finished folds are kept in OUT and are not fitted again.
    """
    from slipid.app.compare import compare as run
    from slipid.plots.compare import compare_plot
    from slipid.report.answers import show_comparison

    with Reporter(quiet=quiet) as report:
        found = run(config, data, out, folds.replace(" ", "").split(","), report)
        report.line(f"written to {out}: comparison.json, {compare_plot(found, out).name}")
    emit(json, found, lambda page: show_comparison(page, found))
    return 0 if all(q["converged"] for q in found["questions"].values()) else 1
