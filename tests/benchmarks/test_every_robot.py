"""The made robots of the proving ground move as textbooks say, and least squares finds them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slipid.app.config import read_config
from slipid.app.problem import read_fit_task
from slipid.support.progress import Reporter
from tests.benchmarks.every_robot import drive, fits, rivals, score
from tests.benchmarks.every_robot.robots import ROBOTS, Floor, Grip

NAMED = {robot.name: robot for robot in ROBOTS}


def test_there_are_enough_robots_of_every_drive():
    assert len(NAMED) == len(ROBOTS) >= 24
    assert {r.drive for r in ROBOTS} == {"differential", "skid", "omni", "mecanum", "steered"}
    assert {len(r.azimuths_deg) for r in ROBOTS if r.drive == "omni"} == {3, 4}
    assert {r.pose_kind for r in ROBOTS} == {"pose", "xy", "heading"}


@pytest.mark.parametrize("robot", [r for r in ROBOTS if r.has_kinematics], ids=lambda r: r.name)
def test_truth_and_rivals_write_the_same_kinematics(robot):
    rng = np.random.default_rng(0)
    speed, steering = rng.normal(size=(9, robot.drives)), rng.uniform(-0.4, 0.4, 9)
    for floor in robot.floors:
        track = rivals.Track("", floor.name, *[np.zeros(0)] * 5)
        np.testing.assert_allclose(
            rivals.kinematic(robot, rivals.true(robot))(track, speed, steering),
            drive.twist(robot, floor, speed, steering),
            atol=1e-12,
        )


@pytest.mark.parametrize(
    "name",
    [
        *("omni3_right", "omni4_wrong_base", "mecanum_two_floors", "diff_own", "skid_two_floors"),
        *("tricycle_front", "ackermann_car"),
    ],
)
def test_slipid_reads_the_config_as_the_same_geometry(name, tmp_path):
    robot = NAMED[name]
    drive.write(robot, tmp_path, 0)
    with Reporter(quiet=True) as report:
        task = read_fit_task(read_config(tmp_path / "robot.toml"), tmp_path / "logs", report)
    assert len(task.dataset) == robot.runs * len(robot.floors)
    assert not task.skipped
    rim = np.asarray(task.robot.geometry.forward())
    np.testing.assert_allclose(rim, drive.forward(robot, robot.nominal_base), atol=1e-9)


def test_wheels_that_hardly_slip_follow_their_kinematics():
    robot, rng = NAMED["mecanum_load_slip"], np.random.default_rng(0)
    grip = Grip((0.22, 0.23, 0.27, 0.28), creep=1e-3, drag=1e-3)
    body = rng.normal(size=(20, 3))
    floor = Floor("hard", (0.05,) * 4, 0.30, grip=grip)
    wheel = body @ drive.forward(robot, 0.30).T / 0.05
    np.testing.assert_allclose(drive.twist(robot, floor, wheel, np.zeros(20)), body, atol=1e-4)


def test_load_dependent_slip_depends_on_the_direction_of_travel():
    robot = NAMED["omni3_load_slip"]
    course = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    body = 0.3 * np.stack([np.cos(course), np.sin(course), 0 * course], 1)
    wheel = body @ drive.forward(robot, 0.125).T / 0.04
    moved = drive.twist(robot, robot.floors[1], wheel, np.zeros(12))
    slip = 1 - np.hypot(*moved[:, :2].T) / 0.3
    assert 0.1 < slip.min() < slip.max() - 0.02
    assert np.ptp(moved[:, 2]) > 0.02  # rad/s, where the wheels wish to go straight
    np.testing.assert_allclose(  # homogeneous: twice the speed slips by the same share
        drive.twist(robot, robot.floors[1], 2 * wheel, np.zeros(12)), 2 * moved, atol=1e-4
    )


def test_least_squares_finds_the_own_robot(tmp_path):
    robot = NAMED["diff_own"]
    truth = drive.write(robot, tmp_path, 0)
    fitted = rivals.least_squares_fit(robot, rivals.read(robot, tmp_path / "logs"))
    k = fitted.numbers
    for floor in robot.floors:
        np.testing.assert_allclose(k.radius[floor.name], floor.radius, rtol=1e-3)
        assert abs(k.base[floor.name] - floor.base) < 1e-3
    np.testing.assert_allclose(k.place, robot.place, atol=1e-3)
    assert abs(k.lag - robot.lag) < 1e-3
    fresh = rivals.read(robot, tmp_path / "fresh")
    found = score.row(robot, rivals.kinematic(robot, k), k, fresh, truth)
    own = rivals.nominal(robot)
    given = score.row(robot, rivals.kinematic(robot, own), own, fresh, truth)
    for floor in found:
        assert found[floor] < 0.4  # % of the path
        assert given[floor] > 2


def test_one_run_lies_in_the_wrong_folder(tmp_path):
    robot = NAMED["diff_wrong_label"]
    drive.write(robot, tmp_path, 0)
    names = sorted(p.name for p in (tmp_path / "logs" / "carpet").iterdir())
    assert "x00.csv" in names
    assert len(names) == robot.runs + 1


def test_rows_stand_only_where_something_changed(tmp_path):
    robot = NAMED["diff_only_changes"]
    drive.write(robot, tmp_path, 0)
    for track in rivals.read(robot, tmp_path / "logs"):
        cells = np.concatenate([track.angle, track.pose], axis=1)
        assert (np.abs(np.diff(cells, axis=0)).max(1) > 1e-6).all()
        assert np.diff(track.t).max() > 2.5 / robot.rate


PERFECT = 0.03
"""Largest error of true numbers where nothing is noisy [% of the path]."""
KINDS = (
    "diff_large_lag",
    "diff_positions",
    "diff_heading",
    "skid_two_floors",
    "omni3_marker",
    "omni4_load_slip",
    "mecanum_two_floors",
    "tricycle_front",
    "ackermann_understeer",
)


@pytest.mark.parametrize("name", KINDS)
def test_true_numbers_predict_what_noiseless_sensors_log(name, tmp_path):
    robot = replace(NAMED[name], noise_m=0, noise_rad=0, wheel_noise=0, ticks=0, runs=1)
    truth = drive.write(robot, tmp_path, 0)
    fresh, k = rivals.read(robot, tmp_path / "fresh"), rivals.true(robot)
    found = score.row(robot, rivals.truth(robot), k, fresh, truth)
    assert max(found.values()) < PERFECT
    wrong = replace(k, lag=k.lag + 0.1, base={f: 1.1 * b for f, b in k.base.items()})
    worse = score.row(robot, rivals.kinematic(robot, wrong), wrong, fresh, truth)
    assert min(worse.values()) > 10 * PERFECT


def test_calibration_in_identified_json_is_judged():
    robot = NAMED["diff_own"]

    def number(value, error=0.0):
        return {"value": value + error, "interval90": [value + error - 1e-4, value + error + 1e-4]}

    calibration = {
        "surfaces": {
            floor.name: {
                "rolling_radius_m": [number(r) for r in floor.radius],
                "effective_track_m": number(floor.base, 0.001 if floor.name == "tile" else 0.0),
            }
            for floor in robot.floors
        },
        "centre_of_rotation_m": {},
        "nominal": {"wheel_radius_m": 0.0762, "track_m": 0.46},
        "pose_offset_m": [number(0.060), number(0.010)],
        "pose_yaw_rad": number(0.0),
        "pose_lag_s": number(0.040, 0.0002),
    }
    found = fits.covered(robot, calibration)
    assert len(found) == 9
    assert {name for name, held in found.items() if not held} == {"base tile", "lag"}
    k = fits.kinematics(calibration)
    np.testing.assert_allclose(k.radius["carpet"], robot.floor("carpet").radius)
    assert k.base == {"carpet": 0.448, "tile": 0.449}
    assert (k.place, k.lag) == ((0.060, 0.010), 0.0402)
