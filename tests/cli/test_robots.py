"""`slipid robots` as people call it."""

from __future__ import annotations

import json

import pytest

from slipid.app.config import read_config
from slipid.app.reference_robots import reference_names, reference_robot
from tests.helpers.shared import invoke

WIDTH = 80


def lines(*words: object) -> list[str]:
    result = invoke("robots", *words)
    assert result.exit_code == 0, result.stderr
    return result.stdout.splitlines()


def test_every_robot_and_floor_is_listed():
    said = lines()
    assert max(map(len, said)) <= WIDTH
    for name in reference_names():
        assert any(line.startswith(name) for line in said)
    (husky,) = [line for line in said if line.startswith("husky")]
    floor = reference_robot("husky").floors["wet_grass"]
    for model in ("nominal", "calibrated", "selected"):
        assert f"{100 * floor.error_over_path[model]:.2f} %" in husky
    assert husky.split()[1:3] == ["skid", "wet_grass"]
    assert "4 robots and 1 set of motors, identified from public logs" in said
    assert said[-1].endswith("slipid new --robot husky")


@pytest.mark.parametrize("name", reference_names())
def test_one_robot_is_shown(name):
    said = lines(name)
    one = reference_robot(name)
    assert max(map(len, said)) <= WIDTH
    assert said[0] == f"{name}: {one.about}"
    assert any(one.source.licence in line for line in said)
    assert sum(line.startswith("note: ") for line in said) == len(one.notes)
    for floor in one.floors:
        assert sum(line.startswith(f"on {floor} ") for line in said) == 1
    # what the logs do not determine stands in the JSON alone
    rows = [line for line in said if " .. " in line]
    assert rows
    assert all(line.rstrip().endswith(("  identified", "  weak")) for line in rows)


def test_motors_of_a_bench_stand_apart():
    said = lines("robotino_motor")
    heads = [line.split("  ")[0] for line in said if line.startswith("motor ")]
    assert heads == ["motor 1", "motor 2", "motor 3"]
    assert any("R and C_e are those of the datasheet" in line for line in said)


def test_json_has_everything():
    every = json.loads(invoke("robots", "--json", "-").stdout)["robots"]
    assert [one["name"] for one in every] == list(reference_names())
    one = json.loads(invoke("robots", "omni3", "--json", "-").stdout)
    assert one == every[list(reference_names()).index("omni3")]
    assert one["numbers"]["surface.floor.creep"]["verdict"] == "not_identified"


def test_an_unknown_robot_is_2():
    result = invoke("robots", "huskey")
    assert result.exit_code == 2
    assert "no reference robot 'huskey', did you mean husky?" in result.stderr


def test_a_new_config_starts_from_a_robot_and_asks_nothing(tmp_path):
    out = tmp_path / "mine.toml"
    result = invoke("new", "--robot", "husky", "--out", out)
    assert result.exit_code == 0, result.stderr
    robot = read_config(out).content.robot
    assert (robot.drive, robot.half_width_m, robot.drives) == ("skid", 0.275, [[1, 3], [2, 4]])
    assert "? wheel_radius_m" not in result.stdout
