"""`slipid trial`: drive the 2021 paper's rectangle, or another path, with every controller."""

from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import (
    Jobs,
    Json,
    Load,
    OutFolder,
    Quiet,
    emit,
    executor_of,
    flag,
    for_robots,
    option,
)
from slipid.support.progress import Reporter


@for_robots
def trial(
    out: OutFolder,
    plant: Annotated[
        str, option("NAME", "testsite (MuJoCo), or twin: the fit itself.")
    ] = "testsite",
    map: Annotated[Path | None, option("FILE", "Floor map; else made of patches.")] = None,
    told_map: Annotated[
        Path | None,
        option("FILE", "Map that is given to controllers with a map; the true one by default."),
    ] = None,
    controllers: Annotated[str | None, option("NAMES", "By commas; all by default.")] = None,
    path: Annotated[
        str, option("NAME", "rectangle, circle, eight, or turning: it turns.")
    ] = "rectangle",
    speed: Annotated[float, option("M_S", "Along the path, in m/s.")] = 0.2,
    starts: Annotated[int, typer.Option(min=1, max=99, help="Poses to start from.")] = 20,
    load: Load = None,
    tuned_gains: Annotated[
        bool, flag("--tuned-gains", "Even where they are no better than by hand.")
    ] = False,
    jobs: Jobs = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Drive the 2021 paper's rectangle, or another path, with every controller, and judge them.

    Gains are those set by hand, or tuned ones of an older robot.json that are better. Writes
    trial.json and trial.png to OUT; runs that are done are kept and not driven again.
    """
    from slipid.lab.trial.plots import trial_plot
    from slipid.lab.trial.trial import TrialOptions, controller_names
    from slipid.lab.trial.trial import trial as run
    from slipid.report.answers import show_trial

    options = TrialOptions(
        plant=plant,
        map=map,
        told_map=told_map,
        controllers=controller_names(controllers),
        path=path,
        speed=speed,
        starts=starts,
        load=load,
        tuned_gains=tuned_gains,
    )
    with Reporter(quiet=quiet) as report, executor_of(jobs) as executor:
        done = run(out, options, executor, report)
        report.stage("drawing")
        trial_plot(done, out / "trial.png")
    emit(json, done.content, lambda page: show_trial(page, done.content, out))
    return 0
