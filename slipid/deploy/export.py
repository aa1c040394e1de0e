"""From robot.json to a folder for a robot, with a run of its path that was driven on the twin."""

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
from slipid.export.c99.folder import Recording, c_files
from slipid.export.c99.lower import UnsupportedError
from slipid.export.description import readme, warnings
from slipid.export.folder import check_folder, check_writable, write_folder
from slipid.export.ros.folder import ros2_files
from slipid.export.stablehlo import load_program, stablehlo_files
from slipid.export.table import table_files
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
    """What is to be exported.

    Attributes:
        forms: of `FORMS`; controller: row of the trial.
        path: that the example in C follows; speed: along it [m/s].
        map: file of a floor map, for a controller that is told one.
    """

    forms: Sequence[str] = FORMS
    controller: str = "contact"
    path: str = "rectangle"
    speed: float = 0.2
    map: Path | None = None


@dataclass(frozen=True)
class Exported:
    """A folder that was written.

    Attributes:
        folder: it; files: their names; robot: hash of the robot's numbers.
        forms: that are in it; warnings: of numbers that are not identified.
    """

    folder: Path
    files: tuple[str, ...]
    robot: str
    forms: tuple[str, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class ExampleStart:
    """Where the example is driven.

    Attributes:
        floor: map of it; true: pose there from which the robot starts.
        believed: the same as the robot has it: its own axes where it is told no map.
    """

    floor: FloorMap
    true: tuple[float, float, float]
    believed: tuple[float, float, float]


def _place(robot: DeployedRobot, path: trajectory.Path, file: Path | None) -> ExampleStart:
    """Patches of the robot's floors, or what a map shows; DataError if it shows other floors."""
    floor = twin_floor(robot) if file is None else read_map(file)
    require_known_surfaces(floor, robot, str(file))
    begin = starts(20, floor, path)[0]
    return ExampleStart(floor, begin, (0.0, 0.0, 0.0) if file is None else begin)


def robot_at(source: Path, load: str | None, floors: Sequence[str]) -> DeployedRobot:
    """The robot of a file, or of the folder that `slipid identify` wrote.

    Raises:
        DataError: there is none, it is damaged, or has no such load set-up or floor.
    """
    is_file = source.suffix == ".json"
    path = source if is_file else source / ROBOT
    robot = (
        require_steering(path, DeployedRobot.load(path, load))
        if is_file
        else read_robot(source, load)
    )
    try:
        return robot.on(*floors) if floors else robot
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error


def export(
    robot: DeployedRobot,
    out: Path,
    wish: ExportOptions,
    report: Reporter,
    rows: Mapping[str, ControllerRow] = CONTROLLERS,
) -> Exported:
    """Write a robot in all wanted forms to a folder, with one of the controllers `rows`.

    Raises:
        DataError: no such form, controller or path; a step that has no form in C; nothing can be
            written there, or other files lie there.
    """
    if not wish.forms:
        raise DataError(f"no form; expected one or more of {', '.join(FORMS)}")
    for name in wish.forms:
        if name not in FORMS:
            raise DataError(
                f"no form '{name}'{did_you_mean(name, FORMS)}; expected {', '.join(FORMS)}"
            )
    if wish.controller not in rows:
        close = did_you_mean(wish.controller, rows)
        choices = ", ".join(rows)
        raise DataError(f"no controller '{wish.controller}'{close}; expected one of {choices}")
    row = rows[wish.controller]
    if row.mapped != (wish.map is not None):
        told = "the map of its floors; name one with --map"
        none = "no map; leave out --map, or take contact_map"
        raise DataError(f"controller {wish.controller} is told {told if row.mapped else none}")
    check_writable(out)
    path = path_of(wish.path, wish.speed, robot)
    place = _place(robot, path, wish.map)
    pilot = control_loop_of(robot, row, floor=floor_of(place.floor, robot.labels))
    path = path.moved(place.believed).waiting(REST_S)
    content: dict[str, bytes] = {"robot.json": robot_bytes(robot.record)}
    forms = tuple(form for form in FORMS if form in wish.forms)
    for form in forms:
        report.stage(f"writing {form}")
        files = _form(form, robot, pilot, path, wish, place, row.gyro)
        content |= {f"{form}/{name}": data for name, data in files.items()}
    content["README.md"] = readme(robot, forms, wish.controller).encode()
    write_folder(out, content)
    report.stage("checking what was written")
    check_folder(out)
    if "stablehlo" in forms:
        load_program(out / "stablehlo")
    return Exported(out, tuple(content), robot.record.numbers, forms, warnings(robot))


def _form(
    form: str,
    robot: DeployedRobot,
    pilot: ControlLoop[eqx.Module],
    path: trajectory.Path,
    wish: ExportOptions,
    place: ExampleStart,
    gyro: bool,
) -> dict[str, bytes]:
    if form == "stablehlo":
        return stablehlo_files(pilot)
    if form == "c":
        try:
            text = c_files(
                robot, pilot, path, record_example(robot, pilot, path, wish, place, gyro)
            )
        except UnsupportedError as error:
            raise DataError(f"controller {wish.controller}: {error}") from error
    else:
        text = ros2_files(robot) if form == "ros2" else table_files(robot)
    return {name: data.encode() for name, data in text.items()}


class _RecordingPlant:
    """A plant whose readings are kept."""

    def __init__(self, plant: Plant, wheels: int):
        self._plant, self._wheels = plant, wheels
        self.readings: list[Readings] = []

    def reset(self) -> Readings:
        return self._kept(self._plant.reset())

    def step(self, wheel_speed: Float[np.ndarray, " wheel"]) -> Readings:
        return self._kept(self._plant.step(wheel_speed))

    @property
    def pose(self) -> tuple[float, float, float]:
        return self._plant.pose

    def _kept(self, reading: Measurement | Readings) -> Readings:
        self.readings.append(reading.filled(self._wheels))
        return self.readings[-1]


def record_example(
    robot: DeployedRobot,
    pilot: ControlLoop[eqx.Module],
    path: trajectory.Path,
    wish: ExportOptions,
    place: ExampleStart,
    gyro: bool = False,
) -> Recording:
    """A run of a path, as it lies for the robot's start, on the twin."""
    habits = actuator_model_of(robot, gyro=gyro)
    plant = _RecordingPlant(twin_plant(robot, place.floor, place.true, 0, habits), robot.wheels)
    course = run_closed_loop(pilot, path, plant, place.believed)
    given = [
        np.concatenate([[PERIOD], *(np.ravel(x) for x in jax.tree.leaves(reading))])
        for reading in plant.readings[: len(course.command)]
    ]
    about = f"the identified model as a plant, with delays and noise, along the path {wish.path}"
    return Recording(about, place.believed, np.array(given), course.command, course.own)
