"""`slipid trial`: drive the rectangle of the 2021 paper, or another path, with every controller."""

from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import (
    Jobs,
    Json,
    Load,
    OutFolder,
    Quiet,
    can_draw,
    emit,
    executor_of,
    for_robots,
    option,
    renew,
)
from slipid.support.folder import locked
from slipid.support.progress import Reporter


@for_robots
def trial(
    out: OutFolder,
    plant: Annotated[
        str, option("NAME", "Simulated robot: testsite (MuJoCo), or twin (the fitted model).")
    ] = "testsite",
    site: Annotated[
        Path | None,
        option(
            "CONFIG",
            "Config of slipid simulate that made the logs, whose robot the test site simulates; by "
            "default the built-in robot with three omni wheels.",
        ),
    ] = None,
    map: Annotated[
        Path | None, option("FILE", "Floor map; by default patches of the fitted floors.")
    ] = None,
    told_map: Annotated[
        Path | None,
        option("FILE", "Map given to the controllers that use one; by default the true map."),
    ] = None,
    controllers: Annotated[
        str | None, option("NAMES", "Controllers separated by commas; all by default.")
    ] = None,
    path: Annotated[
        str,
        option(
            "NAME",
            "Path: rectangle, circle, eight, clothoid, or turning (omni robots that also rotate).",
        ),
    ] = "rectangle",
    speed: Annotated[
        float, option("M_S", "Speed along the path, in m/s.", min=1e-3, max=100)
    ] = 0.2,
    starts: Annotated[int, typer.Option(min=1, max=99, help="Number of start poses.")] = 20,
    rest: Annotated[
        float,
        option(
            "S", "Rest before the robot drives, in which a gyro's bias is found.", min=0, max=60
        ),
    ] = 5.0,
    load: Load = None,
    jobs: Jobs = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Drive a simulated robot along a path with every controller, and compare their errors.

    Gains are designed if robot.json has delay and lag of the wheels, else set by hand.
    Writes trial.json and trial.png to OUT. Finished runs are kept and not simulated again.
    """
    from slipid.lab.trial.trial import TrialOptions, controller_names
    from slipid.lab.trial.trial import trial as run
    from slipid.report.answers import show_trial

    options = TrialOptions(
        plant=plant,
        site=site,
        map=map,
        told_map=told_map,
        controllers=controller_names(controllers),
        path=path,
        speed=speed,
        starts=starts,
        rest=rest,
        load=load,
    )
    with (
        Reporter(quiet=quiet) as report,
        locked(out, "trial", "trial.json", "trial.png"),
        executor_of(jobs) as executor,
    ):
        done = run(out, options, executor, report)
        written = ["trial.json"]
        if can_draw(report):
            from slipid.lab.trial.plots import trial_plot

            written.append(trial_plot(done, out / "trial.png").name)
    found = done.content
    emit(json, found, lambda page: show_trial(page, found), [renew(out)], out, written)
    return 0
