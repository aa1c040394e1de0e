"""From a fit and its posterior to robot.json, and from there to the twin: one set of numbers."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import numpy as np
import pytest

from slipid.deploy.deploy import DRAWS, deploy, read_robot
from slipid.deploy.robot_record import DIRECTIONS, MOST_YAW_RATE, assumed_limits
from slipid.fitting.shared_effects import SpeedAndLoad, TravelConditions
from slipid.infer.fit_file import load
from slipid.model.geometry import omni
from slipid.model.robot import build
from slipid.robot.deployed import DeployedRobot
from slipid.robot.interface import MIXED_FLOORS_PENALTY, Settings
from slipid.robot.limits import Limits
from slipid.robot.record import Setting
from slipid.support.errors import DataError
from tests.helpers.shared import DRIVES

TRIAL = ("--plant", "twin", "--starts", 1, "--controllers", "encoder")
pytestmark = pytest.mark.slow  # a fit


@pytest.fixture
def fitted(small) -> Path:
    """A folder that `slipid identify` wrote; to be read alone."""
    return small[0] / "out"


def agree(out: Path) -> DeployedRobot:
    """The robot of a folder, every number of it that of identified.json."""
    robot = read_robot(out)
    fitted = json.loads((out / "identified.json").read_text())["parameters"]
    kept = json.loads((out / "robot.json").read_text())["parameters"]
    assert {path for path in fitted if not path.startswith("camera.")} == set(kept)
    for path, number in kept.items():
        assert {key: fitted[path][key] for key in number} == number
    numbers = robot.record.parameters
    assert float(robot.motor.resistance) == numbers["motor.resistance"].value
    assert tuple(robot.rest.tolist()) == numbers["robot.load_share@as_built"].value
    assert (out / "robot.json").stat().st_size < 300_000
    return robot


def test_a_fit_writes_its_robot(fitted):
    robot, fit = agree(fitted), load(fitted)
    record = robot.record
    assert record.source == "laplace"
    assert record.data == fit.data_hash
    assert record.drawn == DRAWS
    assert record.messages == fit.messages
    assert record.floors[0].seen.runs == len(DRIVES)
    assert record.floors[0].process[0] == pytest.approx(fit.variance["process.soft.along"] ** 0.5)
    assert Settings.of(robot).current_is_signed == fit.channels.signed
    penalty = Settings().further_floor_penalty
    assert Settings.of(robot).further_floor_penalty == penalty != MIXED_FLOORS_PENALTY
    free = {path for path in fit.space.slices if not path.startswith("camera.")}
    assert set(record.draws) == free
    for path, (value, origin) in fit.robot_settings.items():
        group, _, name = path.partition(".")
        assert getattr(getattr(record, group), name) == Setting(value, origin)
    assert {"limits.speed", "limits.voltage"} <= fit.robot_settings.keys()
    assert Limits.of(robot).speed == fit.robot_settings["limits.speed"][0]
    again = deploy(fit)
    assert again.record == record
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(robot), strict=True):
        np.testing.assert_array_equal(a, b)


def test_its_effect_table_equals_the_forecasts(fitted):
    robot, contact = read_robot(fitted), load(fitted).contact
    table = robot.record.loads[0].told
    for n, speed in enumerate(table.speeds):
        for k in (0, 17, 50):
            pace = (SpeedAndLoad(float(np.log(speed)), robot.load_setup),)
            mirror = contact.robot.geometry.mirror()
            conditions = TravelConditions(np.array([2 * np.pi * k / DIRECTIONS]), pace, mirror)
            known = contact.shared[robot.labels[0]].forecast(conditions)
            np.testing.assert_allclose(table.mean[0][n][k], -known.mean[0], rtol=2e-3, atol=1e-6)
            # the numbers are not known either
            least = np.sqrt(np.diag(known.covariance[0]))
            assert (np.array(table.left[0][n][k]) > 0.999 * least).all()


def test_after_sampling_no_two_files_disagree(fitted, sampled):
    out, before = sampled[0], read_robot(fitted).record
    record = agree(out).record
    assert record.source == "posterior"
    assert record.parameters["surface.soft.creep"].source == "posterior"
    assert record.numbers != before.numbers
    assert any("did not converge" in message for message in record.messages)
    assert len(set(record.draws["surface.soft.creep"])) > DRAWS // 4


def test_a_folder_without_a_robot_says_what_to_run(tmp_path):
    with pytest.raises(DataError, match=r"robot\.json: missing; write it by `slipid identify`"):
        read_robot(tmp_path)


@pytest.mark.parametrize(("top", "yaw_rate"), [(5.0, 0.2 / 0.125), (50.0, MOST_YAW_RATE)])
def test_a_robot_is_as_fast_as_its_wheels_allow_and_yaws_no_faster_than_is_usual(top, yaw_rate):
    robot = build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ["gray"])
    found = assumed_limits(robot, Setting(top), 2.0)
    assert found.speed.value == pytest.approx(0.04 * top)
    assert found.yaw_rate.value == pytest.approx(yaw_rate)
    volt = 16.0 * float(robot.motor.back_emf) * top + 2.0 * float(robot.motor.resistance)
    assert found.voltage.value == pytest.approx(volt)
