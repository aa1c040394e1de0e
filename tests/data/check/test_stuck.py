"""A wheel that rightly stands still on a slippery floor is not said to have a dead encoder."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slipid.api.calibration import calibrate
from slipid.app.check import sanity
from slipid.app.config import read_config
from slipid.app.logs import packaged_config, unpack
from slipid.app.problem import read_fit_task
from slipid.data.check.findings import wrong
from slipid.data.check.sanity import findings
from slipid.data.check.stuck import stuck_channels
from slipid.model.geometry import omni
from slipid.model.robot import Robot
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from tests.helpers.plain_robot import MECANUM, OMNI, SKID, as_runs, drive

SPEED = 0.3


def straight(robot, direction, drift, *less):
    """Two runs straight ahead in a direction [rad], with a body that slips to the left of it."""
    raws = []
    for raw in drive(robot, runs=2):
        way = SPEED * raw.time
        c, s = np.cos(direction), np.sin(direction)
        turns = np.array([c, s, 0.0]) @ robot.rolling.T
        pose = np.stack([c * way - s * drift * way, s * way + c * drift * way, 0 * way], axis=1)
        pose += np.random.default_rng(0).normal(0, [0.002, 0.002, 0.005], pose.shape)
        twist = SPEED * np.array([c, s, 0.0]) * np.ones((len(way), 1))
        command = SPEED * turns * np.ones((len(way), 1))
        moved = replace(raw, angle=np.outer(way, turns), pose=pose, twist=twist, command=command)
        raws.append(moved.less("speed", *less))
    return raws


def kinds(raws, robot):
    found, useless = stuck_channels(as_runs(raws), robot.geometry)
    assert bool(found) == useless.any()
    return [finding.kind for finding in found]


@pytest.mark.parametrize("rotated", [0.0, 0.6])
def test_a_wheel_on_whose_axle_the_robot_drives_stands_still(rotated):
    raws = straight(OMNI, 0.0, 0.2, "command", "twist")
    raws = [replace(raw, pose=raw.pose + np.array([0.0, 0.0, rotated])) for raw in raws]
    assert kinds(raws, OMNI) == []


@pytest.mark.parametrize("less", ["command", "twist"])
def test_a_wheel_that_is_commanded_to_stand_still_may_be_dragged(less):
    """Slip as strong as this, to either side, looks like a dead encoder without a command."""
    known, unknown = (
        [raw for drift in (0.8, -0.8) for raw in straight(OMNI, 0.0, drift, *names)]
        for names in ((less,), ("command", "twist"))
    )
    assert kinds(known, OMNI) == []
    assert kinds(unknown, OMNI) == ["wheel_constant"]


def test_two_mecanum_wheels_may_stand_still_together():
    along, ahead = (straight(MECANUM, a, 0.8, "command", "twist") for a in (0.25 * np.pi, 0.0))
    assert kinds([*along, *ahead], MECANUM) == []


@pytest.mark.parametrize("less", [("command", "twist"), ("command",), ("twist",)])
def test_a_command_confirms_that_a_wheel_should_turn(less):
    """Without a command a slow wheel beside faster ones may stand still by slip."""
    (_, slow, *_), direction = OMNI.rolling[:, :2], np.radians(20.0)
    assert abs(slow @ [np.cos(direction), np.sin(direction)]) > 0
    raws = straight(OMNI, direction, 0.0, *less)
    raws = [replace(raw, angle=raw.angle * [1.0, 0.0, 1.0]) for raw in raws]
    assert kinds(raws, OMNI) == ([] if len(less) > 1 else ["wheel_constant"])


def test_calibrate_refuses_a_dead_encoder():
    good, bad = straight(OMNI, 0.5 * np.pi, 0.0, "command", "twist")
    raws = [good, replace(bad, angle=bad.angle * [1.0, 0.0, 1.0])]
    with pytest.raises(DataError, match=r"wheel 2 never turns in 1 of 2 runs.*run_01.csv"):
        calibrate(as_runs(raws), Robot.of(OMNI.geometry), quiet=True)


@pytest.mark.parametrize("robot", [OMNI, SKID], ids=["omni", "skid"])
@pytest.mark.parametrize("half", [slice(100, None), slice(None, 101)], ids=["end", "beginning"])
def test_an_encoder_that_stops_counting_midway_is_found(robot, half):
    raws = straight(robot, 0.5 * np.pi if robot is OMNI else 0.0, 0.0)
    assert kinds(raws, robot) == []
    angle = raws[1].angle.copy()
    angle[half, 1] = angle[100, 1]
    found, useless = stuck_channels(
        as_runs([raws[0], replace(raws[1], angle=angle)]), robot.geometry
    )
    assert [finding.kind for finding in found] == ["wheel_constant"]
    assert "wheel 2 does not count at the beginning or the end of 1 of 2 runs" in str(found[0])
    assert useless.tolist() == [False, True]


def test_a_wheel_that_stands_still_at_the_end_may_be_right():
    """A robot that first turns and then drives along the axle of a wheel."""
    first, last = straight(OMNI, 0.5 * np.pi, 0.0)[0], straight(OMNI, 0.0, 0.0)[1]
    rows = len(first.time)
    joined = replace(
        first,
        time=np.arange(2 * rows) * np.diff(first.time).mean(),
        **{
            name: np.concatenate([a := getattr(first, name), (a[-1] if adds else 0) + b])
            for name, adds in (("angle", 1), ("pose", 1), ("command", 0), ("twist", 0))
            for b in [getattr(last, name)]
        },
    ).less("speed", "current", "voltage", "gyro")
    assert kinds([joined, joined], OMNI) == []


def test_exchanged_wheels_are_named_where_one_stands_still():
    along = straight(OMNI, 0.0, 0.0, "command", "twist")[0]
    others = straight(OMNI, 0.5 * np.pi, 0.0, "command", "twist")
    exchanged = replace(along, angle=along.angle[:, [1, 0, 2]])
    found, _ = stuck_channels(as_runs([exchanged, *others]), OMNI.geometry)
    assert "its column may be exchanged with that of wheel" in str(found[0])
    dead = replace(others[0], angle=others[0].angle * [1.0, 0.0, 1.0])
    found, _ = stuck_channels(as_runs([dead, along, others[1]]), OMNI.geometry)
    assert "exchanged" not in str(found[0])


@pytest.mark.slow
def test_rotated_markers_and_wheels_are_not_stuck_encoders(tmp_path):
    unpack(tmp_path)
    config = tmp_path / "robot.toml"
    config.write_text(packaged_config("robotino.toml"), encoding="utf-8")
    task = read_fit_task(read_config(config), tmp_path / "fit" / "logs", Reporter(quiet=True))
    assert wrong(sanity(task)) == ()
    rotated = task.dataset.pose + np.array([0.0, 0.0, np.radians(20.0)])
    assert wrong(sanity(replace(task, dataset=replace(task.dataset, pose=rotated)))) == ()
    runs, lengths = task.dataset, (0.125, 0.04, 16.0)
    for azimuths in ([0.0, 120.0, 240.0], [60.0, 300.0, 180.0]):
        first, *others = wrong(findings(runs, omni(azimuths, *lengths)))
        assert first.kind in ("wheel_azimuths", "wheel_order")
        assert "wheel_constant" not in {finding.kind for finding in others}
