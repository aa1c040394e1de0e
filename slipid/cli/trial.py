"""`slipid trial`: the 2021 paper's rectangle with every controller."""

from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import Jobs, Json, Load, OutFolder, Quiet, emit, guarded, processes
from slipid.support.content import Content
from slipid.support.progress import Reporter


@guarded
def trial(
    out: OutFolder,
    plant: Annotated[
        str, typer.Option(metavar="NAME", help="testsite (MuJoCo), or twin: the fit itself.")
    ] = "testsite",
    map: Annotated[
        Path | None, typer.Option("--map", metavar="FILE", help="Floor map; else made of patches.")
    ] = None,
    controllers: Annotated[
        str | None, typer.Option(metavar="NAMES", help="By commas; all by default.")
    ] = None,
    starts: Annotated[int, typer.Option(min=1, max=99, help="Poses to start from.")] = 20,
    load: Load = None,
    jobs: Jobs = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Drive the 2021 paper's rectangle with every controller and say which one to deploy.

    Gains are those that `slipid tune` put into robot.json, if any. Writes trial.json and trial.png
    to OUT; runs that are done are kept and not driven again.
    """
    from slipid.deploy.trial import Wish, names_of
    from slipid.deploy.trial import trial as run
    from slipid.plots.trial import trial_plot

    wish = Wish(plant, map, names_of(controllers), starts, load, processes(jobs))
    with Reporter(quiet=quiet) as report:
        done = run(out, wish, report)
        report.stage("drawing")
        trial_plot(done.content, done.paths, done.floor, out / "trial.png")
    emit(json, done.content, lambda: show(done.content, out))
    return 0


def show(found: Content, out: Path) -> None:
    """Print what every controller came to, medians over the starts."""
    from slipid.report.page import Page, table

    page = Page()
    numbers = ("closure", "cross-track", "first side", "heading", "path", "of encoders'")
    made = table(("controller", *numbers), right=numbers)
    for name, row in found["summary"].items():
        ratio = row.get("to_encoder", {}).get("closure_error_median")
        told = "" if ratio is None else f"{100 * ratio['value']:.0f} % closure"
        if row["finished_share"] < 1:
            told += f", {100 * row['finished_share']:.0f} % of runs finished"
        made.add_row(
            name,
            f"{row['closure_error_median']:.0f} mm",
            f"{row['cross_track_rmse']:.0f} mm",
            f"{row['first_side_along_track_mm']:.0f} mm",
            f"{row['heading_error_deg']:.1f} deg",
            f"{row['path_length_mm']:.0f} mm",
            told,
        )
    page.table(made)
    best = found["closes_best"]
    page.line(f"closes best: {best} ({found['controllers'][best]})")
    count = min(row["runs"] for row in found["summary"].values())
    page.line(f"medians of {count} starts; 90 % intervals and every run: {out / 'trial.json'}")
    page.line(f"look at: {out / 'trial.png'}")
