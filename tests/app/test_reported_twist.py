"""Robots whose logs have the twist of their odometry alone get multipliers of its lengths."""

import numpy as np
import pytest

from slipid.app.config import read_config
from slipid.app.problem import read_fit_task
from slipid.fitting.calibration.estimate import calibrate
from slipid.search_space import Space
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from tests.benchmarks.every_robot.drive import write
from tests.benchmarks.every_robot.robots import ROBOTS

RIGHT = next(robot for robot in ROBOTS if robot.name == "diff_only_changes")
"""Track 8 % wider than its user says, and wheels 3 % larger; squares in both directions."""


def reported(folder):
    """Replace the columns of the wheels by the twist that the robot computes from them."""
    write(RIGHT, folder, 2)
    for path in sorted((folder / "logs").rglob("*.csv")):
        c = np.genfromtxt(path, delimiter=",", names=True)
        rim = RIGHT.nominal_radius * np.stack([c["left"], c["right"]])
        travel = np.stack([rim.mean(axis=0), (rim[1] - rim[0]) / RIGHT.nominal_base])
        v, yaw = np.gradient(travel, c["t"], axis=1)
        rows = np.column_stack([c["t"], v, yaw, c["x"], c["y"], c["heading"]])
        np.savetxt(path, rows, delimiter=",", header="t,v,w,x,y,heading", comments="", fmt="%.9g")
    text = (folder / "robot.toml").read_text().splitlines()
    at = next(k for k, line in enumerate(text) if line.startswith("wheel_angle"))
    text[at] = 'twist_x = { column = "v", unit = "m/s" }'
    text.insert(at, 'twist_yaw = { column = "w", unit = "rad/s" }')
    (folder / "robot.toml").write_text("\n".join(text))


def read(folder):
    with Reporter(quiet=True) as report:
        return read_fit_task(read_config(folder / "robot.toml"), folder / "logs", report)


def test_a_reported_twist_is_calibrated(tmp_path):
    reported(tmp_path)
    task = read(tmp_path)
    log = task.dataset.logs[0]
    assert log.wheels == 2
    assert any("follow from the reported twist" in note for note in log.notes)
    found = calibrate(task.dataset, Space(task.robot, task.choices), task.choices)
    radius, track = found.multipliers["carpet"]
    assert radius == pytest.approx([0.0523 / 0.0508] * 2, rel=3e-3)
    assert track == pytest.approx(0.605 / 0.56, rel=5e-3)


def test_a_robot_that_steers_needs_its_wheels(tmp_path):
    reported(tmp_path)
    text = (tmp_path / "robot.toml").read_text()
    steered = text.replace('"differential"', '"steered"').replace("track_m", "wheelbase_m")
    (tmp_path / "robot.toml").write_text(steered)
    with pytest.raises(DataError, match=r"00\.csv: a twist is logged, but no wheel; expected wh"):
        read(tmp_path)
