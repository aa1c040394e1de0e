"""`slipid new` and `slipid reference`: write a new robot's config, and list a config's keys."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipid.cli.common import Next, flag, guarded, option, suggest

if TYPE_CHECKING:
    from slipid.app.new.config_text import NewConfig

_WHEELS = "For omni, steered and general wheels"
_BOX = "For mecanum and skid"
_LIMITS = "Limits of a controller; by default those that the logs show"
Text = str | None


def _text(words: str, panel: str | None = None) -> object:
    return typer.Option(help=words, metavar="VALUE", rich_help_panel=panel, show_default=False)


@guarded
def new(
    out: Annotated[Path, option("FILE", "Config file to write.")] = Path("robot.toml"),
    log: Annotated[
        Path | None,
        option(
            "LOG",
            "Log (CSV, Parquet, bag) or folder of logs to read, instead of asking questions.",
            "--from",
        ),
    ] = None,
    robot: Annotated[
        Text,
        _text("Reference robot that gives sizes and start values; `slipid robots` lists them."),
    ] = None,
    drive: Annotated[
        Text,
        _text("Type of the wheels: omni, mecanum, skid, differential, steered or general."),
    ] = None,
    wheel_radius_m: Annotated[Text, _text("Wheel radius.")] = None,
    gear_ratio: Annotated[Text, _text("Motor turns per wheel turn.")] = None,
    mass_kg: Annotated[Text, _text("Mass of the robot.")] = None,
    ticks_per_revolution: Annotated[
        Text, _text("Encoder ticks per motor turn; 0 if no ticks are logged.")
    ] = None,
    speed_m_s: Annotated[Text, _text("Highest speed of the body.", _LIMITS)] = None,
    yaw_rate_rad_s: Annotated[Text, _text("Highest yaw rate of the body.", _LIMITS)] = None,
    acceleration_m_s2: Annotated[
        Text, _text("Highest acceleration of the rim of a wheel.", _LIMITS)
    ] = None,
    wheel_speed_rad_s: Annotated[Text, _text("Highest speed of a wheel.", _LIMITS)] = None,
    voltage_v: Annotated[Text, _text("Voltage of the supply.", _LIMITS)] = None,
    wheelbase_m: Annotated[
        Text, _text("Distance between front and rear axle; also for steered.", _BOX)
    ] = None,
    track_m: Annotated[
        Text, _text("Distance between left and right wheels; also for a differential drive.", _BOX)
    ] = None,
    shared: Annotated[
        Text, _text("Enter yes if one motor drives both wheels of a side, otherwise no.", _BOX)
    ] = None,
    driven: Annotated[
        Text, _text("Steered: axle with the encoders, rear or front.", _WHEELS)
    ] = None,
    encoders: Annotated[Text, _text("Steered: number of encoders on it.", _WHEELS)] = None,
    wheels: Annotated[Text, _text("Number of omni wheels.", _WHEELS)] = None,
    azimuths_deg: Annotated[
        Text, _text("Directions of the omni wheels from the middle, such as 60,180,300.", _WHEELS)
    ] = None,
    base_radius_m: Annotated[
        Text, _text("Distance of the omni wheels from the middle.", _WHEELS)
    ] = None,
    places_m: Annotated[
        Text, _text("General: x,y of the wheels, such as '0.2,0.1; 0.2,-0.1'.", _WHEELS)
    ] = None,
    directions_deg: Annotated[
        Text, _text("General: drive directions of the wheels, such as 0,0.", _WHEELS)
    ] = None,
    rollers_deg: Annotated[
        Text, _text("General: angles of the rollers to the drives, such as 45,none.", _WHEELS)
    ] = None,
    yes: Annotated[
        bool, flag("--yes", "Do not ask: use defaults, which are marked in the config.")
    ] = False,
    force: Annotated[bool, flag("--force", "Overwrite an existing file.")] = False,
) -> int:
    """Write a commented config for your robot, from your answers to questions or from its logs."""
    # collect the arguments that are strings: exactly these describe the robot
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
    for remark in (line for layout in draft.layouts for line in layout.remarks):
        typer.echo(f"  {remark}")
    config = new_config(draft, out.name)
    write_bytes(out, config.text.encode())
    _show(config, out, draft.data)
    return 0


def _ask(asks: str, default: str, wrong: str) -> str:
    """Return the user's answer to a question.

    Args:
        asks: the question.
        default: answer that is used if the user only presses Enter.
        wrong: error message about the previous answer to this question; empty the first time.

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
            f"{asks}: no answer; expected an answer, an option that gives it (slipid new --help), "
            "or --yes for the defaults"
        ) from None


def _show(config: "NewConfig", out: Path, data: str) -> None:
    """Print a drawing of the robot, the open questions, and the next command."""
    typer.echo(f"\n{config.drawing}\n")
    if config.questions:
        typer.echo(f'{out} has open questions, lines that begin with "# ?":')
        for question in config.questions:
            typer.echo(f"  ? {question}")
    else:
        typer.echo(f"{out} is complete")
    purpose = "after answering them, check the logs" if config.questions else "check the logs"
    following = [Next(purpose, ("check", out, "--data", data))]
    if config.simulated:
        plan = "or, before driving, simulate which parameters a plan of runs would identify"
        following.append(Next(plan, ("selftest", out)))
    suggest(following)


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
