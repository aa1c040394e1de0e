"""A gyro is the heading of runs that have no pose."""

from dataclasses import replace

import pytest

from slipid.app.config import read_config
from slipid.app.problem import read_fit_task
from slipid.fitting.calibration.estimate import calibrate
from slipid.search_space import Space
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from tests.benchmarks.every_robot.drive import write
from tests.benchmarks.every_robot.robots import ROBOTS

GYRO = next(robot for robot in ROBOTS if robot.name == "diff_heading")
"""Wheels that differ by 2 %, a track 5 % wider than its user says, and a biased gyro."""


def read(folder, robot):
    write(robot, folder, 3)
    text = (folder / "robot.toml").read_text().splitlines()
    text = [line for line in text if not line.startswith("pose_heading")]
    (folder / "robot.toml").write_text("\n".join(text))
    with Reporter(quiet=True) as report:
        return read_fit_task(read_config(folder / "robot.toml"), folder / "logs", report)


def test_the_track_follows_from_a_gyro_alone(tmp_path):
    task = read(tmp_path, replace(GYRO, rest=1.0))
    assert any("headings are the integral of the gyro" in n for n in task.dataset.logs[0].notes)
    found = calibrate(task.dataset, Space(task.robot, task.choices), task.choices)
    left, right = found.radius["floor"]
    assert left.value / right.value == pytest.approx(0.0505 / 0.0495, rel=4e-3)
    assert found.base["floor"].value == pytest.approx(0.315, rel=0.01)
    assert found.gyro == {}


def test_without_a_rest_the_bias_is_unknown(tmp_path):
    with pytest.raises(DataError, match=r"00\.csv: no pose, and no rest of 0\.5 s that shows"):
        read(tmp_path, GYRO)
