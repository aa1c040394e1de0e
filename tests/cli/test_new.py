"""`slipid new` and `slipid reference` as people call them."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from slipid.app.config import read_config
from slipid.cli.main import app
from tests.helpers.made_bags import Message, write_bag
from tests.helpers.made_tables import RADIUS, TRACK, plain, table
from tests.helpers.shared import invoke

SIZES = ("--wheel-radius-m", RADIUS, "--gear-ratio", 1, "--mass-kg", 20)
DIFFERENTIAL = ("--drive", "differential", "--track-m", TRACK, *SIZES)


def answered(text: str, *words: object):
    return CliRunner().invoke(app, [str(word) for word in words], input=text)


def test_options_alone_ask_nothing(tmp_path):
    out = tmp_path / "mine.toml"
    words = ("new", "--out", out, *DIFFERENTIAL, "--ticks-per-revolution", 500)
    result = invoke(*words)
    assert result.exit_code == 0, result.stderr
    assert read_config(out).content.robot.track_m == TRACK
    assert "1↑" in result.stdout
    assert "wheel 2: right        x = +0.000 m, y = -0.200 m" in result.stdout
    again = invoke(*words)
    assert again.exit_code == 2
    assert "exists already" in again.stderr
    before = out.read_bytes()
    bad = invoke(*words, "--force", "--mass-kg", -1)
    assert bad.exit_code == 2
    assert "--mass-kg '-1': expected a number from 1e-06" in bad.stderr
    assert out.read_bytes() == before


def test_questions_are_repeated_after_wrong_answers(tmp_path):
    out = tmp_path / "mine.toml"
    result = answered("skid\n0.5\nwide\n0.6\nyes\n0.1\n1\n30\n0\n2\n\n\n\n\n", "new", "--out", out)
    assert result.exit_code == 0, result.stderr
    robot = read_config(out).content.robot
    assert (robot.half_length_m, robot.half_width_m, robot.drives) == (0.25, 0.3, [[1, 3], [2, 4]])
    assert robot.limits.model_dump(exclude_none=True) == {"speed_m_s": 2.0}
    assert "'wide': expected a number" in result.stderr


def test_no_answer_is_one_clear_error(tmp_path):
    out = tmp_path / "mine.toml"
    result = answered("", "new", "--out", out, "--drive", "skid")
    assert result.exit_code == 2
    assert "no answer; expected an answer" in result.stderr
    assert "--yes" in result.stderr
    assert not out.exists()


@pytest.mark.parametrize("drive", ["omni", "mecanum", "skid", "differential", "steered", "general"])
def test_yes_takes_defaults_and_lists_them(tmp_path, drive):
    out = tmp_path / "mine.toml"
    result = invoke("new", "--out", out, "--drive", drive, "--yes")
    assert result.exit_code == 0, result.stderr
    assert read_config(out).content.robot.drive == drive
    assert "? wheel_radius_m: default value" in result.stdout


def test_a_log_is_looked_into(tmp_path):
    columns = {name: one for name, one in plain().items() if not name.startswith("cur")}
    table(tmp_path / "logs" / "grass" / "run.csv", columns)
    out = tmp_path / "mine.toml"
    result = invoke("new", "--from", tmp_path / "logs", "--out", out, *DIFFERENTIAL)
    assert result.exit_code == 0, result.stderr
    assert f"{out} is complete\n" in result.stdout
    assert f"slipid check {out} --data {tmp_path / 'logs'}" in result.stdout
    result = invoke("new", "--from", tmp_path / "logs", "--out", out, "--force")
    assert result.exit_code == 0, result.stderr
    assert '? drive: two drives: differential, or "skid"' in result.stdout
    assert "according to the poses it is about 0.1" in result.stdout


def test_columns_that_are_not_used_stand_on_the_screen(tmp_path):
    columns = {name: one for name, one in plain().items() if name != "yaw"}
    columns |= {"gripper": columns["t"], "mode": np.full(len(columns["t"]), "auto")}
    path = table(tmp_path / "run.csv", columns)
    said = invoke("new", "--from", path, "--out", tmp_path / "mine.toml", *DIFFERENTIAL).stdout
    assert "Not used: gripper, mode." in said
    found = "? of a pose only x (column x) and y (column y) was found: motors and contact need x, y"
    assert found in said
    assert "identify --only calibration does without one of them" in said


def test_a_coordinate_alone_is_no_position(tmp_path):
    path = table(tmp_path / "run.csv", {n: v for n, v in plain().items() if n != "y"})
    said = invoke("new", "--from", path, "--out", tmp_path / "mine.toml", *DIFFERENTIAL).stdout
    assert "Not used: pose_x: a position needs both x and y" in said


def test_topics_that_are_not_used_stand_on_the_screen_and_the_drive_has_two_wheels(tmp_path):
    counts = [
        Message(f"/drum_{k}", "std_msgs/msg/Int16", {"data": 7 * k}, 0.1 * at)
        for at in range(20)
        for k in (1, 2)
    ]
    write_bag(tmp_path / "run1", "mcap", counts)
    out = tmp_path / "mine.toml"
    said = invoke("new", "--from", tmp_path / "run1", "--out", out).stdout
    for k in (1, 2):
        assert f"Not used: /drum_{k} (std_msgs/msg/Int16): fields data" in said
    assert read_config(out).content.robot.drive == "differential"


@pytest.mark.parametrize(
    ("wheels", "drive", "asked"), [(2, "differential", "skid"), (4, "skid", "mecanum or omni")]
)
def test_the_drive_follows_from_the_number_of_wheels(tmp_path, wheels, drive, asked):
    columns = {name: one for name, one in plain().items() if name in ("t", "x", "y", "yaw")}
    columns |= {f"wheel{k + 1}_vel": plain()["left_vel"] for k in range(wheels)}
    out = tmp_path / "mine.toml"
    said = invoke("new", "--from", table(tmp_path / "run.csv", columns), "--out", out).stdout
    assert read_config(out).content.robot.drive == drive
    (question,) = [line for line in said.splitlines() if line.startswith("  ? drive: ")]
    assert asked in question


def test_nothing_to_look_into_is_2(tmp_path):
    for path in (tmp_path, tmp_path / "none.csv"):
        result = invoke("new", "--from", path, "--out", tmp_path / "mine.toml")
        assert result.exit_code == 2
        assert str(path) in result.stderr
    assert not (tmp_path / "mine.toml").exists()


@pytest.mark.slow
def test_check_accepts_what_was_proposed_without_a_question(tmp_path):
    for k in range(3):
        table(tmp_path / "logs" / "grass" / f"run{k}.csv", plain(8.0 + k))
    out = tmp_path / "mine.toml"
    assert invoke("new", "--from", tmp_path / "logs", "--out", out, *DIFFERENTIAL).exit_code == 0
    result = invoke("check", out, "--data", tmp_path / "logs")
    assert result.exit_code == 0, result.stderr
    assert "grass" in result.stdout


def test_reference_prints_a_part_and_the_parameters_of_a_config(tmp_path):
    assert "| `pose_quaternion` | 1 | four: x, y, z, w |" in invoke("reference", "channels").stdout
    assert invoke("reference", "chanels").exit_code == 2
    out = tmp_path / "mine.toml"
    assert invoke("new", "--out", out, "--drive", "skid", "--shared", "yes", "--yes").exit_code == 0
    said = invoke("reference", "parameters", "--config", out)
    assert said.exit_code == 0, said.stderr
    assert "| `robot.radius_deviation` | 2 |" in said.stdout


def test_help_of_new_loads_nothing_heavy():
    code = (
        "import sys; from slipid.cli.main import app; from typer.testing import CliRunner; "
        "r = CliRunner().invoke(app, ['new', '--help']); assert r.exit_code == 0; "
        "print(sorted({'jax', 'numpy', 'slipid.app'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
