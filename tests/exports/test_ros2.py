"""A ROS 2 folder: parameters by the names that ROS has for them, read back to the last bit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from slipid.exports.description import header, table_files
from slipid.exports.ros.folder import ros2_files
from slipid.exports.ros.yaml_text import scalar
from slipid.exports.text import identifiers
from slipid.model.geometry import skid_steer
from slipid.robot.deployed import DeployedRobot
from slipid.robot.gains import Gains, used_gains
from slipid.robot.interface import Settings
from slipid.robot.limits import Limits
from tests.helpers.exported import LOADS, ODD, known, mecanum_robot
from tests.helpers.ros_yaml import flat, parameters, read


@pytest.fixture(scope="module")
def four() -> DeployedRobot:
    return mecanum_robot()


# files ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_file_says_of_which_robot_it_is(robot, files):
    head = [f"# {line}" for line in header(robot)]
    for name, text in files.items():
        lines = text.splitlines()
        if name.endswith(".yaml"):
            assert lines[: len(head)] == head
            read(files, name)
        assert robot.record.numbers in text
        assert "as built" in text or name.endswith(".xml")
    assert "Load set-up: as built; identified load set-ups: as built, moved." in header(robot)
    assert any(line.startswith("WARNING: NOT IDENTIFIED") for line in header(robot))
    assert all(line.isprintable() for line in header(robot))


@pytest.mark.slow
def test_every_file_is_in_the_readme(files):
    assert all(f"| `{name}` |" in files["README.md"] for name in files if name != "README.md")


def test_floors_have_a_file_each(files):
    names = identifiers(tuple(sorted(ODD)), "floor")
    assert {name for name in files if name.startswith("floors/")} == {
        f"floors/{name}.yaml" for name in names
    }


# numbers as text -----------------------------------------------------------------------------


@example(1e-05)
@example(1e16)
@example(-5e-324)
@example(-0.0)
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_floats_read_back_as_the_same_floats(x):
    back = yaml.safe_load(scalar(x))
    assert isinstance(back, float)
    assert back.hex() == x.hex()


@given(st.text())
def test_words_read_back_as_the_same_words(x):
    assert yaml.safe_load(scalar(x)) == x


def test_names_are_names_of_fields_and_differ():
    labels = ("Class", "class", "2nd", "a_b", "AB", "a  b", "", "ä", "default", "ab v2")
    names = identifiers(labels, "floor")
    assert all(name.isidentifier() and name == name.lower() for name in names)
    assert len({name.replace("_", "") for name in names}) == len(labels)
    assert names[:4] == ("floor_class", "floor_class_v2", "floor_2nd", "a_b")


# the node ------------------------------------------------------------------------------------

TYPES = {"bool": bool, "double": float, "int": int, "string": str}
CHECKS = {
    "gt<>": lambda x, bound: x > bound,
    "lt<>": lambda x, bound: x < bound,
    "gt_eq<>": lambda x, bound: x >= bound,
    "one_of<>": lambda x, choices: x in choices,
    "fixed_size<>": lambda x, size: len(x) == size,
    "unique<>": lambda x: len(set(x)) == len(x),
    "element_bounds<>": lambda x, low, high: all(low <= y <= high for y in x),
    "lower_element_bounds<>": lambda x, low: all(low <= y for y in x),
    "upper_element_bounds<>": lambda x, high: all(y <= high for y in x),
}
"""Validators of generate_parameter_library, by what its documents say of them."""
KEYS = {"type", "default_value", "description", "read_only", "validation"}


def faults(given: Mapping[str, object], declared: Mapping[str, dict]) -> list[str]:
    """Return the errors of parameters by their declaration."""
    wrong = [f"{name} is not declared" for name in given if name not in declared]
    for name, d in declared.items():
        if name not in given:
            wrong.append(f"{name} is missing")
            continue
        value, (kind, _, array) = given[name], d["type"].partition("_")
        several = isinstance(value, list)
        if several != bool(array) or any(
            type(x) is not TYPES[kind] for x in (value if several else [value])
        ):
            wrong.append(f"{name} is no {d['type']}")
            continue
        for check, arguments in d.get("validation", {}).items():
            if not CHECKS[check](value, *(arguments or [])):
                wrong.append(f"{name}: {check} {arguments}")
    return wrong


@pytest.fixture(scope="module")
def node(files) -> dict[str, object]:
    return parameters(files, "slipid.yaml", "slipid")


@pytest.fixture(scope="module")
def declared(files) -> dict[str, dict]:
    tree = read(files, "slipid_parameters.yaml")
    assert list(tree) == ["slipid"]
    return flat(tree["slipid"], leaf="type")


@pytest.mark.slow
def test_parameters_are_as_they_are_declared(node, declared, four):
    assert faults(node, declared) == []
    other = ros2_files(four)
    tree = flat(read(other, "slipid_parameters.yaml")["slipid"], leaf="type")
    assert faults(parameters(other, "slipid.yaml", "slipid"), tree) == []


def test_defaults_are_the_values_and_all_is_described(node, declared):
    for name, d in declared.items():
        assert set(d) <= KEYS
        assert d["default_value"] == node[name]
        assert d["description"]
        changes = name.startswith(("gains.", "limits.", "sensors."))
        assert d["read_only"] is not changes


@pytest.mark.parametrize(
    ("name", "value", "fault"),
    [
        ("motor.resistance", 0.0, "gt<>"),
        ("motor.resistance", 5, "no double"),
        ("motor.efficiency", 1.1, "lt<>"),
        ("motor.more", 1.0, "not declared"),
        ("robot.load_share.moved", [0.5, 0.6, -0.1], "element_bounds<>"),
        ("robot.load_share.moved", [0.5, 0.5], "fixed_size<>"),
        ("load_setup", "far", "one_of<>"),
        ("floors", ["a", "a", "b", "c"], "unique<>"),
        ("wheels.grips", [0, 0, 0], "no bool_array"),
        ("errors.wet_sand.process", [0.0, -1.0, 0.0], "lower_element_bounds<>"),
        ("limits.speed", 0.0, "gt<>"),
    ],
)
def test_wrong_parameters_are_refused_by_the_declaration(node, declared, name, value, fault):
    found = faults({**node, name: value}, declared)
    assert len(found) == 1
    assert fault in found[0]


@pytest.mark.slow
def test_motors_that_turn_several_wheels_have_one_number_each():
    robot = known(skid_steer(0.13, 0.19, 0.1, drive_of=(0, 1, 0, 1)))
    files = ros2_files(robot)
    tree = flat(read(files, "slipid_parameters.yaml")["slipid"], leaf="type")
    found = parameters(files, "slipid.yaml", "slipid")
    assert faults(found, tree) == []
    assert found["kinematics.forward"] == robot.forward.ravel().tolist()
    assert len(found["wheels.place"]) == 8
    assert "| wheel 3, drive 1 | `wheel_3_joint` |" in files["README.md"]
    rows = table_files(robot)["gains.csv"].splitlines()
    assert sum(row.startswith("inverse,") for row in rows) == 6
    assert any("robot.radius_deviation,drive 2" in row for row in rows)
    node = files["node/src/slipid_node.cpp"]
    assert 'std::vector<std::string>{"wheel_1_joint", "wheel_2_joint"}' in node


def test_numbers_read_back_to_the_last_bit(robot, node):
    record = robot.record
    motor = {e: node[f"motor.{e}"] for e in ("resistance", "back_emf", "rotor_inertia")}
    assert motor == {e: float(getattr(robot.motor, e)) for e in motor}
    assert node["wheels.gear_ratio"] == robot.motor.gear_ratio
    assert node["robot.load_share.as_built"] == robot.rest.tolist()
    assert node["robot.drive_offset"] == list(record.parameters["robot.drive_offset"].value)
    assert node["kinematics.forward"] == robot.forward.ravel().tolist()
    assert node["kinematics.inverse"] == robot.inverse.ravel().tolist()
    assert node["seen.wheel_curve"] == robot.wheel_curve.ravel().tolist()
    assert [node["seen.highest_speed"], node["seen.highest_current"]] == robot.highest.tolist()
    for k, name in enumerate(node["floors"]):
        for quantity in ("friction", "creep", "load_bias", "drag_exponent"):
            value = getattr(robot.floors, quantity)[k].tolist()
            assert node[f"surface.{name}.{quantity}"] == value
        assert node[f"errors.{name}.process"] == robot.process[k].tolist()
        assert node[f"errors.{name}.effect"] == robot.effect[k].tolist()
        assert node[f"errors.{name}.current_std"] == float(robot.current_std[k])


def test_every_number_of_the_record_is_there(robot, node):
    count = sum(np.size(n.value) for n in robot.record.parameters.values())
    groups = ("robot.", "motor.", "surface.")
    assert count == sum(np.size(x) for name, x in node.items() if name.startswith(groups))


@pytest.mark.slow
def test_gains_and_limits_are_those_of_the_controller(robot):
    for load in LOADS:
        made = DeployedRobot.of(robot.record, load)
        node = parameters(ros2_files(made), "slipid.yaml", "slipid")
        gains = {e.path: float(e.get(Gains.of(made))) for e in used_gains(made)}
        assert {name: node[f"gains.{name}"] for name in gains} == gains
        limits = vars(Limits())
        assert {name: node[f"limits.{name}"] for name in limits} == limits
        noise = {name: getattr(Settings.of(made), name) for name in ("gyro_std", "ammeter_std_a")}
        assert {name: node[f"sensors.{name}"] for name in noise} == noise
        assert node["load_setup"] == load.replace(" ", "_")


# README --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_numbers_that_were_not_identified_are_warned_of(robot, files, four):
    text = files["README.md"]
    assert "> **WARNING.** NOT IDENTIFIED" in text
    assert "> **WARNING.** AT A BOUND" in text
    assert "> **WARNING.** DISPUTED" in text
    row = next(line for line in text.splitlines() if line.startswith("| `motor.resistance` |"))
    assert "4.1 to 3.333e+05" in row
    assert "**NOT IDENTIFIED** | borrowed |" in row
    assert "NOT IDENTIFIED, borrowed" in files["slipid.yaml"]
    assert "NOT IDENTIFIED, borrowed" in files["slipid_parameters.yaml"]
    sure = ros2_files(four)
    assert not any("WARNING" in text or "NOT IDENTIFIED" in text for text in sure.values())


def test_the_readme_holds_whatever_a_name_or_message_is(robot, files):
    text = files["README.md"]
    assert 'Note of the fit: say "aloud", "x --> | and*/ more' in text
    assert all(c.isprintable() or c == "\n" for c in text)
    for path in robot.record.parameters:
        shown = " ".join(path.split()).replace("|", "\\|")
        assert f"| `{shown}` |" in text, path


def test_other_numbers_are_another_folder(robot, files):
    parts = dict(robot.record.parameters)
    parts["motor.resistance"] = replace(parts["motor.resistance"], value=2.5)
    changed = ros2_files(DeployedRobot.of(replace(robot.record, parameters=parts)))
    assert parameters(changed, "slipid.yaml", "slipid")["motor.resistance"] == 2.5
    assert all(changed[name] != files[name] for name in files)
