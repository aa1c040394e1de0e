"""`slipid floors`: find the floor under each wheel in logged runs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from slipid.cli.common import (
    DataFolder,
    Json,
    Next,
    Out,
    OutFolder,
    Quiet,
    emit,
    for_robots,
    option,
)
from slipid.support.content import Content
from slipid.support.folder import locked
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from slipid.report.page import Page


MOST_BEYOND = 0.05
"""The exit code is 1 if more than this fraction of the wheel positions is outside the map [1]."""


@for_robots
def floors(
    fitted: OutFolder,
    map: Annotated[Path, option("FILE", "Floor map, as written by `slipid map`.")],
    data: DataFolder,
    out: Out,
    logs: Annotated[
        str | None,
        option("GLOB", "Glob of the logs; by default the logs with a map in the config."),
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Find the floor under each wheel in logged runs, and its distance to the nearest border.

    The poses are corrected with the camera parameters of the fit. A CSV file is written for each
    run. The exit code is 1 if wheels are often outside the map.
    """
    from slipid.app.floors import floors_under, summary, write_floors
    from slipid.support.jax_setup import setup_jax

    setup_jax(quiet=True)
    with Reporter(quiet=quiet) as report, locked(out, "floors"):
        lookup, runs = floors_under(fitted, map, data, logs, report)
        written = write_floors(out, lookup, runs)
    content = summary(lookup, runs)
    step = Next(
        "try the controllers on this floor", ("trial", fitted, "--plant", "twin", "--map", map)
    )
    files = [f"{len(written)} CSV files"]
    emit(json, content, lambda page: show(page, content), [step], out, files)
    return 0 if content["beyond_the_map"] <= MOST_BEYOND else 1


def show(page: "Page", content: Content) -> None:
    """Print, for each run, the percentage of the time that each floor was under each wheel."""
    from slipid.report.page import table

    shares = table(("run", *content["surfaces"]), "percentage of the time, for wheel 1, 2, ...")
    for name, run in content["runs"].items():
        shares.add_row(name, *(" ".join(f"{100 * v:3.0f}" for v in row) for row in run.values()))
    page.table(shares)
    beyond = content["beyond_the_map"]
    page.line(f"{100 * beyond:.1f} % of the wheel positions are outside the map")
