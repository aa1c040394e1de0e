"""A ROS 2 folder of an identified robot: drive controller, localization, parameters, README.

Numbers in YAML files are written with all digits, so that they are read back exactly.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from slipid.exports.description import (
    PROVENANCES,
    VERDICTS,
    gains_origin,
    header,
    in_markdown,
    number_rows,
)
from slipid.exports.ros import localization
from slipid.exports.ros.drive import (
    LARGEST_DIFFERENCE,
    DriveController,
    drive_controllers,
    joint,
    rolling,
)
from slipid.exports.ros.localization import (
    DISTANCE_M,
    PERIOD_S,
    OdometryErrors,
    diagonal,
    odometry_errors,
    top_speed,
    worst_of,
)
from slipid.exports.ros.node import NODE, node_parameters
from slipid.exports.ros.package import package_files
from slipid.exports.ros.yaml_text import Parameter, comment, declaration, nodes
from slipid.exports.text import filled, identifiers, interval, short, table, template
from slipid.robot.deployed import DeployedRobot

USES: Mapping[str, str] = {
    "drive_controller.yaml": "geometry and covariances (of the worst floor) for the drive "
    "controller: enter the names of your joints, then pass the file to the spawner or the "
    "controller manager",
    "robot_localization.yaml": "parameters of the extended Kalman filter for the odometry of that "
    "controller (on the worst floor): run `ros2 run robot_localization ekf_node --ros-args "
    "--params-file` with this file",
    "robot_localization_slipid.yaml": "parameters of the same filter for odometry with estimated "
    "slip; the odometry's publisher must use the covariance given in the file",
    "slipid.yaml": "every parameter of the robot, gains and limits, as parameters of a node "
    "`slipid`",
    "slipid_parameters.yaml": "input for generate_parameter_library, which generates code that "
    "declares the parameters in slipid.yaml: types, descriptions with verdicts, and validators; "
    "the defaults are the identified values",
}
"""Use of each file, keyed by the file's name, except for single floors and the node."""
_NODE = {
    "node/package.xml": "package of a node that drives the robot with cmd_vel by the estimator and "
    "controller in C, which must be exported as well (`--to c,ros2`): copy `node` and `c` into "
    "your workspace, next to each other below one folder",
    "node/CMakeLists.txt": "its build: `colcon build --cmake-args -DSLIPID_C=PATH` for a folder "
    "`c` elsewhere",
    "node/src/slipid_node.cpp": "its source, to adapt to your drivers: `cmd_vel` (TwistStamped), "
    "`joint_states` and `imu` in; `~/commands` (wheel speeds for a JointGroupVelocityController), "
    "`~/odometry` and `/diagnostics` out; service `~/rearm`",
}
_FLOOR = (
    "covariances of the drive controller (for `diff_drive_controller` also multipliers of its "
    "geometry) and process noise of the filter on this floor: load this "
    "file after `drive_controller.yaml` and `robot_localization.yaml`, whose values it overrides"
)
_ENCODERS = "the drive controller, which ignores slip"
_ESTIMATED = (
    "slipid's estimator, or of another estimator of slip, which must publish this diagonal as the "
    "covariance of its twist"
)


def ros2_files(robot: DeployedRobot) -> dict[str, str]:
    """Return the texts of a ROS 2 folder for the robot's load set-up, keyed by the file's path.

    There is no file for a drive controller if no controller of ros2_controllers has the robot's
    kinematics.
    """
    drives, bodies = drive_controllers(robot), {}
    alone = [d.wheel_speeds for d in drives] or [rolling(robot)] * len(robot.labels)
    errors = odometry_errors(robot, np.stack(alone))
    # the file without a floor has the kinematics of the worst one, wherever the robot drives
    floor = robot.labels.index(worst_of(errors).floor)
    worst = worst_of(odometry_errors(robot, np.stack([alone[floor]] * len(alone))))
    drive = drives[floor] if drives else None
    parameters = node_parameters(robot)
    if drive is not None:
        listed = (*drive.parameters, *drive.by_floor, *_covariances(robot, drive, worst))
        bodies["drive_controller.yaml"] = nodes([(drive.name, listed)])
    known = worst_of(tuple(e.without_slip() for e in errors))
    stated = list(diagonal(known.twist(top_speed(robot), PERIOD_S)))
    odometry = f"/{drive.name}/{drive.odometry}" if drive else "/odom"
    for name, e, topic, source in (
        ("robot_localization.yaml", worst, odometry, _ENCODERS),
        ("robot_localization_slipid.yaml", known, "/slipid/odometry", f"{_ESTIMATED}: {stated}"),
    ):
        listed = localization.filter_parameters(robot, e, topic, source)
        bodies[name] = nodes([(localization.FILTER_NODE, listed)])
    bodies["slipid.yaml"] = nodes([(NODE, parameters)])
    bodies["slipid_parameters.yaml"] = declaration(NODE, parameters)
    uses = {name: USES[name] for name in bodies}
    for k, (label, e) in enumerate(zip(identifiers(robot.labels, "floor"), errors, strict=True)):
        own = [(d.name, (*d.by_floor, *_covariances(robot, d, e))) for d in drives[k : k + 1]]
        noise = (localization.process_noise(robot, e),)
        bodies[f"floors/{label}.yaml"] = nodes([*own, (localization.FILTER_NODE, noise)])
        uses[f"floors/{label}.yaml"] = _FLOOR
    head = comment(header(robot))
    files = {name: "\n".join([*head, *body]) + "\n" for name, body in bodies.items()}
    files |= package_files(robot, stated)
    return {"README.md": _readme(robot, drive, errors, uses | _NODE), **files}


def _covariances(
    robot: DeployedRobot, drive: DriveController, e: OdometryErrors
) -> tuple[Parameter, ...]:
    """Return the covariance diagonals of a drive controller on a floor, with their derivation."""
    speed = top_speed(robot)
    effect, slip, process = (", ".join(map(short, x)) for x in (e.effect, e.slip, e.process))
    pose = (
        f"On '{e.floor}'. Variances of x, y [m^2], z, roll, pitch, yaw [rad^2] of odometry that "
        f"ignores slip, d = {short(DISTANCE_M)} m after the last correction of its pose: "
        "(effect^2 + slip^2) d^2 + process^2 d (for x and y, the larger value of along and "
        f"across), plus the sideways error due to the heading. Effect {effect}, slip {slip} "
        f"(along, across [m/m], yaw [rad/m]), process {process} (per sqrt(m)). These variances are "
        "constant, while true variances grow with the path. Wheels do not measure z, roll and "
        "pitch."
    )
    twist = (
        f"Variances of velocities [m^2/s^2, rad^2/s^2]: (effect^2 + slip^2) v^2 + process^2 v / T "
        f"at v = {short(speed)} m/s, the highest rim speed of the fitted runs, and a message every "
        f"T = {short(PERIOD_S)} s."
        + (
            ""
            if e.sideways
            else " The sideways velocity is that of "
            "the sideslip, which the pose does not include: turning back undoes it."
        )
    )
    variances = e.pose(DISTANCE_M), e.twist(speed, PERIOD_S)
    return tuple(
        Parameter(name, diagonal(planar), about, per_line=6)
        for name, planar, about in zip(drive.covariances, variances, (pose, twist), strict=True)
    )


def _readme(
    robot: DeployedRobot,
    drive: DriveController | None,
    errors: tuple[OdometryErrors, ...],
    uses: Mapping[str, str],
) -> str:
    """Return the text of README.md; `uses` is the use of each file, keyed by its path."""
    values = {
        "HEAD": in_markdown(robot),
        "FILES": table(("file", "use"), [(f"`{name}`", use) for name, use in uses.items()]),
        "CONTROLLER": _controller(drive),
        "WHEELS": _wheels(robot, drive),
        "ODOMETRY": _odometry(robot, errors),
        "SPEED": short(top_speed(robot)),
        "PERIOD": short(PERIOD_S),
        "DISTANCE": short(DISTANCE_M),
        "GAINS": gains_origin(robot),
        "NAMES": _names(robot),
        "NUMBERS": _numbers(robot),
        "VERDICTS": [f"- *{v.replace('_', ' ')}*: {text}." for v, text in VERDICTS.items()],
        "PROVENANCES": [f"- *{p}*: {text}." for p, text in PROVENANCES.items()],
    }
    return filled("ros2/README.md", values)


def _controller(drive: DriveController | None) -> str:
    """Return the paragraphs about the controller manager and the controller's kinematics."""
    if drive is None:
        return filled("ros2/no_drive.md", {"SHARE": f"{LARGEST_DIFFERENCE:.0%}"}).rstrip()
    missing = (
        "one radius for each side and one wheel separation"
        if drive.by_floor
        else "no parameters for drive directions of single wheels"
    )
    difference = (
        f"differ from the identified kinematics by at most {short(100 * drive.difference)} % of a "
        f"rim speed, since the controller has {missing}."
    )
    values = {
        "NAME": drive.name,
        "PLUGIN": drive.plugin,
        "DIFFERENCE": difference if drive.difference > 1e-9 else "are the identified kinematics.",
    }
    return filled("ros2/drive.md", values).rstrip()


def _wheels(robot: DeployedRobot, drive: DriveController | None) -> list[str]:
    """Return the table with order, positions and directions of wheels, and joints to reverse."""
    places, record = np.asarray(robot.places), robot.record
    offsets = np.broadcast_to(record.parameters["robot.drive_offset"].value, (robot.wheels,))
    order = range(robot.wheels) if drive is None else drive.wheels
    turned = (False,) * robot.wheels if drive is None else drive.turned
    rows = []
    for k, reverse in zip(order, turned, strict=True):
        angle = np.degrees(record.wheels.drive_angle[k] + offsets[k])
        rollers = np.degrees(record.wheels.roller_angle[k])
        free = "none" if record.wheels.grips[k] else f"{short(float(rollers))} deg to it"
        where = ", ".join(short(x) for x in (np.round(places[k], 9) + 0.0).tolist())
        ahead = f"{short(float((angle + 180) % 360 - 180))} deg"
        sign = "" if drive is None else "**REVERSE**" if reverse else "as it is"
        motor = f", drive {robot.drive_of[k] + 1}" if robot.drive_of else ""
        rows.append((f"wheel {k + 1}{motor}", f"`{joint(k)}`", where, ahead, free, sign))
    head = ("robot.json", "joint", "x, y [m]", "drives to", "rollers", "sign for the controller")
    warning = ["", template("ros2/reverse.md").rstrip()] if any(turned) else []
    return [*table(head, rows), *warning]


def _odometry(robot: DeployedRobot, errors: tuple[OdometryErrors, ...]) -> list[str]:
    """Return the table with the stds of odometry on every floor."""
    speed, worst = top_speed(robot), worst_of(errors)
    rows = []
    for e in errors:
        variances = (
            e.pose(DISTANCE_M),
            e.twist(speed, PERIOD_S),
            e.without_slip().pose(DISTANCE_M),
        )
        mark = " (worst)" if e.floor == worst.floor else ""
        rows.append((f"{e.floor}{mark}", *map(_stds, variances)))
    after = f"after {short(DISTANCE_M)} m"
    return table(("floor", f"pose {after}", "velocity", f"pose {after}, slip estimated"), rows)


def _stds(variances: Sequence[float]) -> str:
    x, y, yaw = (short(v**0.5) for v in variances)
    return f"{x}, {yaw}" if x == y else f"{x}, {y}, {yaw}"


def _names(robot: DeployedRobot) -> list[str]:
    """Return the table of the names that floors and load set-ups have in ROS parameters."""
    record = robot.record
    rows = [
        (kind, label, f"`{name}`")
        for kind, labels in (("floor", record.labels), ("load", [x.name for x in record.loads]))
        for label, name in zip(labels, identifiers(labels, kind), strict=True)
    ]
    return table(("", "in robot.json", "in parameters"), rows)


def _numbers(robot: DeployedRobot) -> list[str]:
    """Return the table with every parameter of the robot and the source of its value."""
    rows = []
    for row in number_rows(robot):
        number = (short(row.value), row.unit, interval(row.interval90))
        known = (*number, row.verdict_markdown, row.provenance)
        rows.append((f"`{row.name}`", row.entry, row.about, *known))
    head = ("robot.json", "", "", "value", "unit", "90 % interval", "verdict", "provenance")
    return table(head, rows)
