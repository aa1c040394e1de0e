"""`slipid new`: a config for a robot that nobody has described yet."""

from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import guarded


@guarded
def new(
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Config to write.")] = Path(
        "robot.toml"
    ),
    drive: Annotated[str, typer.Option(help="omni, mecanum or skid.")] = "omni",
    wheel_radius_m: Annotated[float, typer.Option(prompt="wheel radius [m]")] = 0.05,
    base_m: Annotated[
        float, typer.Option(prompt="wheel centres from the middle [m] (omni: radius)")
    ] = 0.15,
    gear_ratio: Annotated[float, typer.Option(prompt="motor turns per wheel turn")] = 1.0,
    mass_kg: Annotated[float, typer.Option(prompt="mass [kg]")] = 10.0,
    ticks_per_revolution: Annotated[
        float, typer.Option(prompt="encoder ticks per motor turn")
    ] = 1000.0,
    force: Annotated[bool, typer.Option("--force", help="Overwrite.")] = False,
) -> int:
    """Write a commented config for your robot; asks what it needs to know."""
    from slipid.job.new import write_new

    robot = drive, wheel_radius_m, base_m, gear_ratio, mass_kg, ticks_per_revolution
    write_new(out, *robot, force)
    typer.echo(f"{out}: name your columns below [layouts.mine.columns], then run")
    typer.echo(f"  slipid check {out} --data DIR")
    typer.echo("or, before anything is driven, see what a plan of runs would tell:")
    typer.echo(f"  slipid selftest {out}")
    return 0
