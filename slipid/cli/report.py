"""`slipid report`: write the page of a result folder again."""

from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import Next, OutFolder, Quiet, for_robots, option, suggest
from slipid.support.folder import locked
from slipid.support.progress import Reporter


@for_robots
def report(
    out: OutFolder,
    data: Annotated[
        Path | None, option("DIR", "Folder of the logs, if it was moved since the fit.")
    ] = None,
    quiet: Quiet = False,
) -> int:
    """Write report.html again, with all that OUT has by now.

    The page shows the fit and whatever `sample`, `validate`, `compare`, `design`, `trial` and
    `export` have written to OUT since.
    """
    from slipid.report.html.fit_page import renew

    with Reporter(quiet=quiet) as progress, locked(out, "report", "report.html"):
        path = renew(out, data, progress)
    typer.echo(f"look at: {path}")
    suggest([Next("take it to the robot", ("export", out, "--out", out / "to_go"))])
    return 0
