"""`slipid paper`: regenerate the tables and figures of the 2021 paper from the paper's data."""

from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import Out, guarded, option


@guarded
def paper(
    data: Annotated[Path, option("DIR", "Folder that contains the folder robotino2021.")],
    out: Out,
) -> int:
    """Regenerate the tables and figures of the 2021 paper from the paper's data."""
    from slipid.lab.paper2021.plots import run

    for path in run(data, out):
        typer.echo(str(path))
    return 0
