"""A ROS 2 folder of an identified robot: drive controller, localization, parameters, README.

All numbers in YAML files are written with all digits, so that they are read back exactly.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slipid.exports.description import (
    PROVENANCES,
    VERDICTS,
    gains_origin,
    header,
    in_markdown,
    number_rows,
)
from slipid.exports.ros import localization, node
from slipid.exports.ros import localization as noise
from slipid.exports.ros.drive import MOST, DriveController, drive_controller_of, joint
from slipid.exports.ros.localization import (
    DISTANCE_M,
    PERIOD_S,
    OdometryErrors,
    diagonal,
    odometry_errors,
    top_speed,
)
from slipid.exports.ros.yaml_text import Parameter, comment, declaration, nodes
from slipid.exports.text import identifiers, interval, short, table
from slipid.robot.deployed import DeployedRobot


@dataclass(frozen=True)
class ReadmeContent:
    """Content of the README.

    Attributes:
        robot: the robot.
        drive: drive controller; None where none fits the robot.
        errs: errors of odometry on each floor.
        worst: errors of odometry on the floor with the largest position error.
        files: use of each file, by its path.
    """

    robot: DeployedRobot
    drive: DriveController | None
    errs: tuple[OdometryErrors, ...]
    worst: OdometryErrors
    files: Mapping[str, str]


def readme(folder: ReadmeContent) -> str:
    """Return the text of README.md."""
    parts = (_head, _files, _wheels, _odometry, _floors_and_loads, _numbers, _left_out)
    return "\n".join(line for part in parts for line in part(folder)) + "\n"


def _head(folder: ReadmeContent) -> Iterator[str]:
    yield from ("# A robot identified by slipid, for ROS 2", "", *in_markdown(folder.robot))


def _files(folder: ReadmeContent) -> Iterator[str]:
    yield from ("## Files", "")
    yield from table(("file", "use"), [(f"`{name}`", use) for name, use in folder.files.items()])
    yield ""
    drive = folder.drive
    if drive is None:
        yield from (_NO_DRIVE, "")
        return
    name = drive.controller.name
    yield "The controller manager needs the type of the controller, under the name used here:"
    yield from ("", "```yaml", "controller_manager:", "  ros__parameters:", f"    {name}:")
    yield from (f"      type: {drive.controller.plugin}", "```", "")
    off = drive.off
    yield (
        f"Its kinematics differ from the identified ones by {short(100 * off)} % of a rim speed at "
        "most: it knows no drive directions of single wheels."
        if off > 1e-9
        else "Its kinematics are the identified ones."
    )
    yield ""


def _wheels(folder: ReadmeContent) -> Iterator[str]:
    """Yield the section with order, places and directions of the wheels."""
    robot, drive = folder.robot, folder.drive
    yield from ("## Wheels", "")
    yield (
        "x ahead, y left, angles counter-clockwise (REP 103). *Drives to* is where a wheel pushes "
        "the body at a positive speed, as logs count it that the robot was identified from."
    )
    yield ""
    places, record = np.asarray(robot.places), robot.record
    offsets = np.broadcast_to(record.parameters["robot.drive_offset"].value, (robot.wheels,))
    order = range(robot.wheels) if drive is None else drive.wheels
    turned = (False,) * robot.wheels if drive is None else drive.turned
    lines = []
    for k, reverse in zip(order, turned, strict=True):
        angle = np.degrees(record.wheels.drive_angle[k] + offsets[k])
        rollers = np.degrees(record.wheels.roller_angle[k])
        free = "none" if record.wheels.grips[k] else f"{short(float(rollers))} deg to it"
        where = ", ".join(short(x) for x in (np.round(places[k], 9) + 0.0).tolist())
        ahead = f"{short(float((angle + 180) % 360 - 180))} deg"
        line = (f"wheel {k + 1}", f"`{joint(k)}`", where, ahead, free)
        lines.append((*line, "" if drive is None else "**REVERSE**" if reverse else "as it is"))
    head = ("robot.json", "joint", "x, y [m]", "drives to", "rollers", "sign for the controller")
    yield from table(head, lines)
    yield ""
    if any(turned):
        yield _REVERSE
        yield ""


def _odometry(folder: ReadmeContent) -> Iterator[str]:
    """Yield the section with the stds of odometry on every floor."""
    yield from ("## Odometry", "")
    robot, speed = folder.robot, top_speed(folder.robot)
    lines = []
    for e in folder.errs:
        mark = " (worst)" if e.floor == folder.worst.floor else ""
        own = e.without_slip()
        ways = (e.pose(DISTANCE_M), e.twist(speed, PERIOD_S), own.pose(DISTANCE_M))
        lines.append((f"{e.floor}{mark}", *(_stds(way) for way in ways)))
    after = f"after {short(DISTANCE_M)} m"
    head = ("floor", f"pose {after}", "velocity", f"pose {after}, slip estimated")
    yield "Standard deviations: x and y [m], heading [rad]; velocities [m/s], [rad/s]."
    yield from ("", *table(head, lines), "")
    yield _DRIFT.format(speed=short(speed), period=short(PERIOD_S), way=short(DISTANCE_M))
    yield from ("", gains_origin(robot), "")


def _stds(variances: Sequence[float]) -> str:
    x, _, yaw = (short(v**0.5) for v in variances)
    return f"{x}, {yaw}"


def _floors_and_loads(folder: ReadmeContent) -> Iterator[str]:
    """Yield the section with the names of floors and load set-ups in parameters."""
    yield from ("## Floors and load set-ups", "")
    record = folder.robot.record
    loads = tuple(load.name for load in record.loads)
    kinds = (("floor", record.labels), ("load", loads))
    lines = [
        (kind, label, f"`{name}`")
        for kind, labels in kinds
        for label, name in zip(labels, identifiers(labels, kind), strict=True)
    ]
    yield from (*table(("", "in robot.json", "in parameters"), lines), "")


def _numbers(folder: ReadmeContent) -> Iterator[str]:
    """Yield the section with every number and its origin."""
    yield from ("## Numbers", "")
    yield "Every number with its origin; `slipid.yaml` has them to the last digit."
    lines = []
    for row in number_rows(folder.robot):
        number = (short(row.value), row.unit, interval(row.interval90))
        known = (*number, row.verdict_markdown, row.provenance)
        lines.append((f"`{row.name}`", row.entry, row.about, *known))
    head = ("robot.json", "", "", "value", "unit", "90 % interval", "verdict", "provenance")
    yield from ("", *table(head, lines), "", "What the verdicts mean:", "")
    yield from (f"- *{v.replace('_', ' ')}*: {text}." for v, text in VERDICTS.items())
    yield from ("", "And the provenances:", "")
    yield from (f"- *{p}*: {text}." for p, text in PROVENANCES.items())
    yield ""


def _left_out(folder: ReadmeContent) -> Iterator[str]:
    yield from ("## What is left out", "", _ONLY)


_NO_DRIVE = (
    f"No drive controller of ros2_controllers has the kinematics of this robot (to {MOST:.0%} of a "
    "rim speed): `omni_wheel_drive_controller` needs omni wheels evenly on a circle, "
    "`mecanum_drive_controller` four wheels at corners with rollers at 45 degrees. `slipid.yaml` "
    "has its matrices, `kinematics.forward` and `kinematics.inverse`."
)
_REVERSE = (
    "**Reverse** the joints marked so, by their axis in the robot's description or in its hardware "
    "driver, or the robot goes the other way: the controller counts their speeds with the other "
    "sign than the logs did. `omni_wheel_drive_controller` takes a positive speed of every wheel "
    "as a turn of the robot clockwise, `mecanum_drive_controller` as a way ahead."
)
_DRIFT = (
    "Columns two and three are those of the drive controller, which ignores slip: they include the "
    "slip of the wheels by the identified contact model and the errors of that model. The last "
    "column is that of an estimator that knows slip and floor. Velocities are at {speed} m/s, the "
    "highest rim speed of the fitted runs, with one message every {period} s. Every message has "
    "the same numbers, while the true uncertainty grows with the path: `pose` is right about "
    "{way} m after the pose was last corrected, and too small beyond. Slip and effects are not "
    "noise: they push in the same direction over metres, which no covariance in a message can "
    "express."
)
_ONLY = (
    "`slipid.yaml` has the numbers of the robot, not how they hang together: draws of the "
    "posterior, the covariance of frictions and the effect tables are in robot.json alone, which "
    "slipid's own estimator reads. Older releases of `mecanum_drive_controller` leave "
    "the covariance of the pose at zero, whatever its parameter says; that of the twist is right."
)


USES: Mapping[str, str] = {
    "drive_controller.yaml": "geometry and covariances, on the worst floor, for the drive "
    "controller: give it to the spawner or the controller manager, with your own joint names",
    "robot_localization.yaml": "extended Kalman filter for the odometry of the drive controller, "
    "on the worst floor: `ros2 run robot_localization ekf_node --ros-args --params-file` this file",
    "robot_localization_slipid.yaml": "the same filter for odometry in which slip is estimated, "
    "whoever publishes its twist, with the covariance that the file names",
    "slipid.yaml": "every number of the robot, gains and limits, as parameters of a node `slipid`",
    "slipid_parameters.yaml": "their declaration for generate_parameter_library: types, "
    "descriptions with verdicts, validators; the defaults are the numbers themselves",
}
"""Use of each file, by name, without the files for single floors."""
_FLOOR = (
    "covariances of the drive controller and process noise of `robot_localization.yaml` on this "
    "floor: give it after those files, it overrides them"
)


def ros2_files(robot: DeployedRobot) -> dict[str, str]:
    """Return the text of the files of a ROS 2 folder by path, for the robot's load set-up.

    The file of the drive controller is absent if no controller of ros2_controllers has the robot's
    kinematics.
    """
    drive, errs = drive_controller_of(robot), odometry_errors(robot)
    own = tuple(e.without_slip() for e in errs)
    worst, parameters = noise.worst(errs), node.node_parameters(robot)
    odometry = f"/{drive.controller.name}/{drive.controller.odometry}" if drive else "/odom"
    bodies: dict[str, Sequence[str]] = {}
    if drive is not None:
        listed = (*drive.parameters, *_covariances(robot, drive, worst))
        bodies["drive_controller.yaml"] = nodes([(drive.controller.name, listed)])
    known = noise.worst(own)
    stated = diagonal(known.twist(top_speed(robot), PERIOD_S))
    estimated = f"{_ESTIMATED}, which states this twist covariance diagonal: {list(stated)}"
    for name, e, topic, whose in (
        ("robot_localization.yaml", worst, odometry, _ENCODERS),
        ("robot_localization_slipid.yaml", known, "/slipid/odometry", estimated),
    ):
        listed = localization.filter_parameters(robot, e, topic, whose)
        bodies[name] = nodes([(localization.NODE, listed)])
    bodies["slipid.yaml"] = nodes([(node.NODE, parameters)])
    bodies["slipid_parameters.yaml"] = declaration(node.NODE, parameters)
    floors = dict(_of_floors(robot, drive, errs))
    head = comment(header(robot))
    files = {name: "\n".join([*head, *body]) + "\n" for name, body in (bodies | floors).items()}
    uses = {name: use for name, use in USES.items() if name in bodies} | dict.fromkeys(
        floors, _FLOOR
    )
    return {"README.md": readme(ReadmeContent(robot, drive, errs, worst, uses)), **files}


def _of_floors(
    robot: DeployedRobot, drive: DriveController | None, errs: tuple[OdometryErrors, ...]
) -> Iterator[tuple[str, Sequence[str]]]:
    """Yield path and lines of a file per floor, with the parameters that depend on the floor."""
    names = identifiers(robot.labels, "floor")
    for name, e in zip(names, errs, strict=True):
        parts: list[tuple[str, tuple[Parameter, ...]]] = [
            (localization.NODE, (localization.process_noise(robot, e),))
        ]
        if drive is not None:
            parts.insert(0, (drive.controller.name, _covariances(robot, drive, e)))
        yield f"floors/{name}.yaml", nodes(parts)


def _covariances(
    robot: DeployedRobot, drive: DriveController, e: OdometryErrors
) -> tuple[Parameter, ...]:
    """Return the covariance diagonals of a drive controller on a floor, with their derivation."""
    speed = top_speed(robot)
    own, slip = (", ".join(map(short, axes)) for axes in (e.effect, e.slip))
    pose = (
        f"On '{e.floor}'. Variances of x, y [m^2], z, roll, pitch, yaw [rad^2] of odometry that "
        f"ignores slip, d = {short(DISTANCE_M)} m after its pose was last corrected: "
        f"(effect^2 + slip^2) d^2 + process^2 d, the larger of along and across for x and y, and "
        f"with what the heading's error carries sideways. Effect {own}, slip {slip} (along, across "
        f"[m/m], yaw [rad/m]), process {', '.join(map(short, e.process))} (per sqrt(m)). They are "
        f"constant here while true ones grow with the path; wheels measure no z, roll and pitch."
    )
    twist = (
        f"Variances of velocities [m^2/s^2, rad^2/s^2]: (effect^2 + slip^2) v^2 + process^2 v / T "
        f"at v = {short(speed)} m/s, the highest rim speed of the fitted runs, and a message every "
        f"T = {short(PERIOD_S)} s."
    )
    return (
        Parameter(drive.controller.pose, noise.diagonal(e.pose(DISTANCE_M)), pose, per_line=6),
        Parameter(
            drive.controller.twist, noise.diagonal(e.twist(speed, PERIOD_S)), twist, per_line=6
        ),
    )


_ENCODERS = "the drive controller, which ignores slip"
_ESTIMATED = "slipid's estimator or another one that knows the slip of the wheels"
