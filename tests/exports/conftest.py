"""The robot of which most forms are made here."""

import pytest

from slipid.exports.ros.folder import ros2_files
from slipid.robot.deployed import DeployedRobot
from tests.helpers.exported import doubtful


@pytest.fixture(scope="module")
def robot() -> DeployedRobot:
    """One with odd names and numbers of every verdict."""
    return doubtful()


@pytest.fixture(scope="module")
def files(robot) -> dict[str, str]:
    """Its folder for ROS 2."""
    return ros2_files(robot)
