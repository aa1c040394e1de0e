"""`slipid tune`: gains rehearsed on the fit's own twin."""

from typing import Annotated, cast

import typer

from slipid.cli.common import Json, Load, OutFolder, Quiet, emit, on_wheels
from slipid.support.progress import Reporter


@on_wheels
def tune(
    out: OutFolder,
    load: Load = None,
    method: Annotated[str, typer.Option("--method", help="gradient or pso.")] = "gradient",
    rollouts: Annotated[
        int,
        typer.Option(
            "--rollouts",
            min=1,
            help="Rehearsals it may spend; a step of gradient takes 112, of pso 480.",
        ),
    ] = 3360,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of draws, floors and search.")] = 0,
    gyro: Annotated[bool, typer.Option("--gyro/--no-gyro", help="The robot has a gyro.")] = False,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Tune the controller's gains on the fit's own twin: draws of the robot, floors and noise.

    Writes gains.json, and the gains into robot.json; goes on after an interrupt. Exit code 1 where
    they are no better than gains set by hand, by two standard errors.
    """
    from slipid.control.tuning.optimisers import Method
    from slipid.deploy.tune import tune as run
    from slipid.report.answers import show_gains
    from slipid.support.files import writable
    from slipid.support.jax_setup import setup_jax

    with Reporter(quiet=quiet) as report:
        report.stage("reading the robot")
        setup_jax(quiet=True)
        writable(out)
        # it says itself which methods there are
        tuned = run(out, load, cast(Method, method), rollouts, seed, gyro, report)
    found = tuned.to_json()
    emit(json, found, lambda page: show_gains(page, found), out, ("gains.json", "robot.json"))
    return 0 if tuned.record().is_better else 1
