"""`slipid selftest`: test by simulation which numbers an experiment can recover."""

from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import ConfigFile, Json, Out, Quiet, emit, for_robots, option
from slipid.support.progress import Reporter


@for_robots
def selftest(
    config: ConfigFile,
    data: Annotated[Path | None, option("DIR", "Logs whose wheel motion is taken, if any.")] = None,
    out: Out = Path("selftest_out"),
    replicates: Annotated[int, typer.Option(min=1, help="Number of simulated experiments.")] = 8,
    seed: Annotated[int, typer.Option(min=0, help="Seed of truths and noise.")] = 0,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    r"""Simulate this very experiment with known truth, fit it, and report what it recovers.

    Without --data it is the plan of \[selftest] in the config. Writes selftest.json; goes on from
    the replicates that are done. Exit code 1 where a wanted number is not recovered.
    """
    from slipid.lab.selftest.experiment import selftest as run
    from slipid.report.estimates import show_selftest

    with Reporter(quiet=quiet) as report:
        found = run(config, data, out, replicates, seed, report)
    files = ("selftest.json", "replicates.json")
    emit(json, found, lambda page: show_selftest(page, found), out, files)
    return 0 if found["recovered"] else 1
