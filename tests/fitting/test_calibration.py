"""Calibration of made robots whose kinematics, pose sensor and lag are known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slipid.app.config import read_config
from slipid.app.problem import read_fit_task
from slipid.data.log import WheelReading
from slipid.data.runs import collect
from slipid.fitting.calibration.estimate import calibrate
from slipid.fitting.calibration.innovations import pose_tracks
from slipid.fitting.calibration.result import Calibration, Value
from slipid.search_space import Choice, Space
from slipid.support.progress import Reporter
from tests.benchmarks.every_robot.drive import commands, driven, table, write, write_csv
from tests.benchmarks.every_robot.fits import covered
from tests.benchmarks.every_robot.robots import ROBOTS, Floor, MadeRobot

MADE = {robot.name: robot for robot in ROBOTS}


@pytest.fixture(scope="module")
def task_of(tmp_path_factory):
    """Return a function from a made robot to its fit task."""
    made = {}

    def read(robot: MadeRobot):
        if robot.name not in made:
            folder: Path = tmp_path_factory.mktemp(robot.name)
            write(robot, folder, seed=3)
            with Reporter(quiet=True) as report:
                made[robot.name] = read_fit_task(
                    read_config(folder / "robot.toml"), folder / "logs", report
                )
        return made[robot.name]

    return read


def calibrated(task, *more: Choice, runs=None) -> Calibration:
    choices = [*task.choices, *more]
    data = task.dataset if runs is None else task.dataset.subset(runs)
    return calibrate(data, Space(task.robot, choices), choices)


def near(found: Value, truth: float, within: float) -> bool:
    return abs(found.value - truth) < within and found.verdict == "identified"


@pytest.mark.parametrize("name", ["diff_umbmark", "omni3_marker", "mecanum_wrong_base"])
def test_intervals_hold_the_true_numbers(task_of, name):
    """Nine in ten hold each; that two of seven fail has a probability of 15 %, three of 2 %."""
    robot = MADE[name]
    inside = covered(robot, calibrated(task_of(robot)).to_json())
    assert len(inside) >= 6
    assert sum(not held for held in inside.values()) <= 2, inside


def test_own_differential_drive(task_of):
    """Radii by floor to .1 %, the track, and place and lag of a tracker ahead of the axle."""
    found = calibrated(task_of(MADE["diff_own"]))
    for floor, radius in (("carpet", 0.0757), ("tile", 0.0770)):
        assert all(near(r, radius, 1e-3 * radius) for r in found.radius[floor])
        assert near(found.base[floor], 0.448, 1e-3)
    assert near(found.offset[0], 0.060, 1e-3)
    assert near(found.offset[1], 0.010, 1e-3)
    assert near(found.lag, 0.040, 2e-3)
    assert found.firmest == "tile"
    radius, track = found.multipliers["tile"]
    assert radius == pytest.approx([0.0770 / 0.0762] * 2, rel=1e-3)
    assert track == pytest.approx(0.448 / 0.46, rel=2e-3)


def test_skid_steer_has_a_track_and_a_centre_on_each_floor(task_of):
    found = calibrated(task_of(MADE["skid_two_floors"]))
    assert near(found.base["asphalt"], 0.825, 0.01)
    assert near(found.base["grass"], 0.99, 0.012)
    assert found.centre["asphalt"].verdict == "fixed"
    assert near(found.centre["grass"], -0.06, 0.01)


def test_what_only_turning_tells_is_not_identified_without_turns(task_of):
    found = calibrated(task_of(MADE["diff_straight"]))
    assert found.base["floor"].verdict == "not_identified"
    assert found.base["floor"].value == pytest.approx(0.31)
    assert [place.verdict for place in found.offset] == ["not_identified"] * 2
    assert [place.value for place in found.offset] == [0.0, 0.0]


def test_gentle_curves_show_the_track_of_wheels_that_skid(tmp_path):
    """Ten degrees a run: with the config's track, radii would be a fifth too small."""
    robot = replace(MADE["diff_own"], name="gentle", floors=(Floor("grass", (0.08, 0.08), 0.75),))
    rng = np.random.default_rng(5)
    write(replace(robot, runs=1), tmp_path, seed=3)
    for number in range(10):
        legs = np.array([[8.0, 0.3, 0.0, 0.04 * rng.uniform(-1, 1)]])
        run = driven(robot, robot.floors[0], legs, rng)
        write_csv(tmp_path / "logs" / "grass" / f"{number:02d}.csv", table(robot, run, rng))
    with Reporter(quiet=True) as report:
        task = read_fit_task(read_config(tmp_path / "robot.toml"), tmp_path / "logs", report)
    found = calibrated(task)
    assert all(near(r, 0.08, 5e-4) for r in found.radius["grass"])
    assert near(found.base["grass"], 0.75, 0.05)


def test_positions_without_headings(task_of):
    """Radii, track and the place of an antenna follow from positions alone."""
    data = task_of(MADE["diff_own"]).dataset
    logs = []
    for log in data.logs:
        pose = log.pose.copy()
        pose[:, 2] = np.nan
        logs.append(replace(log, pose=pose))
    task = replace(task_of(MADE["diff_own"]), dataset=collect(logs))
    found = calibrated(task, Choice("camera.lag", fixed=0.04))
    assert near(found.radius["tile"][0], 0.0770, 5e-4)
    assert near(found.base["tile"], 0.448, 3e-3)
    assert near(found.offset[0], 0.060, 3e-3)


def test_headings_alone_show_ratios_of_lengths(task_of):
    """The config's radius is taken as given; the track over it and the radii's ratio are right."""
    found = calibrated(task_of(MADE["diff_heading"]))
    left, right = found.radius["floor"]
    assert left.verdict == right.verdict == "not_identified"
    assert np.ptp(left.interval90) > 0.5 * left.value
    assert left.value / right.value == pytest.approx(0.0505 / 0.0495, rel=2e-3)
    assert near(found.base["floor"], 0.315, 2e-3)
    low, high = found.base["floor"].interval90
    assert low < 0.315 < high
    assert high - low < 0.01
    assert [place.verdict for place in found.offset] == ["not_identified"] * 2
    assert found.lag.verdict == "identified"
    for name, true in (("gyro_scale", 1.0), ("gyro_bias_rad_s", 0.003)):
        low, high = found.gyro[name].interval90
        assert low < true < high
        assert found.gyro[name].verdict == "identified"
    assert Calibration.of_json(found.to_json()).gyro == found.gyro


def test_a_number_that_the_config_fixes_stays(task_of):
    found = calibrated(task_of(MADE["diff_own"]), Choice("camera.lag", fixed=0.02))
    assert found.lag.value == 0.02
    assert found.lag.verdict == "fixed"
    assert found.lag.interval90 == (0.02, 0.02)


def test_a_prior_of_the_config_for_the_place_of_the_pose_sensor_counts(task_of):
    """The tracker is .06 m ahead; the user is sure that it is at .05 m."""
    sure = Choice("camera.marker_place", prior_mean=[0.05, 0.0], prior_std=1e-5, free=True)
    found = calibrated(task_of(MADE["diff_own"]), sure)
    assert found.offset[0].value == pytest.approx(0.05, abs=1e-4)


def test_poses_are_far_apart_where_wheel_speeds_are_read_rarely(task_of):
    """Speeds that are read every .15 s: poses every .6 s instead of every .2 s."""
    data, rng = task_of(MADE["diff_own"]).dataset, np.random.default_rng(0)

    def poses(channel: str) -> int:
        logs = []
        for log in data.logs:
            rows = int(np.ceil(0.15 / np.median(np.diff(log.time))))
            speed = np.repeat(rng.normal(size=(log.samples // rows + 1, 2)), rows, axis=0)
            reading = WheelReading(channel)
            logs.append(replace(log, wheel_speed=speed[: log.samples], wheel_reading=reading))
        tracks = pose_tracks(collect(logs), 0.0, np.full((3, 2), 0.02), 0.2)
        return int(np.isfinite(tracks.pose[..., 0]).sum())

    assert poses("wheel_angle") > 2.5 * poses("wheel_speed")


def test_intervals_from_one_run_are_wider_than_from_all(task_of):
    task = task_of(MADE["diff_umbmark"])
    one, every = calibrated(task, runs=[0]), calibrated(task)
    width = [np.ptp(found.base["floor"].interval90) for found in (one, every)]
    assert width[0] > 1.3 * width[1]
    low, high = one.base["floor"].interval90
    assert low < 0.170 < high


def test_a_run_with_a_wrong_label_has_little_weight(task_of):
    """One run on tile is labelled carpet: it is an outlier there, by its radius of 3 % more."""
    found = calibrated(task_of(MADE["diff_wrong_label"]))
    for floor, radius in (("carpet", 0.0485), ("tile", 0.050)):
        low, high = found.radius[floor][0].interval90
        assert low < radius < high
        assert found.radius[floor][0].value == pytest.approx(radius, rel=5e-3)


BICYCLE = MADE["bicycle_zero"]
FRONT = replace(  # another bicycle with all that steering has, of the same compiled functions
    BICYCLE,
    name="front",
    floors=(replace(BICYCLE.floors[0], understeer=0.02),),
    driven="front",
    place=(0.15, 0.02),
    lag=0.06,
    speed=1.2,
)


def test_bicycle(task_of):
    """Zero and gain of the steering; the tangent at 23 degrees tells gain from wheelbase."""
    found = calibrated(task_of(BICYCLE))
    assert near(found.radius["floor"][0], 0.033, 5e-5)
    assert near(found.steering["zero_rad"], -0.035, 5e-4)
    assert near(found.steering["gain"], 0.9, 0.03)
    assert near(found.steering["wheelbase_m"], 0.256, 0.01)
    ratio = found.steering["gain"].value / found.steering["wheelbase_m"].value
    assert ratio == pytest.approx(0.9 / 0.256, rel=5e-3)
    steering = found.to_json()["steering"]
    assert set(steering) == {"wheelbase_m", "zero_rad", "gain", "understeer"}
    assert steering["wheelbase_m"] == found.to_json()["surfaces"]["floor"]["effective_base_m"]


def test_driven_front_axle_with_understeer_and_a_sensor_that_is_late(task_of):
    found = calibrated(task_of(FRONT))
    assert near(found.radius["floor"][0], 0.033, 1e-4)
    assert near(found.steering["zero_rad"], -0.035, 1e-3)
    assert near(found.steering["understeer"], 0.02, 0.004)
    assert near(found.offset[0], 0.15, 3e-3)
    assert near(found.lag, 0.06, 3e-3)


@pytest.mark.parametrize("angles", [0.1, 0.0])
def test_small_steering_angles_do_not_tell_gain_from_wheelbase(tmp_path, angles):
    """Turns at small angles tell only gain over wheelbase, and one angle not even that."""
    robot = replace(BICYCLE, name=f"angles {angles}")
    rng = np.random.default_rng(5)
    write(replace(robot, runs=1), tmp_path, seed=3)
    for number in range(robot.runs):
        legs = commands(robot, rng, number, fresh=False) * [1, 1, 1, angles]
        run = driven(robot, robot.floors[0], legs, rng)
        write_csv(tmp_path / "logs" / "floor" / f"{number:02d}.csv", table(robot, run, rng))
    with Reporter(quiet=True) as report:
        task = read_fit_task(read_config(tmp_path / "robot.toml"), tmp_path / "logs", report)
    found = calibrated(task)
    gain, wheelbase, zero = (found.steering[n] for n in ("gain", "wheelbase_m", "zero_rad"))
    for number, truth in ((gain, 0.9), (wheelbase, 0.256), (zero, -0.035)):
        assert number.interval90[0] < truth < number.interval90[1]
    assert gain.verdict != "identified"
    assert wheelbase.verdict == "not_identified"
    if angles:
        assert zero.interval90[1] - zero.interval90[0] < 2e-3
        assert gain.value / wheelbase.value == pytest.approx(0.9 / 0.256, rel=0.02)


def test_errors_that_are_alike_within_a_run_widen_the_intervals(task_of):
    """Runs whose wheels roll 2 % farther or less far than others know the radius to a hundredth."""
    task = task_of(MADE["diff_umbmark"])
    shares = 0.02 * np.array([1.0, -1.3, 0.4, 1.2, -0.9, -0.4])
    logs = zip(task.dataset.logs, shares, strict=True)
    data = collect([replace(log, wheel_angle=log.wheel_angle / (1 + s)) for log, s in logs])
    found = calibrate(data, Space(task.robot, task.choices), task.choices)
    along, across, _ = found.noise.effect["floor"]
    assert along == pytest.approx(0.02, rel=0.5)
    assert across < 0.5 * along
    for radius, truth in zip(
        found.radius["floor"], MADE["diff_umbmark"].floors[0].radius, strict=True
    ):
        low, high = radius.interval90
        assert low < truth < high
        assert 0.01 < (high - low) / truth < 0.06
