"""`slipid paper`: regenerate the tables and figures of the 2021 paper from its own data."""

from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import Out, guarded, option


@guarded
def paper(
    data: Annotated[Path, option("DIR", "Folder that holds robotino2021.")],
    out: Out,
) -> int:
    """Regenerate the 2021 paper's tables and figures from its own data."""
    from slipid.lab.paper2021.plots import run

    for path in run(data, out):
        typer.echo(str(path))
    return 0
