"""Logs and config that contradict each other are named, and fitted only on request."""

from __future__ import annotations

from pathlib import Path

import pytest

from slipid.app.check import sanity
from slipid.app.config import FitSection, read_config
from slipid.app.identify import checked_task
from slipid.app.problem import FitTask, read_fit_task
from slipid.model.robot import Robot
from slipid.search_space import Space
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from tests.helpers.plain_config import ROBOT, config
from tests.helpers.plain_robot import BASE, GEAR, SKID, as_runs, drive
from tests.helpers.shared import invoke


def kinds(file: Path) -> list[str]:
    job = read_fit_task(read_config(file), file.parent / "logs", Reporter(quiet=True))
    return [f.kind for f in sanity(job) if f.severity == "wrong"]


def test_a_sound_config_is_not_held_back(tmp_path):
    assert kinds(config(tmp_path)) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("said", "instead", "kind"),
    [
        ("mass_kg = 12.0\n", "", "forgotten"),
        (f"gear_ratio = {GEAR}\n", "", "forgotten"),
        (f"gear_ratio = {GEAR}\n", "gear_ratio = 20\n", "two_gear_ratios"),
        ("[60, 180, 300]", "[180, 60, 300]", "wheel_order"),
        (f"base_radius_m = {BASE}", f"base_radius_m = {10 * BASE}", "base_radius"),
    ],
)
def test_mistakes_in_the_config_are_named(tmp_path, said, instead, kind):
    assert kinds(config(tmp_path, ROBOT.replace(said, instead))) == [kind]


def test_a_gear_that_is_wrong_in_both_places_is_named(tmp_path):
    robot = ROBOT.replace(f"gear_ratio = {GEAR}", "gear_ratio = 1")
    assert kinds(config(tmp_path, robot, gear=1.0)) == ["wheel_scale"]


@pytest.mark.slow
def test_identify_refuses_and_names_the_option_to_go_on(tmp_path):
    file = config(tmp_path, ROBOT.replace("mass_kg = 12.0\n", ""))
    with pytest.raises(DataError, match=r"(?s)1\. mass_kg \(.*into \[robot\].*--anyway"):
        checked_task(file, tmp_path / "logs", Reporter(quiet=True))
    assert not (tmp_path / "out").exists()
    words = ("--data", tmp_path / "logs", "--out", tmp_path / "out", "--quiet")
    assert invoke("identify", file, *words).exit_code == 2


@pytest.mark.slow
def test_check_reports_it_first_and_exits_with_one(tmp_path):
    file = config(tmp_path, ROBOT.replace("[60, 180, 300]", "[180, 60, 300]"))
    words = ("--data", tmp_path / "logs", "--out", tmp_path / "out", "--quiet")
    result = invoke("check", file, *words)
    assert result.exit_code == 1
    assert result.stdout.startswith("wrong: the wheels' columns are in another order")
    assert '"kind": "wheel_order"' in (tmp_path / "out" / "check.json").read_text()


@pytest.mark.parametrize(
    ("signed", "volts", "expected"), [(False, True, 1), (True, True, 0), (False, False, 0)]
)
def test_magnitudes_beside_voltages_are_refused_where_wheels_drag_each_other(
    signed, volts, expected
):
    raws = [raw.less(*([] if volts else ["voltage"])) for raw in drive(SKID, runs=2)]
    runs = as_runs(raws, signed)
    robot = Robot.of(SKID.geometry, 50.0)
    found = sanity(FitTask(runs, robot, (), FitSection()))
    assert [f.kind for f in found].count("braking_unseen") == expected


def test_torques_of_joints_need_no_gear_and_hold_electric_parameters_fixed(tmp_path):
    robot = ROBOT.replace(f"gear_ratio = {GEAR}\n", "")
    file = config(tmp_path, robot)
    assert "forgotten" in kinds(file)
    text = file.read_text().replace("columns.current]", "columns.wheel_torque]")
    prior = '"motor.back_emf" = { prior = { mean = 0.05, std = 0.02 } }'
    text = text.replace('unit = "A"', 'unit = "N*m"') + f"[parameters]\n{prior}\n"
    file.write_text(text)
    assert "forgotten" not in kinds(file)
    job = read_fit_task(read_config(file), tmp_path / "logs", Reporter(quiet=True))
    space = Space(job.robot, job.choices)
    electric = {"resistance", "back_emf", "efficiency", "inductance", "brush_drop"}
    assert not electric & {e.path.removeprefix("motor.") for e in space.free}
    assert float(space.template.motor.gain) == pytest.approx(1.0)
