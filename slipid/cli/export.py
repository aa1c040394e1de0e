"""`slipid export`: write an identified robot to a folder in forms that robots can load."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import Json, Load, Next, Quiet, emit, flag, for_robots, option
from slipid.support.content import Content
from slipid.support.folder import locked
from slipid.support.progress import Reporter


@for_robots
def export(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="OUT|ROBOT.json|DIR",
            help="Result folder of `slipid identify`, or a robot.json; with --check an exported "
            "folder.",
        ),
    ],
    to: Annotated[
        str, option("FORMS", "Forms separated by commas: c, ros2, stablehlo, table.")
    ] = "c,ros2,stablehlo,table",
    out: Annotated[Path | None, option("DIR", "Folder to write to.")] = None,
    controller: Annotated[
        str, option("NAME", "Controller: contact, slip_odometry, ... (as in `slipid trial`).")
    ] = "contact",
    path: Annotated[
        str, option("NAME", "Path that the example program in C follows.")
    ] = "rectangle",
    speed: Annotated[
        float, option("M_S", "Speed along the path, in m/s.", min=1e-3, max=100)
    ] = 0.2,
    load: Load = None,
    floors: Annotated[
        str, option("NAMES", "Floors that can occur, separated by commas; all by default.")
    ] = "",
    map: Annotated[
        Path | None, option("FILE", "Floor map, for the controller contact_map.")
    ] = None,
    recovery: Annotated[
        bool | None,
        typer.Option(
            "--recovery/--no-recovery",
            help="Whether a stuck robot tries to free itself; by default only with a gyro.",
        ),
    ] = None,
    check: Annotated[
        bool, flag("--check", "Only check that the files of an exported folder are unchanged.")
    ] = False,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Export an identified robot to a folder: robot.json, C99, ROS 2, StableHLO, tables of gains.

    The folder also gets a README and a checksum of every file. With --check nothing is written; the
    exit code is 2 if a file was changed.
    """
    from slipid.deploy.deploy import read_robot
    from slipid.deploy.export import ExportOptions
    from slipid.deploy.export import export as run
    from slipid.exports.folder import check_folder
    from slipid.lab.trial.controllers import ROWS
    from slipid.report.answers import show_export
    from slipid.support.errors import DataError
    from slipid.support.jax_setup import setup_jax

    setup_jax(quiet=True)
    if check:
        names = check_folder(source)
        if any(name.startswith("stablehlo/") for name in names):
            from slipid.exports.stablehlo import load_program

            load_program(source / "stablehlo")
        found: Content = {"schema": "slipid.export_check/1", "folder": str(source)}
        found |= {"files": list(names), "intact": True}
        intact = f"{source}: all {len(names)} files are unchanged"
        emit(json, found, lambda page: page.line(intact), [])
        return 0
    if out is None:
        raise DataError("--out is missing; expected a folder to write to")
    with Reporter(quiet=quiet) as report, locked(out, "export"):
        report.stage("reading the robot")
        robot = read_robot(source, load, _names(floors))
        options = ExportOptions(_names(to), controller, path, speed, map, recovery)
        done = run(robot, out, options, report, ROWS)
    content = {"schema": "slipid.export/1", **asdict(done), "folder": str(done.folder)}
    written = ["README.md", "robot.json", *(f"{form}/" for form in done.forms)]
    step = Next("on the robot, check that every file arrived", ("export", out, "--check"))
    emit(json, content, lambda page: show_export(page, done), [step], out, written)
    return 0


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())
