"""`slipid new`: write a config for a new robot."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipid.cli.common import flag, guarded, option

if TYPE_CHECKING:
    from slipid.app.new.config_text import NewConfig

_WHEELS = "For omni and general wheels"
_BOX = "For mecanum and skid"
Text = str | None


def _text(words: str, panel: str | None = None) -> object:
    return typer.Option(help=words, rich_help_panel=panel, show_default=False)


@guarded
def new(
    out: Annotated[Path, option("FILE", "Config to write.")] = Path("robot.toml"),
    log: Annotated[
        Path | None,
        option(
            "LOG", "A log (CSV, Parquet, bag) or a folder of logs to read; asks nothing.", "--from"
        ),
    ] = None,
    drive: Annotated[Text, _text("omni, mecanum, skid, differential or general.")] = None,
    wheel_radius_m: Annotated[Text, _text("Wheel radius.")] = None,
    gear_ratio: Annotated[Text, _text("Motor turns per wheel turn.")] = None,
    mass_kg: Annotated[Text, _text("Mass of the robot.")] = None,
    ticks_per_revolution: Annotated[
        Text, _text("Encoder ticks per motor turn; 0 where none are logged.")
    ] = None,
    wheelbase_m: Annotated[Text, _text("Front to rear axle.", _BOX)] = None,
    track_m: Annotated[
        Text, _text("Between left and right wheels; also of a differential drive.", _BOX)
    ] = None,
    shared: Annotated[
        Text, _text("yes where one motor turns both wheels of a side, else no.", _BOX)
    ] = None,
    wheels: Annotated[Text, _text("Number of omni wheels.", _WHEELS)] = None,
    azimuths_deg: Annotated[Text, _text("Where omni wheels stand, as 60,180,300.", _WHEELS)] = None,
    base_radius_m: Annotated[Text, _text("Omni wheels' centres from the middle.", _WHEELS)] = None,
    places_m: Annotated[
        Text, _text("General: x,y of the wheels, as '0.2,0.1; 0.2,-0.1'.", _WHEELS)
    ] = None,
    directions_deg: Annotated[
        Text, _text("General: directions of the wheels, as 0,0.", _WHEELS)
    ] = None,
    rollers_deg: Annotated[Text, _text("General: rollers to these, as 45,none.", _WHEELS)] = None,
    yes: Annotated[
        bool, flag("--yes", "Ask nothing: take defaults, marked in the config.")
    ] = False,
    force: Annotated[bool, flag("--force", "Overwrite.")] = False,
) -> int:
    """Write a commented config for your robot: asks for it, or reads its logs (--from)."""
    # Every argument that is a text describes the robot.
    options = {name: text for name, text in locals().items() if isinstance(text, str)}

    from slipid.app.new.config_text import new_config
    from slipid.app.new.draft import template_draft
    from slipid.app.new.propose import propose
    from slipid.app.new.robot_questions import ask
    from slipid.support.errors import DataError
    from slipid.support.files import write_bytes

    if out.exists() and not force:
        raise DataError(f"{out}: exists already; expected a new file, or --force")
    if log is None:
        draft = template_draft(ask(options, None if yes else _ask))
    else:
        draft = propose(log, options)
    for sentence in draft.sentences:
        typer.echo(sentence)
    config = new_config(draft, out.name)
    write_bytes(out, config.text.encode())
    _show(config, out, draft.data)
    return 0


def _ask(asks: str, default: str, wrong: str) -> str:
    """Return the user's answer to a question.

    Args:
        asks: the question.
        default: answer if the user only presses Enter.
        wrong: message about what is wrong with the previous answer; empty for the first.

    Raises:
        DataError: there is no answer, because the input has ended.
    """
    from slipid.support.errors import DataError

    if wrong:
        typer.echo(wrong, err=True)
    try:
        return str(typer.prompt(asks, default=default))
    except typer.Abort:
        if wrong:
            raise DataError(f"{asks}: {wrong}") from None
        raise DataError(
            f"{asks}: no answer; expected one, an option with it (slipid new --help), "
            "or --yes for the defaults"
        ) from None


def _show(config: "NewConfig", out: Path, data: str) -> None:
    """Print a drawing of the robot, the open questions, and the next command."""
    typer.echo(f"\n{config.drawing}\n")
    if config.questions:
        typer.echo(f'{out} has open questions, lines that begin with "# ?":')
        for question in config.questions:
            typer.echo(f"  ? {question}")
        typer.echo("answer them, then run")
    else:
        typer.echo(f"{out} is complete; run")
    typer.echo(f"  slipid check {out} --data {data}")
    typer.echo("or, before anything is driven, see what a plan of runs would identify:")
    typer.echo(f"  slipid selftest {out}")
