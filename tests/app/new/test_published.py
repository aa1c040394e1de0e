"""Configs proposed from the published logs."""

from __future__ import annotations

import tomllib

import pytest

from tests.helpers.proposals import layout_in, proposed


def formats(config) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for section in tomllib.loads(config.text)["logs"]:
        found.setdefault(section["format"], set()).add(section["glob"])
    return found


@pytest.mark.slow
def test_robotino_2022(real_data):
    _, config = proposed(real_data / "robotino2022", gear_ratio="16")
    found = formats(config)
    assert set(found) == {"robotino2022"}
    assert {glob.split("/")[0] for glob in found["robotino2022"]} >= {"one_surface", "wheel_load"}
    assert "layouts" not in tomllib.loads(config.text)


@pytest.mark.slow
def test_robotino_2021(real_data):
    _, config = proposed(real_data / "robotino2021")
    assert set(formats(config)) == {"robotino2021", "robotino2021_field"}
    assert '# format = "robotino2021_motor"' in config.text
    assert tomllib.loads(config.text)["robot"]["gear_ratio"] == 16


def test_omni3_has_no_names(real_data):
    draft, config = proposed(real_data / "omni3_optitrack")
    layout = layout_in(config)
    assert layout["ticks_are_increments"] is True
    columns = {name: channel.get("column") for name, channel in layout["columns"].items()}
    assert columns | {"wheel_ticks": 0} == {
        **{"time": 0, "pose_x": 1, "pose_y": 2, "pose_heading": 3},
        "wheel_ticks": 0,
    }
    assert layout["columns"]["wheel_ticks"]["columns"] == [4, 5, 6]
    assert any("format = omni3_optitrack" in line for line in draft.sentences)
    assert not any("metadata" in glob for glob in formats(config)["mine"])


def test_skid_drives(real_data):
    _, config = proposed(real_data / "drive_skid", drive="skid", wheelbase_m="0.5", track_m="0.55")
    there = tomllib.loads(config.text)
    assert there["robot"]["drives"] == [[1, 3], [2, 4]]
    columns = there["layouts"]["mine"]["columns"]
    assert columns["wheel_speed"] == {"columns": ["wl", "wr"], "unit": "rad/s"}
    assert "voltage" not in columns
    assert columns["pose_heading"]["unit"] == "rad"
    assert formats(config)["mine"] == {"*/step_*.csv"}
    keys = {question.partition(":")[0] for question in config.questions}
    assert keys == {"wheel_radius_m", "gear_ratio", "mass_kg"}


def test_borealtc_has_no_pose(real_data):
    _, config = proposed(real_data / "borealtc")
    assert any("no pose was found" in question for question in config.questions)
    assert any(question.startswith("wheel_speed: in which unit") for question in config.questions)
