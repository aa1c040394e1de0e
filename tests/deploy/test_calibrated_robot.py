"""A robot that was calibrated alone: what is written, and what its estimator does."""

import json

import numpy as np
import pytest

import slipid as sl
from slipid.app.config import read_config
from slipid.app.problem import read_fit_task
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator
from slipid.robot.interface import Measurement
from slipid.robot.limits import Limits
from slipid.robot.record import Setting
from slipid.support.progress import Reporter
from tests.benchmarks.every_robot.drive import write
from tests.benchmarks.every_robot.rivals import read
from tests.benchmarks.every_robot.robots import ROBOTS
from tests.helpers.shared import invoke

MADE = next(robot for robot in ROBOTS if robot.name == "diff_umbmark")


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    truth = write(MADE, folder, seed=1)
    out = folder / "out"
    done = invoke(
        *("identify", folder / "robot.toml", "--data", folder / "logs"),
        *("--out", out, "--only", "calibration", "--quiet"),
    )
    return folder, out, truth, done


def test_its_files_say_what_was_calibrated_and_selected(calibrated):
    _, out, _, done = calibrated
    assert done.exit_code == 0
    content = json.loads((out / "identified.json").read_text())
    assert content["selected_model"] == {"floor": "calibrated"}
    assert content["trust"]["verdict"] == "trusted"
    assert "verdict: trusted" in done.stdout
    track = content["calibration"]["surfaces"]["floor"]["effective_track_m"]
    assert track["interval90"][0] < 0.170 < track["interval90"][1]
    errors = content["trust"]["held_out_error_over_path"]["floor"]
    assert errors["calibrated"] < 0.1 * errors["nominal"]


def test_its_estimator_predicts_a_fresh_run(calibrated):
    """From the first pose on, without another one; the true numbers are off by as much."""
    folder, out, truth, _ = calibrated
    robot = DeployedRobot.load(out / "robot.json")
    assert robot.calibrated == (True,)
    estimator = Estimator(robot)
    for track in read(MADE, folder / "fresh")[:2]:
        state = estimator.init(pose=tuple(track.pose[0]))
        step = np.diff(track.t, prepend=track.t[0])
        for angle, dt in zip(track.angle, step, strict=True):
            state, estimate = estimator.step(state, Measurement(wheel_angle=angle), dt)
        gap = np.asarray(estimate.pose)[:2] - track.pose[-1, :2]
        assert np.hypot(*gap) < 0.015 * truth[track.name].path


def test_its_limits_are_those_of_its_own_runs(calibrated):
    """Not those of another robot; noise of sensors that were not logged is assumed."""
    folder, out, _, _ = calibrated
    robot = DeployedRobot.load(out / "robot.json")
    task = read_fit_task(read_config(folder / "robot.toml"), folder / "logs", Reporter(quiet=True))
    limits, radius = robot.record.limits, float(task.robot.geometry.wheel_radius)
    assert limits.wheel_speed == Setting(task.robot_settings["limits.wheel_speed"][0], "logs")
    assert limits.speed.provenance == "logs"
    assert limits.speed.value == pytest.approx(limits.wheel_speed.value / 1.2 * radius, rel=0.1)
    for name, value in vars(Limits()).items():
        if name not in ("acceleration", "yaw_rate"):
            assert getattr(Limits.of(robot), name) != value
    assert robot.record.sensors.ammeter_std_a.provenance == "assumed"
    assert robot.record.actuators.delay_s is None


def test_its_kinematics_are_not_those_of_the_config(calibrated):
    robot = DeployedRobot.load(calibrated[1] / "robot.json")
    config = np.asarray(robot.inverse) * MADE.nominal_radius
    assert not np.allclose(np.asarray(robot.kinematics[0]), config, rtol=0.02)


def test_another_part_than_the_calibration_is_refused(calibrated):
    folder, out, *_ = calibrated
    done = invoke(
        *("identify", folder / "robot.toml", "--data", folder / "logs", "--out", out),
        *("--only", "slip", "--quiet"),
    )
    assert done.exit_code == 2
    assert "--only slip: no such part; expected calibration" in done.stderr


def test_a_whole_fit_is_not_overwritten_by_a_calibration(calibrated, tmp_path):
    """Files of two results in one folder would contradict each other."""
    folder = calibrated[0]
    (tmp_path / "fit.json").write_text('{"schema": "slipid.fit/1"}', encoding="utf-8")
    words = ("identify", folder / "robot.toml", "--data", folder / "logs", "--out", tmp_path)
    done = invoke(*words, "--only", "calibration", "--quiet")
    assert done.exit_code == 2
    assert "has the result of a whole fit (fit.json)" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["fit.json"]


def test_a_profile_needs_the_force_balance(calibrated, tmp_path):
    folder = calibrated[0]
    words = ("identify", folder / "robot.toml", "--data", folder / "logs", "--out", tmp_path)
    done = invoke(*words, "--only", "calibration", "--profile", "motor.resistance", "--quiet")
    assert done.exit_code == 2
    assert "--profile needs the force balance" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_python_gives_the_numbers_of_the_command_line(calibrated):
    """Also `print`, and the robot of an estimator."""
    folder, out, *_ = calibrated
    with Reporter(quiet=True) as report:
        task = read_fit_task(read_config(folder / "robot.toml"), folder / "logs", report)
    found = sl.calibrate(task.dataset, task.robot, quiet=True)
    section = json.loads((out / "identified.json").read_text())["calibration"]
    for mine, other in zip(
        found.calibration.radius["floor"],
        section["surfaces"]["floor"]["rolling_radius_m"],
        strict=True,
    ):
        assert mine.value == pytest.approx(other["value"], rel=1e-4)
    assert found.trust.word == "trusted"
    assert "\nfloor\n  rolling radius left " in str(found)
    assert "verdict: trusted" in str(found)
    kept = DeployedRobot.load(out / "robot.json")
    np.testing.assert_allclose(found.deploy().kinematics, kept.kinematics, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("name", ["diff_positions", "diff_heading"])
def test_runs_without_whole_poses_are_calibrated_alone(name, tmp_path):
    """A full fit needs whole poses, so that it calibrates alone, and says so."""
    robot = next(robot for robot in ROBOTS if robot.name == name)
    write(robot, tmp_path, seed=2)
    done = invoke(
        *("identify", tmp_path / "robot.toml", "--data", tmp_path / "logs"),
        *("--out", tmp_path / "out"),
    )
    assert done.exit_code == 0
    assert "calibration alone: " in done.stderr
    content = json.loads((tmp_path / "out" / "identified.json").read_text())
    floor = robot.floors[0].name
    assert content["selected_model"] == {floor: "calibrated"}
    low, high = content["calibration"]["surfaces"][floor]["effective_track_m"]["interval90"]
    assert low < robot.floors[0].base < high
    assert DeployedRobot.load(tmp_path / "out" / "robot.json").calibrated == (True,)


def test_it_predicts_other_runs_without_a_force_balance(calibrated, tmp_path):
    folder, out, *_ = calibrated
    file = tmp_path / "validation.json"
    done = invoke("validate", out, "--data", folder / "fresh", "--json", file, "--quiet")
    assert done.exit_code == 0, done.stderr
    rows = json.loads(file.read_text())["summary"]["floor"]
    assert list(rows) == ["nominal", "calibrated", "selected"]
    error = {name: row["endpoint_error_over_path_mean"] for name, row in rows.items()}
    assert error["selected"] == error["calibrated"] < 0.1 * error["nominal"]
