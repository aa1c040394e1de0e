"""The check finds every deliberate mistake and says how to correct it, on three kinds of drive."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from math import pi, tau

import numpy as np
import pytest

from slipid.data.check.ratios import ScaleRatio, single_causes
from slipid.data.check.sanity import findings
from slipid.data.log import WheelReading
from slipid.data.runs import collect
from tests.helpers.mistakes import MISTAKES
from tests.helpers.plain_robot import DRIVES, GEAR, Drive, as_runs, drive

MASS_KG = 12.0
ONLY_POSES = ("speed", "command", "twist", "current", "voltage", "gyro")


@cache
def driven(robot: Drive, seed: int = 0):
    return drive(robot, seed=seed)


def alarms(runs, geometry):
    return [f for f in findings(runs, geometry, MASS_KG) if f.severity != "note"]


def wrongly_named(mistake, robot):
    """Faults of the alarms that a mistake raises; empty if they are right."""
    found, wrong = alarms(*mistake.made(driven(robot), robot)), []
    if {f.kind for f in found} != set(mistake.kinds):
        wrong.append(f"found {sorted(f.kind for f in found)}, expected {sorted(mistake.kinds)}")
    wrong += [f"{f.kind} is a {f.severity}" for f in found if f.severity != "wrong"]
    if not any(mistake.says in (f.remedy or "") for f in found):
        wrong.append(f"no remedy says {mistake.says!r}")
    return wrong


def alarms_of_sound_runs(robot, seed, less):
    return alarms(as_runs([raw.less(*less) for raw in driven(robot, seed)]), robot.geometry)


def test_headings_over_1_are_no_sines():
    """On a skid-steer robot, a marker far off its centre looks like other headings."""
    raws = []
    for raw in driven(DRIVES[2]):
        heading = raw.pose[:, 2]
        marker = 0.5 * np.stack([-np.sin(heading), np.cos(heading), 0 * heading], axis=1)
        raws.append(replace(raw, pose=raw.pose + marker).less(*ONLY_POSES))
    found = {finding.kind for finding in alarms(as_runs(raws), DRIVES[2].geometry)}
    assert found == {"pose_unexplained"}


FEW = [(m, DRIVES[k % 3]) for k, m in enumerate(MISTAKES[::5])]


@pytest.mark.slow
@pytest.mark.parametrize(("mistake", "robot"), FEW, ids=lambda x: x.name)
def test_a_few_are_named(mistake, robot):
    assert wrongly_named(mistake, robot) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mistake", "robot"),
    [(m, DRIVES[k % len(DRIVES)]) for k, m in enumerate(MISTAKES)],
    ids=lambda x: x.name,
)
def test_every_mistake_is_named_on_one_of_the_drives(mistake, robot):
    assert wrongly_named(mistake, robot) == []


@pytest.mark.nightly
@pytest.mark.parametrize("robot", DRIVES, ids=lambda d: d.name)
@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda m: m.name)
def test_it_is_named(robot, mistake):
    assert wrongly_named(mistake, robot) == []


@pytest.mark.slow
@pytest.mark.parametrize("robot", DRIVES, ids=lambda d: d.name)
@pytest.mark.parametrize("less", [(), ONLY_POSES])
def test_sound_runs_raise_no_alarm(robot, less):
    assert alarms_of_sound_runs(robot, 0, less) == []


@pytest.mark.nightly
@pytest.mark.parametrize("robot", DRIVES, ids=lambda d: d.name)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("less", [(), ONLY_POSES, ("speed", "command"), ("twist", "gyro")])
def test_other_sound_runs_raise_none_either(robot, seed, less):
    assert alarms_of_sound_runs(robot, seed, less) == []


NAMED_BY_POSES = (
    *("sign of the first wheel", "sign of all wheels", "sign of the heading", "mirrored frame"),
    *("wheels 1 and 2 exchanged", "pose in mm as m", "pose in m as mm", "yaw in deg as rad"),
    *("encoder at the wheel", "half the wheel radius", "time in ms as s", "pose constant"),
    *("pose 2.5 s late", "poses of another run in all", "x and y swapped", "gear forgotten"),
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "name"),
    [
        pytest.param(robot, name, marks=[] if k % len(DRIVES) == n else pytest.mark.nightly)
        for k, name in enumerate(NAMED_BY_POSES)
        for n, robot in enumerate(DRIVES)
    ],
    ids=lambda x: x if isinstance(x, str) else x.name,
)
def test_encoders_and_poses_alone_name_it(robot, name):
    (mistake,) = (m for m in MISTAKES if m.name == name)
    runs, geometry = mistake.made([raw.less(*ONLY_POSES) for raw in driven(robot)], robot)
    found = alarms(runs, geometry)
    assert found
    assert found[0].severity == "wrong"
    text = " ".join(str(f) for f in found)
    assert {f.kind for f in found} & set(mistake.kinds) or mistake.says in text


def test_what_is_not_driven_is_a_note():
    (omni, *_) = DRIVES
    raws = [raw.less(*ONLY_POSES) for raw in driven(omni)]
    notes = [f for f in findings(as_runs(raws), omni.geometry) if f.severity == "note"]
    assert any("no command is logged" in f.found for f in notes)


def test_two_mistakes_are_both_named():
    (omni, *_) = DRIVES
    by_name = {m.name: m for m in MISTAKES}
    raws = by_name["sign of the heading"].runs(
        by_name["sign of the third wheel"].runs(driven(omni))
    )
    assert {f.kind for f in alarms(as_runs(raws), omni.geometry)} == {"wheel_sign", "heading_sign"}


def read_from(raws, **reading):
    """The runs as a reader would give them from a channel of the layout."""
    logs = as_runs(raws).logs
    return collect([replace(log, wheel_reading=WheelReading(**reading)) for log in logs])


def test_ticks_declared_as_radians_are_named_beside_the_wrong_unit_of_speed():
    (omni, *_) = DRIVES
    raws = [
        replace(
            raw.less("command", "twist"), angle=np.round(320 * raw.angle), speed=tau * raw.speed
        )
        for raw in driven(omni)
    ]
    ticks, speed = alarms(
        read_from(raws, channel="wheel_angle", gear_ratio=5.0, whole=True), omni.geometry
    )
    assert (ticks.kind, speed.kind) == ("wheel_ticks", "wheel_speed_unit")
    (per_rad,) = re.findall(r"like ticks \(about (\d+) per rad of wheel\)", ticks.found)
    (per_turn,) = re.findall(r"\(about (\d+) with the layout's gear_ratio = 5\)", ticks.remedy)
    assert float(per_rad) == pytest.approx(320, rel=0.01)
    assert float(per_turn) == pytest.approx(tau * 320 / 5, rel=0.01)
    assert "6.28 times too large" in speed.found


def test_whole_angles_are_asked_about_if_nothing_tells_their_unit():
    (omni, *_) = DRIVES
    raws = [
        replace(raw.less(*ONLY_POSES), angle=np.round(320 * raw.angle), pose=0 * raw.pose)
        for raw in driven(omni)
    ]
    found = alarms(read_from(raws, channel="wheel_angle", whole=True), omni.geometry)
    assert [f.severity for f in found if f.kind == "wheel_ticks"] == ["suspicious"]


@pytest.mark.parametrize(
    ("channel", "layout_gear", "advice"),
    [
        ("wheel_ticks", 1.0, "set gear_ratio = 16 in the layout"),
        ("wheel_ticks", GEAR, "multiply ticks_per_revolution"),
        ("motor_angle", GEAR, "multiply the layout's gear_ratio by"),
        ("wheel_angle", GEAR, "channel motor_angle instead of wheel_angle, with gear_ratio = 16"),
    ],
)
def test_a_gear_ratio_that_the_layout_has_is_not_advised(channel, layout_gear, advice):
    (omni, *_) = DRIVES
    raws = [
        replace(raw, angle=raw.angle * GEAR, speed=raw.speed * GEAR, command=raw.command)
        for raw in driven(omni)
    ]
    found = alarms(read_from(raws, channel=channel, gear_ratio=layout_gear), omni.geometry)
    remedies = " ".join(f.remedy for f in found)
    assert advice in remedies
    assert ("set gear_ratio = 16 in the layout" in remedies) == (layout_gear == 1.0)


def test_a_turned_marker_hides_no_other_unit_of_the_pose():
    """Path lengths of body and wheels are compared in the corrected axes of the heading."""
    (omni, *_) = DRIVES
    by_name = {m.name: m for m in MISTAKES}
    raws = by_name["marker turned by 90 deg"].runs(
        by_name["pose in mm as m"].runs([raw.less(*ONLY_POSES) for raw in driven(omni)])
    )
    assert {f.kind for f in alarms(as_runs(raws), omni.geometry)} == {
        "heading_offset",
        "pose_length",
    }


def test_a_heading_in_another_unit_makes_a_gyro_look_too_small():
    """One cause explains both ratios, and no finding blames the gyro."""
    deg = 180 / pi
    ratios = {
        "travel": ScaleRatio(0.8, 0.3, 0.8, 1.35),
        "turning": ScaleRatio(0.8 * deg, 0.35, 0.8, 1.35),
        "gyro": ScaleRatio(1 / deg, 0.75, 1.0, 1.33),
    }
    found, alone = single_causes(ratios, False, 0.05, 16.0, WheelReading())
    assert alone
    assert [(e.name, e.factor) for e in found] == [("heading", pytest.approx(deg))]
