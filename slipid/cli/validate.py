"""`slipid validate` and `slipid compare`: judge a fit, or slip models, by open-loop predictions."""

from pathlib import Path
from typing import Annotated

from slipid.cli.common import (
    ConfigFile,
    DataFolder,
    Json,
    Next,
    Out,
    OutFolder,
    Quiet,
    can_draw,
    emit,
    for_robots,
    option,
    renew,
)
from slipid.support.content import Content
from slipid.support.folder import locked
from slipid.support.progress import Reporter

VALIDATION = "validation.json"
"""Name of the file in the result folder, which the page of the results shows."""
NAMES = (VALIDATION, "validation_errors.png", "validation_paths.png")
"""Names of all files that the command writes."""


@for_robots
def validate(
    out: OutFolder,
    data: DataFolder,
    logs: Annotated[
        str | None,
        option(
            "GLOB",
            "Quoted pattern of the paths of the logs in the data folder, such as 'day2/*.csv'. "
            "Layout, floor and load set-up are those of the config; by default so are the logs.",
        ),
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Predict runs open loop with the fit and with simpler models; compare with logged poses.

    Writes validation.json and pictures to OUT.
    """
    from slipid.report.answers import show_validation

    with Reporter(quiet=quiet) as report, locked(out, "validate", *NAMES):
        found, written = run(out, data, report, logs)
    emit(json, found, lambda page: show_validation(page, found), [renew(out)], out, written)
    return 0


def run(
    out: Path, data: Path, report: Reporter, logs: str | None = None
) -> tuple[Content, list[str]]:
    """Return the content of validation.json, and the names of the files written to `out`.

    Arguments are those of `slipid.app.compare.validate`.
    """
    from slipid.app.compare import validate, validate_calibration
    from slipid.infer.result_folder import FIT, IDENTIFIED, fit_of
    from slipid.support.files import write_json

    if (out / IDENTIFIED).exists() and not (out / FIT).exists():
        content = validate_calibration(out, data, report, logs).to_json() | {"fit": fit_of(out)}
        write_json(out / VALIDATION, content)
        return content, [VALIDATION]
    fit, dataset, found = validate(out, data, report, logs)
    content = found.to_json() | {"fit": fit_of(out)}
    write_json(out / VALIDATION, content)
    written = [VALIDATION]
    if can_draw(report):
        from slipid.plots.fit import validate_plots

        written += [path.name for path in validate_plots(fit, dataset, found, out)]
    return content, written


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
    from slipid.report.answers import show_comparison

    with Reporter(quiet=quiet) as report, locked(out, "compare", "comparison.*"):
        found = run(config, data, out, folds.replace(" ", "").split(","), report)
        written = ["comparison.json"]
        if can_draw(report):
            from slipid.plots.compare import compare_plot

            written.append(compare_plot(found, out).name)
    words = ("identify", config, "--data", data, "--out", Path("out") / config.stem)
    step = Next("fit the robot, with the best of three models on every floor", words)
    emit(json, found, lambda page: show_comparison(page, found), [step], out, written)
    return 0 if all(q["converged"] for q in found["questions"].values()) else 1
