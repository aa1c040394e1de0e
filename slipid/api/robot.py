"""Functions `drive` and `export`, which simulate a deployed robot and export it for real robots."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from slipid.data.floor_map import FloorMap, read_map
from slipid.deploy.controllers import centre_of, control_loop_of
from slipid.deploy.deploy import actuator_model_of
from slipid.deploy.export import FORMS, Exported, ExportOptions
from slipid.deploy.export import export as run
from slipid.deploy.floors import floor_of
from slipid.deploy.twin_run import (
    REST_S,
    path_of,
    require_known_surfaces,
    starts,
    twin_floor,
    twin_plant,
)
from slipid.lab.trial.controllers import ROWS, TruePosePlant
from slipid.robot import closed_loop
from slipid.robot.controller import NO_CONTROLLER
from slipid.robot.deployed import DeployedRobot
from slipid.support.progress import Reporter


@dataclass(frozen=True, eq=False)
class DriveResult:
    """Result of one closed-loop run; `print` shows the errors of the robot along the path.

    Attributes:
        run: path, true and estimated poses, commands and estimates, with a row for each control
            period.
        floor: map of the floor.
        metrics: errors of the true poses relative to the path.
    """

    run: closed_loop.ClosedLoopRun
    floor: FloorMap
    metrics: closed_loop.PathMetrics

    @property
    def course(self) -> closed_loop.ClosedLoopRun:
        """Older name of `run`."""
        return self.run

    def __str__(self) -> str:
        m = self.metrics
        ended = "ends" if m.finished else "was given up; plus the path that remained, it ends"
        return (
            f"{ended} {m.closure_mm:.0f} mm from the end of the path, with a heading error of "
            f"{m.heading_error_deg:+.1f} deg; cross-track error {m.cross_track_rmse_mm:.0f} mm "
            "(rms)"
        )


def drive(
    robot: DeployedRobot,
    controller: str = "contact",
    *,
    map: Path | str | None = None,
    path: str = "rectangle",
    speed: float = 0.2,
    start: int = 0,
    seed: int = 0,
) -> DriveResult:
    """Return a closed-loop run of a robot's twin along the 2021 paper's rectangle or another path.

    The twin is the identified model as a plant, with delays and sensor noise.

    Args:
        robot: robot from `deploy()` of a fit or a posterior, or from `DeployedRobot.load`.
        controller: name of a controller of `slipid trial`: `encoder`, `contact`, `contact_map`,
            `contact_gyro`, ...
        map: path of a floor map; by default a random map of patches of the robot's floors.
        path: `rectangle`, `circle`, `eight` or `clothoid`; `turning` for a robot that drives
            sideways.
        speed: speed along the path [m/s].
        start: index of one of twenty start poses on the map, from 0.
        seed: seed of the sensors' noise.

    Raises:
        ValueError: there is no such controller or start, or no controller for the robot's wheels.
        DataError: there is no such path or map, the speed is higher than that of any fitted run,
            or the map has a floor that was not identified.
    """
    if not robot.has_controller:
        raise ValueError(NO_CONTROLLER)
    common = path_of(path, speed, robot)
    floor = twin_floor(robot) if map is None else read_map(Path(map))
    require_known_surfaces(floor, robot, str(map))
    places = starts(20, floor, common)
    if controller not in ROWS or not 0 <= start < len(places):
        names = ", ".join(ROWS)
        raise ValueError(
            f"unknown controller '{controller}' or start {start}; expected one of {names}, and a "
            "start from 0 to 19"
        )
    row, begin = ROWS[controller], places[start]
    plant: closed_loop.Plant
    plant = twin_plant(robot, floor, begin, seed, actuator_model_of(robot, gyro=row.gyro))
    if row.true_pose:
        plant = TruePosePlant(plant)
    loop = control_loop_of(robot, row, floor=floor_of(floor, robot.labels))
    reference = path_of(path, speed, robot, centre_of(row, robot))
    driven = closed_loop.run_closed_loop(
        loop, reference.moved(begin).after_rest(REST_S), plant, begin
    )
    return DriveResult(driven, floor, closed_loop.path_metrics(driven))


def export(
    robot: DeployedRobot,
    folder: Path | str,
    to: Sequence[str] = FORMS,
    *,
    controller: str = "contact",
    path: str = "rectangle",
    speed: float = 0.2,
    map: Path | str | None = None,
    recovery: bool | None = None,
) -> Exported:
    """Write a robot to a folder: robot.json, a README, checksums, and the exported forms.

    Args:
        robot: robot from `deploy()` of a fit or a posterior, or from `DeployedRobot.load`; its
            method `on(...)` selects some of its floors.
        folder: new or empty folder, or the folder of an older export, which is replaced.
        to: forms to write: `c` (C99 code of the estimator's and the controller's step), `ros2`
            (parameters with the names of ros2_controllers and robot_localization), `stablehlo`,
            `table` (Markdown and CSV).
        controller: name of a controller of `slipid trial`.
        path: path that the example in C follows.
        speed: speed along the path [m/s].
        map: path of a floor map, which the controller `contact_map` needs.
        recovery: whether a stuck robot tries to free itself; by default only with a gyro.

    Raises:
        DataError: there is no such form, controller or path, a step cannot be converted to C, or
            the folder has other files.
    """
    file = None if map is None else Path(map)
    options = ExportOptions(tuple(to), controller, path, speed, map=file, recovery=recovery)
    return run(robot, Path(folder), options, Reporter(quiet=True), ROWS)
