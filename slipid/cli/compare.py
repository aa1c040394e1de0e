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
        str, option("NAMES", "Kinds of held-out runs, by commas.")
    ] = "sectors,speeds,random",
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Say which slip model is right for each floor, or that the data cannot decide it.

    Every model is fitted without some runs and judged on them. Writes comparison.json and a
    picture; finished folds are kept and not fitted again.
    """
    from slipid.app.compare import compare as run
    from slipid.plots.compare import compare_plot
    from slipid.report.answers import show_comparison

    with Reporter(quiet=quiet) as report:
        found = run(config, data, out, folds.replace(" ", "").split(","), report)
        report.line(f"in {out}: comparison.json, {compare_plot(found, out).name}")
    emit(json, found, lambda page: show_comparison(page, found))
    return 0 if all(q["converged"] for q in found["questions"].values()) else 1
