"""Export of a robot to a folder of files in several forms, with an example run on its twin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from slipid.data.floor_map import read_map
from slipid.deploy.controllers import CONTROLLERS, ControllerRow, centre_of, control_loop_of
from slipid.deploy.deploy import actuator_model_of
from slipid.deploy.floors import floor_of
from slipid.deploy.twin_run import (
    REST_S,
    path_of,
    require_known_surfaces,
    starts,
    twin_floor,
    twin_plant,
)
from slipid.exports.c99.folder import Recording, c_files
from slipid.exports.description import readme, table_files, warnings
from slipid.exports.folder import check_folder, check_writable, write_folder
from slipid.exports.ros.folder import ros2_files
from slipid.exports.stablehlo import load_program, stablehlo_files
from slipid.robot import trajectory
from slipid.robot.closed_loop import ControlLoop, run_closed_loop
from slipid.robot.deployed import DeployedRobot
from slipid.robot.interface import PERIOD
from slipid.robot.robot_file import robot_bytes
from slipid.robot.twin import TwinPlant
from slipid.support.errors import DataError, did_you_mean
from slipid.support.progress import Reporter

FORMS = ("c", "ros2", "stablehlo", "table")
"""Forms of a robot that can be exported, see `slipid.exports.description.ABOUT`."""
WRITING_C_S = 40.0
"""Usual time in which the example is driven and the step is traced and written as C [s]."""


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export.

    Attributes:
        forms: forms to write, each one of `FORMS`.
        controller: name of a controller, which is a key of the argument `rows` of `export`.
        path: name of the path that the example in C follows.
        speed: speed along the path [m/s].
        map: file of a floor map for a controller that uses one; None without a map.
        recovery: whether a stuck robot tries to free itself; None to do so only with a gyro.
    """

    forms: Sequence[str] = FORMS
    controller: str = "contact"
    path: str = "rectangle"
    speed: float = 0.2
    map: Path | None = None
    recovery: bool | None = None


@dataclass(frozen=True)
class Exported:
    """A folder that an export wrote.

    Attributes:
        folder: path of the folder.
        files: names of the folder's files.
        robot: hash of the robot's parameters.
        forms: forms that the folder contains.
        warnings: warnings about parameters that are not identified, at a bound or disputed.
    """

    folder: Path
    files: tuple[str, ...]
    robot: str
    forms: tuple[str, ...]
    warnings: tuple[str, ...]


def export(
    robot: DeployedRobot,
    out: Path,
    options: ExportOptions,
    report: Reporter,
    rows: Mapping[str, ControllerRow] = CONTROLLERS,
) -> Exported:
    """Write a robot, with one of the controllers `rows`, in all requested forms to a folder.

    Raises:
        DataError: there is no such form, controller or path, the speed is too high, the map has an
            unknown surface, a step cannot be converted to C, or the folder cannot be written or
            contains other files.
    """
    row = _checked_row(options, rows)
    check_writable(out)
    floor = twin_floor(robot) if options.map is None else read_map(options.map)
    require_known_surfaces(floor, robot, str(options.map))
    loop = control_loop_of(robot, row, floor=floor_of(floor, robot.labels))
    path = path_of(options.path, options.speed, robot, centre_of(row, robot))
    place = starts(20, floor, path)[0]
    start = (0.0, 0.0, 0.0) if options.map is None else place
    if options.recovery is not None:
        loop = eqx.tree_at(lambda x: x.controller.recovery, loop, jnp.asarray(options.recovery))
    path = path.moved(start).after_rest(REST_S)
    content: dict[str, bytes] = {"robot.json": robot_bytes(robot.record)}
    forms = tuple(form for form in FORMS if form in options.forms)
    for form in forms:
        report.stage(f"writing {form}", usual_s=WRITING_C_S if form == "c" else None)
        files: Mapping[str, str | bytes]
        if form == "c":
            plant = twin_plant(robot, floor, place, 0, actuator_model_of(robot, gyro=row.gyro))
            run = record_example(loop, path, plant, start, options.path)
            files = c_files(robot, loop, path, run)
        elif form == "stablehlo":
            files = stablehlo_files(loop)
        else:
            files = ros2_files(robot) if form == "ros2" else table_files(robot)
        for name, data in files.items():
            content[f"{form}/{name}"] = data if isinstance(data, bytes) else data.encode()
    content["README.md"] = readme(robot, forms, options.controller).encode()
    write_folder(out, content)
    report.stage("checking what was written")
    check_folder(out)
    if "stablehlo" in forms:
        load_program(out / "stablehlo")
    return Exported(out, tuple(content), robot.record.numbers, forms, warnings(robot))


def _checked_row(options: ExportOptions, rows: Mapping[str, ControllerRow]) -> ControllerRow:
    """Return the row of the chosen controller; raise `DataError` for inconsistent options."""
    if not options.forms:
        raise DataError(f"no form is given; expected one or more of {', '.join(FORMS)}")
    for name in options.forms:
        if name not in FORMS:
            raise DataError(
                f"no form '{name}'{did_you_mean(name, FORMS)}; expected one of {', '.join(FORMS)}"
            )
    controller = options.controller
    if controller not in rows:
        close, choices = did_you_mean(controller, rows), ", ".join(rows)
        raise DataError(f"no controller '{controller}'{close}; expected one of {choices}")
    row = rows[controller]
    if row.mapped and options.map is None:
        raise DataError(f"controller {controller} needs a map of the floors; give one with --map")
    if options.map is not None and not row.mapped:
        raise DataError(
            f"controller {controller} does not use a map; omit --map, or use --controller "
            "contact_map"
        )
    return row


def record_example(
    loop: ControlLoop[eqx.Module],
    path: trajectory.Path,
    plant: TwinPlant,
    start: tuple[float, float, float],
    name: str,
) -> Recording:
    """Return a closed-loop run on the twin, with the readings of its sensors.

    Args:
        loop: estimator and controller.
        path: path that begins at `start`.
        plant: the twin.
        start: pose at which the estimator starts [m, m, rad].
        name: name of the path, for the description of the recording.
    """
    run = run_closed_loop(loop, path, plant, start)
    readings = [plant.reset(), *map(plant.step, run.command[:-1])]
    inputs = [
        np.concatenate([[PERIOD], *(np.ravel(x) for x in jax.tree.leaves(reading))])
        for reading in readings
    ]
    about = f"the identified model as a plant, with delays and noise, along the path {name}"
    return Recording(about, start, np.array(inputs), run.command, run.path_time)
