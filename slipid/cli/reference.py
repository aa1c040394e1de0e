"""`slipid reference`: print every key of a config, from the code that checks configs."""

from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import guarded, option


@guarded
def reference(
    what: Annotated[
        str | None,
        typer.Argument(
            metavar="[WHAT]",
            help="Part to print: config, drives, layouts, channels, units, presets or parameters; "
            "all by default.",
        ),
    ] = None,
    config: Annotated[
        Path | None, option("CONFIG", "Config of the robot whose parameters are listed.")
    ] = None,
) -> int:
    """Print every key, channel, unit and parameter of configs, with meanings (Markdown)."""
    from slipid.app.config import read_config
    from slipid.app.reference.page import reference

    typer.echo(reference(what, None if config is None else read_config(config)), nl=False)
    return 0
