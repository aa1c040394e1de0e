"""`slipid sample`: sample the posterior of a fit."""

from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import (
    MOST_SEED,
    Json,
    Next,
    OutFolder,
    Quiet,
    can_draw,
    emit,
    for_robots,
    option,
    renew,
)
from slipid.support.folder import locked
from slipid.support.progress import Reporter


@for_robots
def sample(
    out: OutFolder,
    data: Annotated[
        Path | None, option("DIR", "Folder of the logs, if it was moved since the fit.")
    ] = None,
    draws: Annotated[
        int,
        typer.Option(
            min=10,
            max=1_000_000,
            help="Number of draws to keep from each of the four ensembles of chains.",
        ),
    ] = 400,
    most: Annotated[
        int, typer.Option(min=40, max=1_000_000, help="Largest number of blocks of steps.")
    ] = 400,
    block: Annotated[
        int,
        typer.Option(
            min=1,
            max=10_000,
            hidden=True,
            help="Number of steps per block; the chain is saved after each block.",
        ),
    ] = 20,
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED)] = 0,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Sample the posterior of a fit with emcee, for more exact intervals."""
    from slipid.infer.posterior.blocks import Plan, require_packages
    from slipid.report.estimates import show_sample
    from slipid.support.files import read_json

    require_packages()
    from slipid.app.sample import OF_SAMPLE, WRITTEN
    from slipid.app.sample import sample as run

    with Reporter(quiet=quiet) as report, locked(out, "sample", *OF_SAMPLE):
        posterior, about = run(out, data, Plan(seed=seed, most=most, block=block), draws, report)
        written = [*WRITTEN]
        if can_draw(report):
            from slipid.plots.posterior import posterior_plots

            written += [path.name for path in posterior_plots(posterior, out)]
    content = read_json(out / "identified.json", "a result of `slipid sample`")
    shown = posterior.parameters.values(), about, content["messages"]
    following = [renew(out)]
    if not posterior.converged:
        words = ("sample", out, "--most", 2 * most)
        following = [Next("continue until it converges", words)]
    emit(json, content, lambda page: show_sample(page, *shown), following, out, written)
    return 0 if posterior.converged else 1
