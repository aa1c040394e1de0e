"""Export of robot.json to a folder for a robot, with an example run driven on the twin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from slipid.data.floor_map import FloorMap, read_map
from slipid.deploy.controllers import CONTROLLERS, ControllerRow, control_loop_of
from slipid.deploy.deploy import ROBOT, actuator_model_of, read_robot, require_steering
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
from slipid.exports.c99.lower import UnsupportedError
from slipid.exports.description import readme, warnings
from slipid.exports.folder import check_folder, check_writable, write_folder
from slipid.exports.ros.folder import ros2_files
from slipid.exports.stablehlo import load_program, stablehlo_files
from slipid.exports.table import table_files
from slipid.robot import trajectory
from slipid.robot.closed_loop import PERIOD, ControlLoop, Plant, run_closed_loop
from slipid.robot.deployed import DeployedRobot
from slipid.robot.interface import Measurement, Readings
from slipid.robot.robot_file import robot_bytes
from slipid.support.errors import DataError, did_you_mean
from slipid.support.progress import Reporter

FORMS = ("c", "ros2", "stablehlo", "table")


@dataclass(frozen=True)
class ExportOptions:
    """Choices of an export.

    Attributes:
        forms: forms to write, each one of `FORMS`.
        controller: name of a row of `CONTROLLERS`, or of another table of rows.
        path: name of the path that the example in C follows.
        speed: speed along the path [m/s].
        map: file of a floor map for a controller that uses one; None without a map.
    """

    forms: Sequence[str] = FORMS
    controller: str = "contact"
    path: str = "rectangle"
    speed: float = 0.2
    map: Path | None = None


@dataclass(frozen=True)
class Exported:
    """A folder that an export wrote.

    Attributes:
        folder: path of the folder.
        files: names of its files.
        robot: hash of the robot's numbers.
        forms: forms that it contains.
        warnings: warnings about numbers that are not identified, at a bound or disputed.
    """

    folder: Path
    files: tuple[str, ...]
    robot: str
    forms: tuple[str, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class ExampleStart:
    """Site and start of the example run.

    Attributes:
        floor: map of the site.
        true: pose on the map at which the robot starts [m, m, rad].
        estimated: pose at which its estimator starts [m, m, rad]: the true one with a map, else the
            origin.
    """

    floor: FloorMap
    true: tuple[float, float, float]
    estimated: tuple[float, float, float]


def _example_start(robot: DeployedRobot, path: trajectory.Path, file: Path | None) -> ExampleStart:
    """Return site and start of the example run.

    The site is made of patches of the robot's floors, or is the map in a file, which must not
    contain other floors.
    """
    floor = twin_floor(robot) if file is None else read_map(file)
    require_known_surfaces(floor, robot, str(file))
    pose = starts(20, floor, path)[0]
    return ExampleStart(floor, pose, (0.0, 0.0, 0.0) if file is None else pose)


def robot_at(source: Path, load: str | None, floors: Sequence[str]) -> DeployedRobot:
    """Return the robot in a file, or in a folder that `slipid identify` wrote.

    Raises:
        DataError: there is no robot, its file is damaged, or it has no such load set-up or floor.
    """
    is_file = source.suffix == ".json"
    path = source if is_file else source / ROBOT
    if is_file:
        robot = require_steering(path, DeployedRobot.load(path, load))
    else:
        robot = read_robot(source, load)
    try:
        return robot.on(*floors) if floors else robot
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error


def export(
    robot: DeployedRobot,
    out: Path,
    options: ExportOptions,
    report: Reporter,
    rows: Mapping[str, ControllerRow] = CONTROLLERS,
) -> Exported:
    """Write a robot, with one of the controllers `rows`, in all requested forms to a folder.

    Raises:
        DataError: there is no such form, controller or path, a step cannot be turned into C, or the
            folder cannot be written or contains other files.
    """
    row = _checked_row(options, rows)
    check_writable(out)
    path = path_of(options.path, options.speed, robot)
    start = _example_start(robot, path, options.map)
    loop = control_loop_of(robot, row, floor=floor_of(start.floor, robot.labels))
    path = path.moved(start.estimated).after_rest(REST_S)
    content: dict[str, bytes] = {"robot.json": robot_bytes(robot.record)}
    forms = tuple(form for form in FORMS if form in options.forms)
    for form in forms:
        report.stage(f"writing {form}")
        if form == "stablehlo":
            files = stablehlo_files(loop)
        elif form == "c":
            run = record_example(robot, loop, path, options, start, row.gyro)
            files = _c_files(robot, loop, path, run, options.controller)
        else:
            text = ros2_files(robot) if form == "ros2" else table_files(robot)
            files = {name: data.encode() for name, data in text.items()}
        content |= {f"{form}/{name}": data for name, data in files.items()}
    content["README.md"] = readme(robot, forms, options.controller).encode()
    write_folder(out, content)
    report.stage("checking what was written")
    check_folder(out)
    if "stablehlo" in forms:
        load_program(out / "stablehlo")
    return Exported(out, tuple(content), robot.record.numbers, forms, warnings(robot))


def _checked_row(options: ExportOptions, rows: Mapping[str, ControllerRow]) -> ControllerRow:
    """Return the row of the chosen controller; raise `DataError` for options that do not fit."""
    if not options.forms:
        raise DataError(f"no form; expected one or more of {', '.join(FORMS)}")
    for name in options.forms:
        if name not in FORMS:
            raise DataError(
                f"no form '{name}'{did_you_mean(name, FORMS)}; expected {', '.join(FORMS)}"
            )
    controller = options.controller
    if controller not in rows:
        close, choices = did_you_mean(controller, rows), ", ".join(rows)
        raise DataError(f"no controller '{controller}'{close}; expected one of {choices}")
    row = rows[controller]
    if row.mapped and options.map is None:
        raise DataError(f"controller {controller} needs the map of its floors; name one with --map")
    if options.map is not None and not row.mapped:
        raise DataError(
            f"controller {controller} uses no map; leave out --map, or take contact_map"
        )
    return row


def _c_files(
    robot: DeployedRobot,
    loop: ControlLoop[eqx.Module],
    path: trajectory.Path,
    run: Recording,
    controller: str,
) -> dict[str, bytes]:
    """Return the content of the C folder; raise `DataError` if a step cannot be turned into C."""
    try:
        text = c_files(robot, loop, path, run)
    except UnsupportedError as error:
        raise DataError(f"controller {controller}: {error}") from error
    return {name: data.encode() for name, data in text.items()}


class _RecordingPlant:
    """A plant that records its readings in the list `readings`."""

    def __init__(self, plant: Plant, wheels: int):
        self._plant, self._wheels = plant, wheels
        self.readings: list[Readings] = []

    def reset(self) -> Readings:
        return self._record(self._plant.reset())

    def step(self, wheel_speed: Float[np.ndarray, " wheel"]) -> Readings:
        return self._record(self._plant.step(wheel_speed))

    @property
    def pose(self) -> tuple[float, float, float]:
        return self._plant.pose

    def _record(self, reading: Measurement | Readings) -> Readings:
        self.readings.append(reading.filled(self._wheels))
        return self.readings[-1]


def record_example(
    robot: DeployedRobot,
    loop: ControlLoop[eqx.Module],
    path: trajectory.Path,
    options: ExportOptions,
    start: ExampleStart,
    gyro: bool = False,
) -> Recording:
    """Return a closed-loop run on the twin along a path that begins at the estimator's start."""
    model = actuator_model_of(robot, gyro=gyro)
    plant = _RecordingPlant(twin_plant(robot, start.floor, start.true, 0, model), robot.wheels)
    run = run_closed_loop(loop, path, plant, start.estimated)
    inputs = [
        np.concatenate([[PERIOD], *(np.ravel(x) for x in jax.tree.leaves(reading))])
        for reading in plant.readings[: len(run.command)]
    ]
    about = f"the identified model as a plant, with delays and noise, along the path {options.path}"
    return Recording(about, start.estimated, np.array(inputs), run.command, run.path_time)
