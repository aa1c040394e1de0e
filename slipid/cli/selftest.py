"""`slipid selftest`: test by simulation which parameters an experiment can recover."""

from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import (
    MOST_SEED,
    ConfigFile,
    Json,
    Next,
    Out,
    Quiet,
    emit,
    for_robots,
    option,
)
from slipid.support.folder import locked
from slipid.support.progress import Reporter


@for_robots
def selftest(
    config: ConfigFile,
    data: Annotated[
        Path | None, option("DIR", "Folder of logs whose wheel motion is used in the simulation.")
    ] = None,
    out: Out = Path("selftest_out"),
    replicates: Annotated[
        int, typer.Option(min=1, max=10_000, help="Number of simulated experiments.")
    ] = 8,
    seed: Annotated[
        int, typer.Option(min=0, max=MOST_SEED, help="Seed of the random true values and noise.")
    ] = 0,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Simulate an experiment with known true values, and compare its fit with these values.

    Without --data, the runs are those planned in [selftest] of the config. Writes selftest.json.
    After an interrupt, finished simulations are kept. The exit code is 1 if a parameter that should
    be recovered is not.
    """
    from slipid.lab.selftest.experiment import selftest as run
    from slipid.report.checks import show_selftest

    with Reporter(quiet=quiet) as report, locked(out, "selftest", "selftest.json"):
        found = run(config, data, out, replicates, seed, report)
    files = ("selftest.json", "replicates.json")
    step = Next("drive it, and check the logs", ("check", config, "--data", data or "logs"))
    if not found["recovered"]:
        step = Next(f"after planning more runs in {config}", ("selftest", config, "--out", out))
    emit(json, found, lambda page: show_selftest(page, found), [step], out, files)
    return 0 if found["recovered"] else 1
