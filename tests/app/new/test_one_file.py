"""A config proposed from a file: units, signs, sums, rates, and open questions."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from slipid.app.new.config_lines import QUESTION_MARK
from slipid.data.reading.table_format import format_of
from slipid.support.errors import DataError
from tests.helpers.made_tables import RADIUS, motion, plain, table
from tests.helpers.proposals import ROBOT, layout_in, proposed, read


def test_a_plain_file_leaves_nothing_open_and_reads(tmp_path):
    table(tmp_path / "grass" / "run1.csv", plain())
    table(tmp_path / "grass" / "run2.csv", plain(9.0))
    draft, config = proposed(tmp_path, **ROBOT)
    (question,) = config.questions  # what no log without voltages tells
    assert question.startswith('"motor.resistance": no motor voltages')
    assert config.text.replace('"# ?"', "").count(QUESTION_MARK) == 1
    layout = layout_in(config)
    assert layout["columns"]["wheel_speed"] == {
        "columns": ["left_vel", "right_vel"],
        "unit": "rad/s",
    }
    assert layout["current_is_signed"] is True
    data = read(config, tmp_path)
    assert [log.surface for log in data.logs] == ["grass", "grass"]
    log = data.logs[0]
    angle, pose = motion(log.time)
    np.testing.assert_allclose(log.wheel_angle, angle - angle[0], atol=2e-3)
    np.testing.assert_allclose(log.pose, pose, atol=1e-6)
    assert "2 like" in draft.sentences[0]


@pytest.mark.parametrize("lacking", [["yaw"], ["x", "y"]], ids=["positions", "headings"])
def test_poses_without_headings_or_positions_are_proposed(tmp_path, lacking):
    path = table(tmp_path / "run1.csv", {n: v for n, v in plain().items() if n not in lacking})
    _, config = proposed(path, **ROBOT)
    log = read(config, tmp_path).logs[0]
    _, pose = motion(log.time)
    known = np.isfinite(log.pose).all(axis=0)
    assert known.tolist() == ([True, True, False] if lacking == ["yaw"] else [False, False, True])
    np.testing.assert_allclose(log.pose[:, known], pose[:, known], atol=1e-6)
    assert any("was found: motors and contact need x, y" in q for q in config.questions)


def test_other_units_follow_from_names_units_row_and_magnitude(tmp_path):
    si = plain()
    lines = {
        "time": si["t"] * 1e3,
        "wl": si["left_vel"],
        "wr": si["right_vel"],
        "x": si["x"] * 1000,
        "y": si["y"] * 1000,
        "heading": np.degrees(si["yaw"]) % 360,
        "i1": np.abs(si["cur_left"]) * 1000,
        "i2": np.abs(si["cur_right"]) * 1000,
    }
    path = table(tmp_path / "run.csv", lines, delimiter=";")
    _, config = proposed(path, **ROBOT)
    layout = layout_in(config)
    units = {name: channel["unit"] for name, channel in layout["columns"].items()}
    assert layout["delimiter"] == ";"
    assert units == {
        "time": "ms",
        "wheel_speed": "rad/s",
        "pose_x": "mm",
        "pose_y": "mm",
        "pose_heading": "deg",
        "current": "mA",
    }
    assert layout["current_is_signed"] is False
    assert [q for q in config.questions if "floor" not in q and "datasheet" not in q] == []


def test_a_row_of_units_above_the_names(tmp_path):
    si = plain()
    path = table(
        tmp_path / "run.csv", {k: si[k] for k in ("t", "left_vel", "right_vel", "x", "y", "yaw")}
    )
    rows = path.read_text().splitlines()
    path.write_text("\n".join(["made by hand", "s,rad/s,rad/s,m,m,rad", *rows]) + "\n")
    found = format_of(path)
    assert (found.units_row, found.names_row, found.first_data_row) == (2, 3, 4)
    _, config = proposed(path, **ROBOT)
    assert layout_in(config)["units_row"] == 2
    assert len(read(config, tmp_path)) == 1


def test_speeds_in_rpm_or_at_the_rim_are_not_taken_for_others(tmp_path):
    si = plain()
    rpm = {**si, "left_vel": si["left_vel"] * 9.5493, "right_vel": si["right_vel"] * 9.5493}
    _, config = proposed(table(tmp_path / "rpm.csv", rpm), **ROBOT)
    assert layout_in(config)["columns"]["wheel_speed"]["unit"] == "rpm"
    rim = {**si, "left_vel": si["left_vel"] * RADIUS, "right_vel": si["right_vel"] * RADIUS}
    _, config = proposed(
        table(tmp_path / "rim" / "run.csv", rim), **{**ROBOT, "wheel_radius_m": "0.1"}
    )
    assert any("m/s at the rim" in question for question in config.questions)
    log = read(config, tmp_path / "rim").logs[0]
    np.testing.assert_allclose(
        log.wheel_angle[-1], motion(log.time)[0][-1] * RADIUS / 0.1, rtol=0.01
    )


@pytest.mark.parametrize("increments", [False, True])
def test_ticks_add_up_or_are_increments(tmp_path, increments):
    si = plain()
    angle, _ = motion(si["t"])
    ticks = np.round(angle * 1000 / (2 * np.pi)).astype(int)
    if increments:
        ticks = np.diff(ticks, axis=0, prepend=ticks[:1])
    lines = {"t": si["t"], "enc_l": ticks[:, 0], "enc_r": ticks[:, 1]}
    lines |= {name: si[name] for name in ("x", "y", "yaw")}
    told = {**ROBOT, "ticks_per_revolution": "1000"}
    _, config = proposed(table(tmp_path / "floor" / "run.csv", lines), **told)
    assert layout_in(config)["ticks_are_increments"] is increments
    log = read(config, tmp_path / "floor").logs[0]
    np.testing.assert_allclose(log.wheel_angle, angle - angle[0], atol=0.02)


def test_a_voltage_of_the_battery_is_left_out_and_effort_raises_a_question(tmp_path):
    si = plain()
    lines = {**si, "vl": 24.0 - 0.1 * np.abs(si["cur_left"]), "vr": 24.0 + 0 * si["t"]}
    lines |= {"effort_left": si["cur_left"], "effort_right": si["cur_right"]}
    _, config = proposed(table(tmp_path / "run.csv", lines), **ROBOT)
    assert "voltage" not in layout_in(config)["columns"]
    assert "# voltage = { columns" in config.text
    assert any(q.startswith("wheel_torque: what is it") for q in config.questions)


def test_batteries_of_several_robots_are_batteries(tmp_path):
    for name, volts in (("run1", 24.0), ("run2", 50.0), ("run3", 24.0)):
        si = plain()
        lines = {**si, "vl": volts - 0.1 * np.abs(si["cur_left"]), "vr": volts + 0 * si["t"]}
        lines["vr"][0] = 3 * volts  # a glitch makes a motor of none
        table(tmp_path / "floor" / f"{name}.csv", lines)
    _, config = proposed(tmp_path, **ROBOT)
    assert "voltage" not in layout_in(config)["columns"]


def test_a_motor_that_drives_one_way_in_the_first_run_is_no_battery(tmp_path):
    for name, way in (("run1", 1.0), ("run2", 1.0), ("run3", -1.0)):
        columns = plain()
        for side in ("left", "right"):
            columns[f"{side}_vel"] = way * (5.0 + 0.1 * columns[f"{side}_vel"])
            columns[f"{side}_voltage_V"] = 0.5 * columns[f"{side}_vel"]
        table(tmp_path / "floor" / f"{name}.csv", columns)
    _, config = proposed(tmp_path, **ROBOT)
    assert "voltage" in layout_in(config)["columns"]


def test_rates_and_repeats_are_commented(tmp_path):
    si = plain()
    every = np.arange(len(si["t"])) % 5 == 0
    held = np.maximum.accumulate(
        np.where(np.arange(len(si["t"])) % 7 == 0, np.arange(len(si["t"])), 0)
    )
    lines = {**si, "cur_left": si["cur_left"][held], "cur_right": si["cur_right"][held]}
    for name in ("x", "y", "yaw"):
        lines[name] = np.where(every, si[name], np.nan)
    _, config = proposed(table(tmp_path / "run.csv", lines), **ROBOT)
    assert "10 Hz, empty in between" in config.text
    assert "50 Hz; read anew 7.14 Hz" in config.text


def test_files_without_names_are_read_by_position_with_questions(tmp_path):
    si = plain()
    lines = {name: si[name] for name in ("t", "x", "y", "yaw")}
    angle, _ = motion(si["t"])
    ticks = np.round(angle * 1000 / (2 * np.pi)).astype(int)
    lines |= {"l": ticks[:, 0], "r": ticks[:, 1]}
    path = table(tmp_path / "run.csv", lines, header=False)
    _, config = proposed(path, **ROBOT, ticks_per_revolution="1000")
    layout = layout_in(config)
    assert (layout["names_row"], layout["first_data_row"]) == (0, 1)
    assert layout["columns"]["wheel_ticks"]["columns"] == [4, 5]
    assert sum("guessed from the numbers: is it" in q for q in config.questions) == 5


def test_four_wheels_are_put_in_the_order_of_the_drive(tmp_path):
    si = plain()
    speeds = {"l": si["left_vel"], "r": si["right_vel"]}
    names = ("rear_left", "front_right", "front_left", "rear_right")
    lines = {"t": si["t"], **{f"{n}_vel": speeds[n.split("_")[1][0]] for n in names}}
    lines |= {name: si[name] for name in ("x", "y", "yaw")}
    _, config = proposed(table(tmp_path / "run.csv", lines))
    assert layout_in(config)["columns"]["wheel_speed"]["columns"] == [
        *("front_left_vel", "front_right_vel", "rear_left_vel", "rear_right_vel"),
    ]
    assert tomllib.loads(config.text)["robot"]["drive"] == "skid"
    _, config = proposed(tmp_path / "run.csv", drive="mecanum")
    assert tomllib.loads(config.text)["robot"]["drive"] == "mecanum"


def test_a_drive_that_does_not_fit_the_columns_is_a_question(tmp_path):
    path = table(tmp_path / "run.csv", plain())
    _, config = proposed(path, drive="skid", shared="no")
    assert any("4 drives, but 2 have columns" in question for question in config.questions)
    _, config = proposed(path, drive="skid")
    assert tomllib.loads(config.text)["robot"]["drives"] == [[1, 3], [2, 4]]
    assert not any("have columns" in question for question in config.questions)


def test_errors_of_the_reader_are_questions(tmp_path):
    si = plain()
    path = table(tmp_path / "run.csv", si)
    rows = path.read_text().splitlines()
    rows[100] += ",7"
    path.write_text("\n".join(rows) + "\n")
    _, config = proposed(path, **ROBOT)
    assert any("reading fails" in q and "row 101" in q for q in config.questions)


def test_the_unit_of_a_heading_beyond_a_turn_follows_from_the_turn_rate(tmp_path):
    columns = plain(60.0)
    unwrapped = 1.5 * np.abs(columns["yaw"]).max() + columns["yaw"] + 7.0
    for unit, heading in (("rad", unwrapped), ("deg", np.degrees(columns["yaw"]) / 3)):
        _, config = proposed(
            table(tmp_path / unit / "run.csv", columns | {"yaw": heading}), **ROBOT
        )
        assert layout_in(config)["columns"]["pose_heading"]["unit"] == unit
        assert not any("radians or degrees" in q for q in config.questions)


def test_currents_of_the_battery_are_left_out(tmp_path):
    columns = plain()
    for side in ("left", "right"):
        current = np.abs(columns[f"cur_{side}"])
        current[::40] = -0.1  # braking gives a little back
        columns[f"cur_{side}"] = current
    _, config = proposed(table(tmp_path / "run.csv", columns), **ROBOT)
    layout = layout_in(config)
    assert "current" not in layout["columns"]
    assert "current_is_signed" not in layout
    assert "so it is the battery's" in config.text.replace("\n# ", " ")


def test_currents_without_voltages_ask_for_the_datasheet(tmp_path):
    with_voltage = plain()
    for side in ("left", "right"):
        with_voltage[f"motor_voltage_{side}"] = 2.0 * with_voltage[f"{side}_vel"]
    for columns, asked in ((plain(), True), (with_voltage, False)):
        _, config = proposed(table(tmp_path / "run.csv", columns), **ROBOT)
        assert any("in the datasheet?" in q for q in config.questions) is asked


def test_a_log_of_a_motor_on_a_bench_is_sent_to_the_command_for_it(tmp_path):
    time = np.arange(0.0, 5.0, 0.01)
    lines = {"t": time, "V": np.sin(time), "I": np.cos(time), "w": 20 * np.sin(time)}
    path = table(tmp_path / "bench.csv", lines)
    with pytest.raises(DataError, match=r"motor on a bench .*\nrun: slipid motor .*bench.csv"):
        proposed(path)
