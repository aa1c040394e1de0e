"""A new config that starts from a reference robot."""

from __future__ import annotations

from fnmatch import fnmatchcase
from pathlib import Path

import pytest

from slipid.app.config import geometry, parsed, read_config
from slipid.app.logs import packaged_path
from slipid.app.new.config_text import new_config
from slipid.app.new.draft import template_draft
from slipid.app.new.from_reference import start_lines, wheeled_names
from slipid.app.new.guess import guess_robot
from slipid.app.new.robot_questions import ask
from slipid.app.reference.keys import parameter_rows
from slipid.app.reference_robots import reference_robot
from slipid.support.errors import DataError


def made(**options: str):
    return parsed(Path("m.toml"), new_config(template_draft(ask(options, None)), "m.toml").text)


def test_motors_on_a_bench_are_no_robots():
    assert wheeled_names() == ("husky", "omni3", "robotino", "warthog")
    with pytest.raises(DataError, match=r"robotino_motor: a motor on a bench.*one of husky, omni3"):
        ask({"robot": "robotino_motor"}, None)


@pytest.mark.parametrize("name", wheeled_names())
def test_the_robot_has_the_geometry_of_the_config_that_was_identified(name):
    config = made(robot=name)
    own = read_config(packaged_path(reference_robot(name).origin.config)).content
    assert config.content.robot.drive == own.robot.drive
    assert config.content.robot.mass_kg == (own.robot.mass_kg or 10.0)
    for attribute in ("place", "drive_angle", "roller_angle", "drive_of", "gear_ratio"):
        mine, theirs = (getattr(geometry(one.robot), attribute) for one in (config.content, own))
        assert mine == theirs
    assert geometry(config.content.robot).wheel_radius == geometry(own.robot).wheel_radius


@pytest.mark.parametrize("name", wheeled_names())
def test_every_start_value_is_that_of_a_parameter(name):
    config = made(robot=name)
    paths = [row.path for row in parameter_rows(config)]
    for pattern in config.content.parameters:
        assert any(fnmatchcase(path, pattern) for path in paths), pattern


def test_start_values_are_those_of_the_reference():
    numbers, content = reference_robot("robotino").numbers, made(robot="robotino").content
    low, high = (numbers[f"surface.{floor}.creep"].value for floor in ("table", "green"))
    assert low < content.parameters["surface.*.creep"].start < high
    prior = content.parameters["motor.resistance"].prior
    assert (prior.mean, prior.std) == (5.95, 0.3)
    assert content.parameters["motor.back_emf"].prior.mean == pytest.approx(0.0514, abs=0.001)
    text = new_config(template_draft(ask({"robot": "robotino"}, None)), "m.toml").text
    assert "0.46 on gray" in text
    assert "# Nominal sizes of the reference robot robotino: FESTO" in text


def test_no_friction_without_currents():
    with_currents = {line.key for line in start_lines("robotino", {"current"})}
    without = {line.key for line in start_lines("robotino", ())}
    assert with_currents - without == {'"motor.coulomb_friction"', '"surface.*.friction"'}
    assert '"surface.*.creep"' in without


def test_options_are_stronger_than_the_reference():
    robot = made(robot="husky", wheel_radius_m="0.17", shared="no").content.robot
    assert (robot.wheel_radius_m, robot.drives, robot.half_width_m) == (0.17, None, 0.275)


def test_another_drive_beside_the_reference_is_refused():
    assert ask({"robot": "husky", "drive": "skid"}, None).drive == "skid"
    with pytest.raises(DataError, match="--drive omni: reference robot husky has drive skid"):
        ask({"robot": "husky", "drive": "omni"}, None)


def test_nothing_is_open_of_what_the_reference_has():
    answers = ask({"robot": "warthog"}, None)
    assert "wheel_radius_m" not in answers.defaults
    assert answers.robot == "warthog"
    assert "mass_kg" in ask({"robot": "omni3"}, None).defaults  # not in the logs' metadata


def test_a_reference_robot_may_answer_the_first_question():
    asked: list[tuple[str, str]] = []

    def asker(asks: str, default: str, wrong: str) -> str:
        asked.append((asks, default))
        return "Husky" if len(asked) == 1 else "0.6" if asks.startswith("track") else default

    answers = ask({}, asker)
    assert "or a robot to start from: husky, omni3, robotino, warthog" in asked[0][0]
    assert (answers.robot, answers.drive, answers.track_m) == ("husky", "skid", 0.6)
    assert (answers.wheelbase_m, answers.shared, answers.wheel_radius_m) == (0.512, True, 0.165)
    assert dict(asked)["wheel radius [m]"] == "0.165"
    assert answers.defaults == frozenset()


def test_a_wrong_first_answer_names_the_drives():
    answers = iter(["huskey", "omni", *["3", "60, 180, 300", "0.2", "0.05", "1", "9", "0"]])
    messages = []

    def asker(asks: str, default: str, wrong: str) -> str:
        messages.append(wrong)
        return next(answers, "")

    assert ask({}, asker).robot == ""
    assert "'huskey': no such drive" in messages[1]


def test_logs_do_not_change_the_drive_of_the_reference():
    answers, _ = guess_robot({"robot": "husky"}, 4, ())
    assert (answers.drive, answers.robot, answers.shared) == ("skid", "husky", True)
