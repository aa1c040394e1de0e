"""Runs in which the robot hardly moves are set aside, unless most are such."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slipid.data.check.short_runs import short_runs
from slipid.data.wheel_signals import first_moved
from tests.helpers.plain_robot import OMNI, RADIUS, Raw, as_runs, drive

FEWEST = 5


def cut(raw: Raw, rows: int) -> Raw:
    names = ("time", "angle", "speed", "command", "twist", "current", "voltage", "gyro", "pose")
    return replace(raw, **{name: getattr(raw, name)[:rows] for name in names})


def test_cut_runs_are_named_unless_half_of_all_are_such():
    raws = drive(OMNI, runs=5)
    first = first_moved(raws[1].angle - raws[1].angle[0], RADIUS)
    runs = as_runs([cut(raws[0], 2), cut(raws[1], first + 4), *raws[2:]])
    found = short_runs(runs, RADIUS, FEWEST)
    assert found.keys() == {0, 1}
    assert found[0] == "run_00.csv: no wheel rim moves by 10 mm"
    assert found[1].endswith("4 poses while the robot drives, 5 are needed")
    assert short_runs(runs.subset([0, 1, 2, 3]), RADIUS, FEWEST) == {}
    assert short_runs(as_runs(raws), RADIUS, FEWEST) == {}


@pytest.mark.parametrize("stands", ["wheels", "poses"])
def test_a_run_in_which_either_wheels_or_poses_move_is_kept(stands):
    raws = drive(OMNI, runs=3)
    raws[0] = (
        replace(raws[0], angle=0 * raws[0].angle)
        if stands == "wheels"
        else replace(raws[0], pose=0 * raws[0].pose)
    )
    assert short_runs(as_runs(raws), RADIUS, FEWEST) == {}
