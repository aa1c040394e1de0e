"""The command line. Imports are late: `slipid --help` answers before numpy is loaded."""

import _thread
import functools
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(
    name="slipid",
    help="Identify motors, floors and wheel loads of a robot from its logs.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="Config, a TOML file.")]
OutFolder = Annotated[Path, typer.Argument(metavar="OUT", help="Folder identify wrote.")]
DataFolder = Annotated[
    Path, typer.Option("--data", metavar="DIR", help="Folder the globs of the config start from.")
]
Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write to.")]
MaybeOut = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="Folder to write to, if wanted.")
]
Json = Annotated[
    str | None, typer.Option("--json", metavar="FILE", help="Also write JSON there; - is stdout.")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress.")]

AGAIN_S = 0.05
"""After which an interrupt is sent again that Python had to ignore."""


def guarded(command: Callable[..., Any]) -> Callable[..., Any]:
    """Bad input is one message and exit code 2, an interrupt 130; neither is a traceback."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            code = command(*args, **kwargs)
        except KeyboardInterrupt:
            typer.echo(
                "interrupted; called again, it goes on from what was kept, if it keeps anything",
                err=True,
            )
            raise typer.Exit(130) from None
        except ValueError as error:
            from slipid.data.log import DataError

            if not isinstance(error, DataError):
                raise
            typer.echo(str(error), err=True)
            raise typer.Exit(2) from None
        raise typer.Exit(code or 0)

    return run


@app.command()
@guarded
def identify(
    config: ConfigFile,
    data: DataFolder,
    out: Out,
    profile: Annotated[
        list[str] | None,
        typer.Option(metavar="PATH", help="Also profile a number's likelihood; may be repeated."),
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Fit motors, floors, loads and camera to the logs, end to end.

    Writes identified.json, fit.json and pictures; goes on from a checkpoint after an interrupt.
    """
    from slipid.app import commands, tables
    from slipid.app.progress import Reporter

    with Reporter(quiet=quiet) as report:
        done = commands.identify(config, data, out, report, profile or ())
    if json is not None:
        _emit(json, done.fit.to_identified())
    if json != "-":
        tables.identified(done.fit, out, done.written, done.profiles)
    return 0 if done.fit.converged else 1


@app.command()
@guarded
def sample(
    out: OutFolder,
    data: Annotated[
        Path | None, typer.Option("--data", metavar="DIR", help="Where the logs are now.")
    ] = None,
    draws: Annotated[
        int, typer.Option("--draws", min=10, help="Kept of each of four ensembles.")
    ] = 400,
    most: Annotated[int, typer.Option("--most", min=24, help="Blocks before it gives up.")] = 400,
    block: Annotated[
        int, typer.Option("--block", min=1, hidden=True, help="Steps that are kept together.")
    ] = 20,
    seed: Annotated[int, typer.Option("--seed", min=0)] = 0,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Posterior of a fit by emcee: honest intervals, posterior.nc; goes on after an interrupt."""
    from slipid.app import commands, tables
    from slipid.app.progress import Reporter

    with Reporter(quiet=quiet) as report:
        done = commands.sample(out, data, draws, most, block, seed, report)
    if json is not None:
        _emit(json, done.content)
    if json != "-":
        tables.sampled(done, out)
    return 0 if done.about["converged"] else 1


@app.command()
@guarded
def check(
    config: ConfigFile,
    data: DataFolder,
    out: MaybeOut = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Read and validate logs; say what they can tell before anything is fitted."""
    from slipid.app import commands, tables
    from slipid.app.progress import Reporter

    with Reporter(quiet=quiet) as report:
        found = commands.check(config, data, out, report)
    if json is not None:
        _emit(json, found)
    if json != "-":
        tables.check(found)
    return 0


@app.command()
@guarded
def selftest(
    config: ConfigFile,
    data: Annotated[
        Path | None,
        typer.Option("--data", metavar="DIR", help="Logs whose wheel motion is taken, if any."),
    ] = None,
    out: Out = Path("selftest_out"),
    replicates: Annotated[int, typer.Option(min=1, help="Made experiments.")] = 8,
    seed: Annotated[int, typer.Option(min=0, help="Of truths and noise.")] = 0,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Make this very experiment with known truth, fit it, and say what it recovers.

    Without --data it is the plan of [selftest] in the config. Writes selftest.json; goes on from
    the replicates that are done. Exit code 1 where a number that is wanted is not recovered.
    """
    from slipid.app import commands, tables
    from slipid.app.progress import Reporter

    with Reporter(quiet=quiet) as report:
        found = commands.selftest(config, data, out, replicates, seed, report)
    if json is not None:
        _emit(json, found)
    if json != "-":
        tables.selftest(found, out)
    return 0 if found["recovered"] else 1


@app.command()
@guarded
def validate(out: OutFolder, data: DataFolder, json: Json = None, quiet: Quiet = False) -> int:
    """Predict runs open loop and compare with the camera, model by model."""
    from slipid.app import commands, tables
    from slipid.app.progress import Reporter

    with Reporter(quiet=quiet) as report:
        found = commands.validate(out, data, report)
    if json is not None:
        _emit(json, found)
    if json != "-":
        tables.validation(found)
    return 0


@app.command()
@guarded
def compare(
    config: ConfigFile,
    data: DataFolder,
    out: Out,
    folds: Annotated[
        str, typer.Option("--folds", metavar="NAMES", help="What is left out, by commas.")
    ] = "sectors,speeds,random",
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Say which slip model is right for each floor, or that the data cannot tell.

    Every model is fitted without some runs and judged on them. Writes comparison.json and a
    picture; finished folds are kept and not done again.
    """
    from slipid.app import tables
    from slipid.app.comparison import compare as run
    from slipid.app.progress import Reporter

    with Reporter(quiet=quiet) as report:
        found = run(config, data, out, folds.replace(" ", "").split(","), report)
    if json is not None:
        _emit(json, found)
    if json != "-":
        tables.comparison(found)
    return 0 if all(q["converged"] for q in found["questions"].values()) else 1


@app.command()
@guarded
def design(
    out: OutFolder,
    parameter: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="Parameter to sharpen; * and ? allowed; may be repeated."
        ),
    ] = None,
    predict: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FLOOR[@LOAD][:SPEED[:HEADING]]",
            help="Prediction to sharpen, as gray:0.3:45 [m/s, deg]; may be repeated.",
        ),
    ] = None,
    runs: Annotated[int, typer.Option(min=1, max=1000, help="How many to propose.")] = 12,
    headings: Annotated[
        str | None, typer.Option(metavar="LIST", help="Of candidates, as 0,45,90 [deg].")
    ] = None,
    speeds: Annotated[
        str | None, typer.Option(metavar="LIST", help="Of candidates, as 0.1,0.2 [m/s].")
    ] = None,
    turns: Annotated[
        str | None, typer.Option(metavar="LIST", help="Turning rates, as -40,0,40 [deg/s].")
    ] = None,
    distance: Annotated[
        float | None, typer.Option(metavar="M", help="Of every run [m]; as driven by default.")
    ] = None,
    floor: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Floor that can be driven on.")
    ] = None,
    load: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Load set-up that can be driven.")
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Propose the next runs: those that shrink a parameter or a prediction most.

    Writes design.json, design.png and design_commands.csv to OUT.
    """
    from slipid.app import commands, tables
    from slipid.app.design import wish
    from slipid.app.progress import Reporter

    wanted = wish(
        parameter or (),
        predict or (),
        runs,
        headings,
        speeds,
        turns,
        distance,
        floor or (),
        load or (),
    )
    with Reporter(quiet=quiet) as report:
        found, written = commands.design(out, wanted, report)
    if json is not None:
        _emit(json, found.content)
    if json != "-":
        tables.design(found.content, out, written)
    return 0 if found.reached else 1


@app.command()
@guarded
def tune(
    out: OutFolder,
    load: Annotated[
        str | None,
        typer.Option("--load", metavar="NAME", help="Load set-up; the first by default."),
    ] = None,
    method: Annotated[str, typer.Option("--method", help="gradient or pso.")] = "gradient",
    rollouts: Annotated[
        int, typer.Option("--rollouts", min=1, help="Rehearsals it may spend.")
    ] = 3360,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of draws, floors and search.")] = 0,
    gyro: Annotated[bool, typer.Option("--gyro/--no-gyro", help="The robot has a gyro.")] = False,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Tune the controller's gains on the fit's own twin: draws of the robot, floors and noise.

    Writes gains.json; goes on after an interrupt. Exit code 1 where gains set by hand are better.
    """
    from slipid.app import commands, tables
    from slipid.app.progress import Reporter

    wanted = {"load": load, "method": method, "rollouts": rollouts, "seed": seed, "gyro": gyro}
    with Reporter(quiet=quiet) as report:
        found = commands.tune(out, wanted, report)
    if json is not None:
        _emit(json, found)
    if json != "-":
        tables.tuned(found, out)
    return 0 if found["loss"]["tuned"] <= found["loss"]["hand"] else 1


@app.command()
@guarded
def paper(
    data: Annotated[
        Path, typer.Option("--data", metavar="DIR", help="Folder that holds robotino2021.")
    ],
    out: Out,
) -> int:
    """Regenerate the 2021 paper's tables and figures from its own data."""
    from slipid.app import paper_plots

    for path in paper_plots.run(data, out):
        typer.echo(str(path))
    return 0


@app.command()
@guarded
def new(
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Config to write.")] = Path(
        "robot.toml"
    ),
    drive: Annotated[str, typer.Option(help="omni, mecanum or skid.")] = "omni",
    wheel_radius_m: Annotated[float, typer.Option(prompt="wheel radius [m]")] = 0.05,
    base_m: Annotated[
        float, typer.Option(prompt="wheel centres from the middle [m] (omni: radius)")
    ] = 0.15,
    gear_ratio: Annotated[float, typer.Option(prompt="motor turns per wheel turn")] = 1.0,
    mass_kg: Annotated[float, typer.Option(prompt="mass [kg]")] = 10.0,
    ticks_per_revolution: Annotated[
        float, typer.Option(prompt="encoder ticks per motor turn")
    ] = 1000.0,
    force: Annotated[bool, typer.Option("--force", help="Overwrite.")] = False,
) -> int:
    """Write a commented config for your robot; asks what it needs to know."""
    from slipid.app.new import write_new

    write_new(out, drive, wheel_radius_m, base_m, gear_ratio, mass_kg, ticks_per_revolution, force)
    typer.echo(f"{out}: name your columns below [layouts.mine.columns], then run")
    typer.echo(f"  slipid check {out} --data DIR")
    typer.echo("or, before anything is driven, see what a plan of runs would tell:")
    typer.echo(f"  slipid selftest {out}")
    return 0


@app.command()
@guarded
def simulate(
    config: ConfigFile,
    out: Out,
    jobs: Annotated[
        int | None, typer.Option("--jobs", min=1, help="Processes at once; by default all cores.")
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Logs from the virtual test site, whose physics is MuJoCo's; needs slipid[testsite].

    Writes logs, a config that identifies them, floor maps, and the truth in a folder of its own.
    Runs that are done are kept and not driven again.
    """
    import os

    from slipid.app import tables
    from slipid.app.progress import Reporter
    from slipid.app.simulate import simulate as run
    from slipid.app.simulate_config import read_plan

    plan = read_plan(config)
    with Reporter(quiet=quiet) as report:
        found = run(plan, out, jobs or os.cpu_count() or 1, report)
    if json is not None:
        _emit(json, found)
    if json != "-":
        tables.simulated(found, plan, out)
    return 0


@app.command()
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
    load: Annotated[
        str | None, typer.Option(metavar="NAME", help="Load set-up; the first by default.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", min=1, help="Processes at once; by default all cores.")
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Drive the 2021 paper's rectangle with every controller and say which one to deploy.

    Gains are those of gains.json where `slipid tune` wrote one. Writes trial.json and trial.png to
    OUT; runs that are done are kept and not driven again.
    """
    from slipid.app import tables
    from slipid.app.progress import Reporter
    from slipid.app.trial import Wish, names_of, processes
    from slipid.app.trial import trial as run

    wish = Wish(plant, map, names_of(controllers), starts, load, processes(jobs))
    with Reporter(quiet=quiet) as report:
        found = run(out, wish, report)
    if json is not None:
        _emit(json, found)
    if json != "-":
        tables.trial(found, out)
    return 0


@app.command()
@guarded
def demo(
    out: Out = Path("demo_out"),
    plant: Annotated[
        str, typer.Option(metavar="NAME", help="recorded, or mujoco to drive the logs anew.")
    ] = "recorded",
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, help="Of the runs that are driven anew.")
    ] = None,
    quiet: Quiet = False,
) -> int:
    """The whole job on logs of the virtual test site, small: a folder to look at."""
    import os

    from slipid.app import tables
    from slipid.app.demo import demo as run
    from slipid.app.demo import real_logs
    from slipid.app.progress import Reporter

    with Reporter(quiet=quiet) as report:
        done, found, rows = run(out, plant, seed, os.cpu_count() or 1, report)
    tables.demo(out, done, found, rows, real_logs())
    return 0 if done.fit.converged else 1


def _emit(where: str, value: Any) -> None:
    """JSON to a file, whole or not at all, or to stdout."""
    from slipid.data.files import json_text, write_bytes

    text = json_text(value)
    if where == "-":
        sys.stdout.write(text)
    else:
        write_bytes(Path(where), text.encode())


def main() -> None:
    """Entry point of the `slipid` command."""
    sys.unraisablehook = _interrupt_again
    app()


def _interrupt_again(lost: Any) -> None:
    """Send an interrupt again that Python had to ignore where it arrived.

    In a finaliser or a callback of the garbage collector (jax has one) no exception can be raised.
    """
    if lost.exc_type is KeyboardInterrupt:
        again = threading.Timer(AGAIN_S, _thread.interrupt_main)
        again.daemon = True  # a command that has ended by then is left in peace
        again.start()
    else:
        sys.__unraisablehook__(lost)
