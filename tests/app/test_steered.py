"""Robots that steer: from config and logs to checks, with what slipid cannot do for them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slipid.app.config import parsed, read_config
from slipid.app.problem import read_fit_task
from slipid.fitting.calibration.result import Calibration
from slipid.parameter import as_numbers
from slipid.predict.kinematics import Calibrated, nominal
from slipid.predict.open_loop import replay_windows, tracks_from_increments
from slipid.predict.slip_models import FloorModels
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator
from slipid.robot.interface import Measurement
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from tests.benchmarks.every_robot import rivals
from tests.benchmarks.every_robot.drive import write
from tests.benchmarks.every_robot.fits import covered
from tests.benchmarks.every_robot.robots import ROBOTS
from tests.helpers.shared import invoke

MADE = {robot.name: robot for robot in ROBOTS}
CAR = replace(MADE["ackermann_car"], runs=2)


@pytest.fixture(scope="module")
def car(tmp_path_factory) -> Path:
    """Return a folder with the config and logs of a car."""
    folder = tmp_path_factory.mktemp("car")
    write(CAR, folder, seed=1)
    return folder


def changed(car: Path, tmp_path: Path, *pairs: tuple[str, str]) -> Path:
    """Return the path of a changed config of the car."""
    text = (car / "robot.toml").read_text(encoding="utf-8")
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "robot.toml"
    path.write_text(text, encoding="utf-8")
    return path


def read(config: Path, data: Path):
    with Reporter(quiet=True) as report:
        return read_fit_task(read_config(config), data, report)


STEERING = 'steering_angle = { column = "steering", unit = "rad" }'


def test_the_steering_angle_is_read_in_radians(car, tmp_path):
    task = read(car / "robot.toml", car / "logs")
    runs = task.dataset
    assert "steering" in repr(runs)
    rows = np.genfromtxt(car / "logs" / "asphalt" / "00.csv", delimiter=",", names=True)
    np.testing.assert_allclose(runs.logs[0].steering, rows["steering"], atol=1e-12)
    degrees = changed(car, tmp_path, (STEERING, STEERING.replace("rad", "deg")))
    turned = read(degrees, car / "logs").dataset.logs[0].steering
    np.testing.assert_allclose(turned, np.radians(rows["steering"]), atol=1e-12)
    assert task.robot.geometry.drives == 2


def test_a_slow_steering_angle_is_linear_between_its_readings(car, tmp_path):
    lines = (car / "logs" / "asphalt" / "00.csv").read_text(encoding="utf-8").splitlines()
    column = lines[0].split(",").index("steering")
    kept = [lines[0]]
    for k, line in enumerate(lines[1:]):
        cells = line.split(",")
        cells[column] = cells[column] if k % 5 == 0 else ""
        kept.append(",".join(cells))
    path = tmp_path / "logs" / "asphalt" / "00.csv"
    path.parent.mkdir(parents=True)
    path.write_text("\n".join(kept) + "\n", encoding="utf-8")
    every, slow = (
        read(car / "robot.toml", folder / "logs").dataset.logs[0] for folder in (car, tmp_path)
    )
    at = np.append(np.arange(0, slow.samples, 5), slow.samples)[:-1]
    between = np.interp(slow.time, slow.time[at], every.steering[at])
    np.testing.assert_allclose(slow.steering, between, atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (STEERING, "", "no steering angle; expected the channel steering_angle"),
        (
            "encoders = 2",
            "encoders = 1",
            "1 encoder on the rear axle, but .* has 2; expected the same: set robot.encoders = 2",
        ),
        ("encoders = 2", "encoders = 3", "encoders"),
        ("encoders = 2", "drives = [[1, 2]]", "drives is given; expected encoders"),
        (
            'drive = "steered"\nwheel_radius_m = 0.0325\nwheelbase_m = 0.324\ndriven = "rear"\n'
            "encoders = 2",
            'drive = "differential"\nwheel_radius_m = 0.0325\ntrack_m = 0.3',
            "'differential', which has no steered wheel, but",
        ),
        (STEERING, STEERING.replace("}", ", scale = 57.3 }"), "steering of .* rad"),
    ],
)
def test_mistakes_are_refused_with_what_is_expected(car, tmp_path, old, new, says):
    with pytest.raises(DataError, match=says):
        read(changed(car, tmp_path, (old, new)), car / "logs")


@pytest.mark.parametrize(
    ("old", "new", "kinds", "says"),
    [
        ("", "", set(), ""),
        (STEERING, STEERING.replace("}", ", scale = -1 }"), {"steering_sign"}, "right"),
        (STEERING, STEERING.replace("}", ", scale = 2.5 }"), {"steering_scale"}, "wheelbase_m"),
        ("0.0325", "0.065", {"wheel_scale"}, "0.4"),
        ('unit = "rad" }\nsteering', 'unit = "rad", scale = -1 }\nsteering', {"wheel_sign"}, "180"),
    ],
)
def test_check_compares_wheels_and_steering_with_the_poses(car, tmp_path, old, new, kinds, says):
    config = changed(car, tmp_path, (old, new)) if old else car / "robot.toml"
    out = tmp_path / "out"
    done = invoke("check", config, "--data", car / "logs", "--out", out, "--quiet")
    text = (out / "check.json").read_text(encoding="utf-8")
    assert "no force balance for steered wheels" in text
    found = json.loads(text)["findings"]
    assert {one["kind"] for one in found if one["severity"] != "note"} == kinds, found
    assert says in " ".join(f"{one['found']} {one['remedy']}" for one in found)
    assert done.exit_code == (1 if kinds else 0)


def path_errors(task, model: FloorModels, lag: float) -> np.ndarray:
    """Return the end-point error over the path of every run, with the true pose sensor."""
    camera = task.robot.camera
    place = as_numbers(list(CAR.place))
    robot = replace(task.robot, camera=replace(camera, lag=as_numbers(lag), marker_place=place))
    (w,) = replay_windows(task.dataset, robot)
    tracks = tracks_from_increments(robot, w, model.increments(w, robot))
    far = np.linalg.norm(np.diff(tracks.measured[..., :2], axis=1), axis=2).sum(axis=1)
    return np.linalg.norm(tracks.gap[:, :2], axis=1) / far


def test_steered_kinematics_predict_windows(car):
    """The true numbers predict paths to .5 % of their length, those of the config do not."""
    task, floor = read(car / "robot.toml", car / "logs"), CAR.floors[0]
    shape = task.robot.geometry
    radii = np.log(np.array(floor.radius) / CAR.nominal_radius)
    base = np.log(floor.base / CAR.nominal_base)
    numbers = [*radii, base, 0.0, CAR.steering_zero, CAR.steering_gain, floor.understeer]
    calibrated = FloorModels(Calibrated(shape=shape)).with_state({floor.name: np.array(numbers)})
    assert path_errors(task, calibrated, CAR.lag).max() < 0.005
    assert path_errors(task, FloorModels(nominal(shape)), CAR.lag).min() > 0.02
    late = path_errors(task, calibrated, CAR.lag + 0.2)  # wheels and steering of another time
    assert late.mean() > 2 * path_errors(task, calibrated, CAR.lag).mean()


def test_identify_calibrates_alone_and_says_so(car, tmp_path):
    out = tmp_path / "out"
    done = invoke("identify", car / "robot.toml", "--data", car / "logs", "--out", out)
    assert done.exit_code == 0, done.stderr
    assert "no force balance for steered wheels" in done.stderr
    assert "\n  effective wheelbase " in done.stdout.split("\nasphalt ")[1]
    content = json.loads((out / "identified.json").read_text(encoding="utf-8"))
    assert any("no force balance for steered wheels" in text for text in content["messages"])
    assert content["selected_model"] == {"asphalt": "calibrated"}
    inside = covered(CAR, content["calibration"])
    assert {"base asphalt", "steering gain", "steering zero_rad", "steering understeer"} <= set(
        inside
    )
    assert sum(inside.values()) >= len(inside) - 2, inside
    found = Calibration.of_json(content["calibration"])
    assert json.loads(json.dumps(found.to_json())) == content["calibration"]
    assert "straight ahead at 0.8" in str(found)


def test_its_estimator_steers(car, tmp_path):
    """Open loop from the first pose, with a steering angle in every third step."""
    out = tmp_path / "out"
    invoke("identify", car / "robot.toml", "--data", car / "logs", "--out", out, "--quiet")
    robot = DeployedRobot.load(out / "robot.json")
    estimator, track = Estimator(robot), rivals.read(CAR, car / "fresh")[0]
    assert float(robot.steering.wheelbase[0]) == pytest.approx(CAR.floors[0].base, rel=0.03)
    state = estimator.init()
    for k, dt in enumerate(np.diff(track.t, prepend=track.t[0])):
        angle = track.steering[k] if k % 3 == 0 else None  # the last reading counts
        measured = Measurement(wheel_angle=track.angle[k], steering_angle=angle)
        state, estimate = estimator.step(state, measured, dt)
        assert bool(estimate.finite)
    k = rivals.true(CAR)
    true_path = rivals.sensor_path(rivals.kinematic(CAR, k), replace(k, place=(0.0, 0.0)), track)
    path = np.hypot(*np.diff(true_path[:, :2], axis=0).T).sum()
    gap = np.asarray(estimate.pose)[:2] - true_path[-1, :2]
    assert np.hypot(*gap) < 0.01 * path
    assert float(estimate.pose[2]) == pytest.approx(true_path[-1, 2], abs=0.05)
    assert abs(true_path[-1, 2]) > 1
    done = invoke("export", out / "robot.json", "--out", tmp_path / "exported")
    assert done.exit_code == 2
    assert "`slipid export` are not available" in done.stderr
    assert "expected omni, mecanum, differential or skid-steer drives" in done.stderr
    with pytest.raises(ValueError, match="no hypothetical floors for a robot that steers"):
        robot.with_unseen()


def test_what_needs_a_force_balance_says_that_there_is_none(car, tmp_path):
    for data in ((), ("--data", car / "logs")):
        done = invoke("selftest", car / "robot.toml", *data, "--out", tmp_path / "out")
        assert done.exit_code == 2
        assert "no force balance for steered wheels" in done.stderr


def test_new_asks_for_the_axles_and_recognises_a_steering_angle(car, tmp_path):
    out = tmp_path / "new.toml"
    done = invoke("new", "--drive", "steered", "--driven", "front", "--yes", "--out", out)
    assert done.exit_code == 0
    assert "front axle, steered, positive to the left, 1 encoder" in done.stdout
    assert "selftest" not in done.stdout
    robot = parsed(out, out.read_text(encoding="utf-8")).content.robot
    assert (robot.drive, robot.driven, robot.encoders) == ("steered", "front", 1)
    done = invoke("new", "--from", car / "logs", "--out", out, "--force")
    content = read_config(out).content
    assert content.robot.drive == "steered"
    assert '"steering"' in str(content.layouts).replace("'", '"')
    done = invoke("new", "--drive", "steered", "--driven", "left", "--yes", "--out", out, "--force")
    assert done.exit_code == 2
    assert "expected rear or front" in done.stderr
