"""Drive controllers turn wheels as the robot has them; covariances are those of its errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from slipid.exports.ros.drive import rolling
from slipid.exports.ros.folder import ros2_files
from slipid.exports.ros.localization import (
    DISTANCE_M,
    PERIOD_S,
    OdometryErrors,
    odometry_errors,
    top_speed,
)
from slipid.exports.text import identifiers
from slipid.model import contact
from slipid.model.geometry import differential, general, mecanum, omni, skid_steer
from slipid.robot.deployed import DeployedRobot
from slipid.robot.limits import Limits
from tests.helpers.exported import doubtful, known, mecanum_robot
from tests.helpers.ros_yaml import parameters, read

OMNI, MECANUM = "omni_wheel_drive_controller", "mecanum_drive_controller"
DIFF = "diff_drive_controller"
EKF = "ekf_filter_node"


# drive controllers ---------------------------------------------------------------------------


def omni_speeds(p: Mapping[str, object], twist: np.ndarray) -> np.ndarray:
    """Joint speeds of omni_wheel_drive_controller, one by one."""
    count, (vx, vy, turn) = len(p["wheel_names"]), twist
    angles = [2 * np.pi * k / count + p["wheel_offset"] for k in range(count)]
    rims = [np.sin(a) * vx - np.cos(a) * vy - turn * p["robot_radius"] for a in angles]
    return np.array(rims) / p["wheel_radius"]


def mecanum_speeds(p: Mapping[str, object], twist: np.ndarray) -> np.ndarray:
    """Joint speeds of mecanum_drive_controller: front left, front right, rear right, rear left."""
    k = {name.removeprefix("kinematics."): x for name, x in p.items()}
    vx, vy, turn = twist
    vx, vy = vx + k["base_frame_offset.y"] * turn, vy - k["base_frame_offset.x"] * turn
    by_turn = k["sum_of_robot_center_projection_on_X_Y_axis"] * turn
    rims = [vx - vy - by_turn, vx + vy + by_turn, vx - vy + by_turn, vx + vy - by_turn]
    return np.array(rims) / k["wheels_radius"]


def diff_speeds(p: Mapping[str, object], twist: np.ndarray) -> np.ndarray:
    """Joint speeds of diff_drive_controller: those on the left, then those on the right."""
    apart = p["wheel_separation_multiplier"] * p["wheel_separation"]
    speeds = []
    for side, sign in (("left", -1), ("right", 1)):
        radius = p[f"{side}_wheel_radius_multiplier"] * p["wheel_radius"]
        speed = (twist[0] + sign * twist[2] * apart / 2) / radius
        speeds += [speed] * len(p[f"{side}_wheel_names"])
    return np.array(speeds)


def joints(p: Mapping[str, object]) -> list[str]:
    corners = ("front_left", "front_right", "rear_right", "rear_left")
    if "left_wheel_names" in p:
        return [*p["left_wheel_names"], *p["right_wheel_names"]]
    return p.get("wheel_names") or [p[f"{c}_wheel_command_joint_name"] for c in corners]


def reversed_joints(text: str) -> set[str]:
    """Joints that the README says to reverse."""
    rows = [line.split("|") for line in text.splitlines() if "**REVERSE**" in line]
    return {row[2].strip(" `") for row in rows}


LAYOUTS = {
    "omni": omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0),
    "omni, clockwise": omni([0.0, 240.0, 120.0], 0.2, 0.05),
    "omni, four, drives both ways": general(
        [(0.1, 0.1), (-0.1, -0.1), (0.1, -0.1), (-0.1, 0.1)],
        [135.0, 135.0, 45.0, 45.0],
        [90.0] * 4,
        0.04,
    ),
    "mecanum": mecanum(0.2, 0.15, 0.05),
    "mecanum, other order, one drive back": general(
        [(-0.2, -0.15), (0.2, 0.15), (0.2, -0.15), (-0.2, 0.15)],
        [0.0, 0.0, 180.0, 0.0],
        [135.0, 135.0, 45.0, 45.0],
        0.05,
    ),
    "mecanum, off the middle": general(
        [(0.3, 0.1), (0.3, -0.2), (-0.1, 0.1), (-0.1, -0.2)],
        [0.0] * 4,
        [135.0, 45.0, 45.0, 135.0],
        0.05,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LAYOUTS)
def test_controllers_turn_wheels_as_the_robot_has_them(name):
    robot = known(LAYOUTS[name])
    files = ros2_files(robot)
    controller, speeds = (OMNI, omni_speeds) if "omni" in name else (MECANUM, mecanum_speeds)
    p = parameters(files, "drive_controller.yaml", controller)
    back = reversed_joints(files["README.md"])
    for twist in (*np.eye(3), np.array([0.3, -0.2, 0.7])):
        wanted = np.asarray(robot.forward) @ twist / float(robot.frame.radius)
        for joint, speed in zip(joints(p), speeds(p, twist), strict=True):
            wheel = int(joint.split("_")[1]) - 1
            sign = -1 if joint in back else 1
            assert speed * sign == pytest.approx(wanted[wheel], abs=1e-9), joint
    assert len(set(joints(p))) == robot.wheels
    assert f"type: {controller}/" in files["README.md"]
    assert "The kinematics of this controller are the identified kinematics." in files["README.md"]


def calibrated(robot: DeployedRobot, floor: int, *rows: tuple[float, ...]) -> DeployedRobot:
    """The robot with calibrated kinematics on a floor."""
    floors = list(robot.record.floors)
    floors[floor] = replace(floors[floor], kinematics=rows)
    return DeployedRobot.of(replace(robot.record, floors=tuple(floors)))


AHEAD = {
    "differential": differential(0.16, 0.08),
    "skid steer, two motors": skid_steer(0.13, 0.19, 0.1, drive_of=(0, 1, 0, 1)),
    "skid steer, one motor back": general(
        [(-0.2, -0.3), (0.2, -0.3), (0.2, 0.3), (-0.2, 0.3)],
        [0.0, 0.0, 180.0, 0.0],
        [None] * 4,
        0.1,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", AHEAD)
def test_wheels_that_point_ahead_turn_as_each_floor_wants_them(name):
    robot = known(AHEAD[name])
    if name == "differential":
        left, right, apart = 0.081, 0.078, 0.33
        rows = ((left / 2, right / 2), (0.001, -0.001), (-left / apart, right / apart))
        robot = calibrated(robot, 0, *rows)
    files = ros2_files(robot)
    whole = parameters(files, "drive_controller.yaml", DIFF)
    back = reversed_joints(files["README.md"])
    worst = next(k for k, f in enumerate(robot.labels) if f"{f} (worst)" in files["README.md"])
    assert sorted(joints(whole)) == [f"wheel_{k + 1}_joint" for k in range(robot.wheels)]
    drives = robot.drive_of or range(robot.wheels)
    for k, floor in enumerate(robot.labels):
        own = parameters(files, f"floors/{floor}.yaml", DIFF)
        changed = [n for n in own if "multiplier" in n and whole[n] != own[n]]
        assert bool(changed) is (k != worst)
        assert not any("limit" in n or "names" in n for n in own)
        for twist in ((0.3, 0.0, 0.0), (0.0, 0.0, 0.7), (-0.2, 0.0, 0.4)):
            wanted = np.asarray(robot.inverse_kinematics)[k] @ twist
            for joint, speed in zip(joints(whole), diff_speeds(whole | own, twist), strict=True):
                drive = drives[int(joint.split("_")[1]) - 1]
                sign = -1 if joint in back else 1
                limit = 0.02 * np.abs(wanted).max()
                assert speed * sign == pytest.approx(wanted[drive], abs=limit), (floor, joint)
        if robot.calibrated[k]:
            assert own["left_wheel_radius_multiplier"] * 0.08 == pytest.approx(left, rel=1e-6)
            assert own["right_wheel_radius_multiplier"] * 0.08 == pytest.approx(right, rel=1e-6)
            assert own["wheel_separation_multiplier"] * 0.32 == pytest.approx(apart, rel=1e-6)
    limits = Limits.of(robot)
    assert whole["linear.x.max_velocity"] == -whole["linear.x.min_velocity"] == limits.speed
    assert whole["angular.z.max_velocity"] == limits.yaw_rate
    assert whole["linear.x.max_acceleration"] == limits.acceleration
    rim = whole["angular.z.max_acceleration"] * whole["wheel_separation"] / 2
    assert rim == pytest.approx(limits.acceleration)
    assert f"type: {DIFF}/DiffDriveController" in files["README.md"]
    assert parameters(files, "robot_localization.yaml", EKF)["odom0"] == f"/{DIFF}/odom"


@pytest.mark.slow
def test_a_robot_that_cannot_drive_sideways_does_not_go_there():
    """Only by its heading: on a calibrated floor nothing slips, and vy is known to be almost 0."""
    robot = known(AHEAD["differential"])
    floors = [
        replace(f, process=(0.01, 1e-4, 0.003), effect=(0.004, 1e-4, 0.02))
        for f in robot.record.floors
    ]
    robot = DeployedRobot.of(replace(robot.record, floors=tuple(floors)))
    one, apart = 0.04, 0.32
    rows = ((one, one), (0.0, 0.0), (-2 * one / apart, 2 * one / apart))
    robot = calibrated(robot, 0, *rows)
    files, speed = ros2_files(robot), top_speed(robot)
    p = parameters(files, "floors/firm.yaml", DIFF)
    x, y, *_, yaw = np.sqrt(p["pose_covariance_diagonal"])
    assert y == x == pytest.approx(np.hypot(0.004, 0.01), rel=0.15)
    assert yaw == pytest.approx(np.hypot(0.02, 0.003), rel=1e-3)
    vx, vy, *_, _ = np.sqrt(p["twist_covariance_diagonal"])
    assert vy == pytest.approx(1e-4 * np.hypot(speed, np.sqrt(speed / PERIOD_S)))
    assert vx > 20 * vy
    # on the other floor the wheels slip, but neither sideways nor for all of a sideways demand
    soft = parameters(files, "floors/soft.yaml", DIFF)
    assert np.sqrt(soft["pose_covariance_diagonal"][1]) < 0.03
    for name in ("robot_localization.yaml", "floors/firm.yaml", "floors/soft.yaml"):
        noise = parameters(files, name, EKF)["process_noise_covariance"]
        assert noise[7 * 16] < 1e-4 * noise[6 * 16]
    fused = parameters(files, "robot_localization.yaml", EKF)["odom0_config"]
    assert [k for k, used in enumerate(fused) if used] == [6, 7, 11]


def test_a_floor_that_is_driven_with_other_multipliers_is_less_certain():
    """The file without a floor has one floor's multipliers, and an error on the others."""
    robot = known(AHEAD["differential"])
    rolling = np.asarray(robot.inverse_kinematics)
    errs, off = odometry_errors(robot, rolling), odometry_errors(robot, 1.1 * rolling)
    assert off[0].slip[0] == pytest.approx(0.1 * np.sqrt(4 / 8), rel=0.1)
    assert errs[0].slip[0] < 0.01


@pytest.mark.slow
def test_identified_sizes_stand_in_exactly(robot, files):
    p = parameters(files, "drive_controller.yaml", OMNI)
    assert p["robot_radius"] == float(robot.frame.base)
    assert p["wheel_radius"] == float(robot.frame.radius)
    four = mecanum_robot()
    m = parameters(ros2_files(four), "drive_controller.yaml", MECANUM)
    assert m["kinematics.wheels_radius"] == float(four.frame.radius)
    reach = m["kinematics.sum_of_robot_center_projection_on_X_Y_axis"]
    assert reach == pytest.approx(0.35, rel=1e-12)


@pytest.mark.slow
def test_deviating_drives_are_averaged_and_reported(robot, files):
    p = parameters(files, "drive_controller.yaml", OMNI)
    mean = np.mean(robot.record.parameters["robot.drive_offset"].value)
    assert p["wheel_offset"] == pytest.approx(np.radians(60) + mean, abs=1e-12)
    assert "differ from the identified kinematics by at most 0.1778 %" in files["README.md"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "shape",
    [
        omni([0.0, 90.0, 180.0], 0.125, 0.04),
        general(
            [(0.2, 0.15), (0.2, -0.15), (-0.2, 0.15), (-0.2, -0.15)],
            [0.0] * 4,
            [120.0, 60.0] * 2,
            0.05,
        ),
        general([(0.2, 0.0), (-0.2, 0.1), (-0.2, -0.1)], [0.0, 0.0, 90.0], [90.0] * 3, 0.05),
        general([(0.2, 0.1), (-0.2, 0.1), (0.0, -0.1)], [0.0] * 3, [None] * 3, 0.05),
    ],
)
def test_a_robot_that_no_controller_fits_gets_none(shape):
    files = ros2_files(known(shape))
    assert "drive_controller.yaml" not in files
    assert "No drive controller of ros2_controllers" in files["README.md"]
    assert list(read(files, "floors/soft.yaml")) == [EKF]
    assert parameters(files, "robot_localization.yaml", EKF)["odom0"] == "/odom"


def without_multipliers(robot: DeployedRobot) -> tuple[OdometryErrors, ...]:
    """Errors with a controller that has the same kinematics on every floor."""
    return odometry_errors(robot, np.stack([rolling(robot)] * len(robot.labels)))


# covariances ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "errs",
    [
        OdometryErrors("goes off ahead", (0.05, 0.02, 0.01), (0.03, 0.02, 0.03), (0.04, 0.0, 0.0)),
        OdometryErrors(
            "turns all the way", (0.01, 0.02, 0.01), (0.01, 0.03, 0.1), (0.01, 0.02, 0.1)
        ),
        OdometryErrors("turns anew", (0.01, 0.02, 0.2), (0.01, 0.02, 0.01), (0.0, 0.0, 0.0)),
        OdometryErrors("no way", (0.02, 0.01, 0.1), (0.1, 0.01, 0.05), (0.0, 0.0, 0.1), False),
    ],
    ids=lambda errs: errs.floor,
)
def test_variances_are_those_of_errors_that_are_drawn(errs):
    """Paths straight ahead with an error that stays and one that comes anew, many times."""
    rng, steps, distance, speed, many = np.random.default_rng(0), 100, 1.5, 0.2, 10_000
    stays = rng.normal(size=(many, 1, 3)) * np.hypot(errs.effect, errs.slip)
    anew = rng.normal(size=(many, steps, 3)) * errs.process / np.sqrt(distance / steps)
    rate, step = stays + anew, distance / steps  # per metre
    heading = (np.cumsum(rate[..., 2], axis=1) - rate[..., 2] / 2) * step
    across = rate[..., 1].mean(axis=1) * distance + heading.mean(axis=1) * distance
    along, turned = rate[..., :1].mean(axis=1) * distance, rate[..., 2].mean(axis=1) * distance
    wide = max(along.var(), across.var())
    np.testing.assert_allclose(errs.pose(distance), [wide, wide, turned.var()], rtol=0.05)
    velocity = (rate[:, 0] * speed).var(axis=0)
    if errs.sideways:
        velocity[:2] = velocity[:2].max()
    np.testing.assert_allclose(errs.twist(speed, step / speed), velocity, rtol=0.05)
    after = (stays[:, 0] * distance).var(axis=0)
    wide = after[:2].max()
    walked = np.array(errs.walk(speed, distance)) * distance / speed
    np.testing.assert_allclose(walked, [wide, wide, after[2]], rtol=0.05)


@pytest.mark.slow
def test_slip_is_what_wheels_go_beyond_the_body(robot):
    speed, angles, forward = top_speed(robot), np.arange(24) * np.pi / 12, np.asarray(robot.forward)
    for k, errs in enumerate(without_multipliers(robot)):
        missed = []
        for angle in angles:
            u = np.array([np.cos(angle), np.sin(angle), 0.0])
            rim = jnp.asarray(speed * forward @ u)
            xi = contact.equilibrium(rim, robot.frame, robot.floors.at(k), robot.rest)
            miss = u - np.asarray(xi) / speed
            missed.append([miss @ u, miss[1] * u[0] - miss[0] * u[1], miss[2]])
        np.testing.assert_allclose(
            errs.slip, np.sqrt(np.mean(np.square(missed), axis=0)), rtol=1e-9
        )
        assert errs.process == tuple(robot.process[k].tolist())
        assert errs.effect == tuple(robot.effect[k].tolist())


@pytest.mark.slow
@pytest.mark.parametrize("made", [doubtful, mecanum_robot])
def test_covariances_are_those_of_the_floor_and_by_default_of_the_worst(made):
    robot = made()
    files, errs = ros2_files(robot), without_multipliers(robot)
    four = robot.wheels == 4
    controller = MECANUM if four else OMNI
    names = ("pose_covariance_diagonal", "twist_covariance_diagonal")
    names = names if four else ("diagonal_covariance.pose", "diagonal_covariance.twist")
    whole, found = parameters(files, "drive_controller.yaml", controller), {}
    for name, e in zip(identifiers(robot.labels, "floor"), errs, strict=True):
        p = parameters(files, f"floors/{name}.yaml", controller)
        assert list(p) == list(names)
        pose, twist = e.pose(DISTANCE_M), e.twist(top_speed(robot), PERIOD_S)
        for key, (x, y, yaw) in zip(names, (pose, twist), strict=True):
            assert p[key] == [x, y, 1e6, 1e6, 1e6, yaw]
        found[name] = p
    bad = max(found.values(), key=lambda p: p[names[0]][0])
    assert {name: whole[name] for name in names} == bad
    assert len({str(p) for p in found.values()}) == len(errs)


def test_the_filter_fuses_velocities_and_has_noise_by_floor(robot, files):
    p = parameters(files, "robot_localization.yaml", EKF)
    assert [k for k, used in enumerate(p["odom0_config"]) if used] == [6, 7, 11]
    assert len(p["odom0_config"]) == 15
    assert p["odom0"] == f"/{OMNI}/odom"
    noise = {}
    for name, e in zip(identifiers(robot.labels, "floor"), without_multipliers(robot), strict=True):
        own = parameters(files, f"floors/{name}.yaml", EKF)
        assert list(own) == ["process_noise_covariance"]
        matrix = np.reshape(own["process_noise_covariance"], (15, 15))
        assert (matrix == np.diag(np.diag(matrix))).all()
        assert (np.diag(matrix) > 0).all()
        assert matrix[[0, 1, 5], [0, 1, 5]].tolist() == list(e.walk(top_speed(robot), DISTANCE_M))
        rim = 25.0 * 0.04 * PERIOD_S
        np.testing.assert_allclose(np.diag(matrix)[[6, 7]], rim**2 / PERIOD_S)
        np.testing.assert_allclose(matrix[11, 11], (rim / 0.125) ** 2 / PERIOD_S)
        noise[name] = own["process_noise_covariance"]
    assert p["process_noise_covariance"] == max(noise.values(), key=lambda m: m[0])
    slipless = parameters(files, "robot_localization_slipid.yaml", EKF)
    assert slipless["process_noise_covariance"][0] < p["process_noise_covariance"][0]
