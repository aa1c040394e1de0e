"""A ROS 2 folder of an identified robot: drive controller, localization, parameters of a node.

All numbers are written so that they read back to the last bit.
"""

from collections.abc import Iterator, Mapping, Sequence

from slipid.export.header import header
from slipid.export.ros import localization, node
from slipid.export.ros import localization as noise
from slipid.export.ros.drive import DriveController
from slipid.export.ros.drive import drive_controller_of
from slipid.export.ros.localization import DISTANCE_M
from slipid.export.ros.localization import PERIOD_S
from slipid.export.ros.localization import OdometryErrors
from slipid.export.ros.localization import diagonal
from slipid.export.ros.localization import odometry_errors
from slipid.export.ros.localization import top_speed
from slipid.export.ros.readme import ReadmeContent
from slipid.export.ros.readme import readme
from slipid.export.ros.yaml_text import Parameter, comment, declaration, nodes
from slipid.export.text import identifiers, short
from slipid.robot.deployed import DeployedRobot

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
"""Use of each file that is not of a single floor."""
_FLOOR = (
    "covariances of the drive controller and process noise of `robot_localization.yaml` on this "
    "floor: give it after those files, it overrides them"
)


def ros2_files(robot: DeployedRobot) -> dict[str, str]:
    """Text of the files of a ROS 2 folder by their paths in it, for the robot's load set-up.

    There is no drive controller where none of ros2_controllers has the robot's kinematics.
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
    """A file per floor with what differs on it."""
    names = identifiers(robot.labels, "floor")
    for name, e in zip(names, errs, strict=True):
        parts: list[tuple[str, tuple[Parameter, ...]]] = [
            (localization.NODE, (localization.process_noise(robot, e),))
        ]
        if drive is not None:
            parts.insert(0, (drive.controller.name, _covariances(robot, drive, e)))
        yield f"floors/{name}.yaml", nodes(parts)


def _covariances(robot: DeployedRobot, drive: DriveController, e: OdometryErrors) -> tuple[Parameter, ...]:
    """The diagonals of a drive controller on a floor, with how they came about."""
    speed = top_speed(robot)
    own, slip = (", ".join(map(short, axes)) for axes in (e.effect, e.slip))
    pose = (
        f"On '{e.floor}'. Variances of x, y [m^2], z, roll, pitch, yaw [rad^2] of odometry that "
        f"believes its encoders, d = {short(DISTANCE_M)} m after its pose was last right: "
        f"(effect^2 + slip^2) d^2 + process^2 d, the larger of along and across for x and y, and "
        f"with what the heading's error carries sideways. Effect {own}, slip {slip} (along, across "
        f"[m/m], yaw [rad/m]), process {', '.join(map(short, e.process))} (per sqrt(m)). They are "
        f"constant here while true ones grow with the way; wheels do not tell z, roll and pitch."
    )
    twist = (
        f"Variances of velocities [m^2/s^2, rad^2/s^2]: (effect^2 + slip^2) v^2 + process^2 v / T "
        f"at v = {short(speed)} m/s, the highest rim speed seen by the fit, and a message every "
        f"T = {short(PERIOD_S)} s."
    )
    return (
        Parameter(drive.controller.pose, noise.diagonal(e.pose(DISTANCE_M)), pose, per_line=6),
        Parameter(
            drive.controller.twist, noise.diagonal(e.twist(speed, PERIOD_S)), twist, per_line=6
        ),
    )


_ENCODERS = "the drive controller, which believes its encoders"
_ESTIMATED = "slipid's estimator or another one that knows the slip of the wheels"
