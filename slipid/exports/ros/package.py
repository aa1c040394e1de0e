"""An ament package for ROS 2: a node around the estimator and controller exported in C.

The package contains source text to adapt; it is built with the folder of the form `c`.
"""

from collections.abc import Sequence

from slipid.exports.description import header
from slipid.exports.ros.drive import joint
from slipid.exports.ros.localization import UNKNOWN
from slipid.exports.text import filled
from slipid.robot.deployed import DeployedRobot
from slipid.robot.interface import PERIOD

MESSAGES = (
    "diagnostic_msgs",
    "geometry_msgs",
    "nav_msgs",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
)
"""ROS packages with the messages of the node."""


def package_files(robot: DeployedRobot, twist: Sequence[float]) -> dict[str, str]:
    """Return the texts of the package, keyed by the file's path.

    `twist` are the variances of the node's velocities x, y, z, roll, pitch, yaw [m^2/s^2,
    rad^2/s^2].
    """
    of = robot.drive_of or tuple(range(robot.wheels))
    joints = [joint(of.index(drive)) for drive in range(robot.drives)]
    values = {
        "NUMBERS": robot.record.numbers,
        "DEPENDS": [f"  <depend>{name}</depend>" for name in ("rclcpp", *MESSAGES)],
        "PACKAGES": " ".join(MESSAGES),
        "JOINTS": ", ".join(f'"{name}"' for name in joints),
        "GYRO": str(robot.record.sensors.gyro).lower(),
        "PERIOD": str(round(1000 * PERIOD)),
        "RATE": str(round(1 / PERIOD)),
        "TWIST": ", ".join(map(repr, twist)),
        "UNKNOWN": repr(UNKNOWN),
    }
    files = {}
    for name, mark in (("package.xml", ""), ("CMakeLists.txt", "#"), ("slipid_node.cpp", "//")):
        head = [f"{mark} {line}".rstrip() for line in header(robot)]
        place = f"src/{name}" if name.endswith(".cpp") else name
        files[f"node/{place}"] = filled(f"ros2/node/{name}", {**values, "HEAD": head})
    return files
