"""A config proposed from logs: made ones in the words people use, and the published ones."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from slipid.job.config import parsed
from slipid.job.logs import read_dataset
from slipid.job.new.answers import Told
from slipid.job.new.lines import ASKS
from slipid.job.new.look.columns.names import named, without_unit
from slipid.job.new.look.files.file import head_of
from slipid.job.new.look.propose import propose
from slipid.job.new.look.signals.magnitudes import heading_unit, place_unit, time_unit
from slipid.job.new.template import new_config
from slipid.support.errors import DataError
from tests.helpers.made_tables import RADIUS, TRACK, motion, plain, table, wheel_speeds
from tests.helpers.said import Said

ROBOT = {
    "drive": "differential",
    "track_m": str(TRACK),
    "wheel_radius_m": str(RADIUS),
    "gear_ratio": "1",
    "mass_kg": "20",
}


def proposed(path: Path, **told: str):
    proposal = propose(path, Told(**told))
    return proposal, new_config(proposal.sketch, "mine.toml")


def layout_in(config, name: str = "mine"):
    return tomllib.loads(config.text)["layouts"][name]


def read(config, root: Path):
    """Runs as `slipid check` reads them."""
    there = parsed(Path("mine.toml"), config.text)
    data, skipped = read_dataset(there, there.content.logs, root, Said())
    assert not skipped
    return data


# names ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "channel", "label", "unit"),
    [
        ("t", "time", "", ""),
        ("%time", "time", "", ""),
        ("header.stamp", "time", "", ""),
        ("timestamp_ns", "time", "", "ns"),
        ("Time, ms", "time", "", "ms"),
        ("x_mm", "pose_x", "", "mm"),
        ("pose.pose.position.y", "pose_y", "", ""),
        ("yaw [deg]", "pose_heading", "", "deg"),
        ("theta", "pose_heading", "", ""),
        ("heading", "pose_heading", "", ""),
        ("qw", "pose_quaternion", "w", ""),
        ("field.pose.pose.orientation.z", "pose_quaternion", "z", ""),
        ("wl", "wheel_speed", "l", ""),
        ("left_vel", "wheel_speed", "l", ""),
        ("wheel_front_left_vel", "wheel_speed", "fl", ""),
        ("rear_right_wheel_joint_velocity", "wheel_speed", "rr", ""),
        ("left_rpm", "wheel_speed", "l", "rpm"),
        ("motor_2_speed_rpm", "motor_speed", "2", "rpm"),
        ("m1setvel", "motor_speed_command", "1", ""),
        ("m1pos", "motor_position", "1", ""),
        ("enc_r", "wheel_ticks", "r", ""),
        ("i1", "current", "1", ""),
        ("curR", "current", "r", ""),
        ("left_current_mA", "current", "l", "mA"),
        ("u2", "voltage", "2", ""),
        ("vl", "wheel_v", "l", ""),
        ("vbat", "bus_voltage", "", ""),
        ("cmd_v", "twist_command_x", "", ""),
        ("cmd_vel.angular.z", "twist_command_yaw", "", ""),
        ("cmd_vy", "twist_command_y", "", ""),
        ("gyro_z", "gyro", "", ""),
        ("effort[1]", "wheel_torque", "1", ""),
        ("pwm_l", "duty", "l", ""),
    ],
)
def test_names_as_people_use_them(name, channel, label, unit):
    found = named(name)
    assert (found.channel, found.label, found.unit, found.doubt) == (channel, label, unit, "")


@pytest.mark.parametrize("name", ["temperature", "accel_std", "dx", "delta_x", "n", "foo", "lux"])
def test_names_of_other_things_say_nothing(name):
    assert named(name).channel == ""


def test_odometry_is_no_pose():
    assert named("odom_x").channel == "odometry"


@pytest.mark.parametrize(
    ("name", "channel"),
    [("headng", "pose_heading"), ("lef_vel", "wheel_speed"), ("curent_left", "current")],
)
def test_misspelled_names_are_understood_and_doubted(name, channel):
    found = named(name)
    assert found.channel == channel
    assert found.doubt.startswith("misspelled? ")


@pytest.mark.parametrize(
    ("name", "bare", "unit"),
    [
        ("v [mm/s]", "v", "mm/s"),
        ("Angle, deg", "Angle", "deg"),
        ("speed_rad_s", "speed", "rad/s"),
        ("a[0]", "a[0]", ""),
    ],
)
def test_units_in_names(name, bare, unit):
    assert without_unit(name) == (bare, unit)


# magnitudes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "unit"),
    [
        (np.arange(100) * 0.02, "s"),
        (np.arange(100) * 20.0, "ms"),
        (np.arange(100) * 20e3, "us"),
        (np.arange(100) * 20e6, "ns"),
        (1.7e9 + np.arange(100) * 0.02, "s"),
        (1.7e12 + np.arange(100) * 20.0, "ms"),
        (1.7e18 + np.arange(100) * 20e6, "ns"),
    ],
)
def test_unit_of_time_from_its_steps_or_since_1970(values, unit):
    found = time_unit(values)
    assert (found.unit, found.doubt) == (unit, "")


def test_steps_that_fit_two_units_are_a_question():
    assert "in s or ms?" in time_unit(np.arange(50) * 2.0).doubt


def test_units_of_a_pose():
    time = np.arange(0, 10, 0.1)
    assert place_unit(time, 0.3 * time, 0 * time).unit == "m"
    assert place_unit(time, 300 * time, 1 + 0.5 * time).unit == "mm"
    assert "pixel" in place_unit(time, np.round(50 * time), np.round(20 * time)).doubt
    turn = np.linspace(0, 14, 300)
    assert heading_unit(np.degrees(turn) % 360).unit == "deg"
    assert heading_unit(turn % (2 * np.pi)).unit == "rad"
    assert heading_unit(np.linspace(0, 0.2, 50)).doubt


# one file ---------------------------------------------------------------------------------------


def test_a_plain_file_leaves_nothing_open_and_reads(tmp_path):
    table(tmp_path / "grass" / "run1.csv", plain())
    table(tmp_path / "grass" / "run2.csv", plain(9.0))
    proposal, config = proposed(tmp_path, **ROBOT)
    assert config.questions == ()
    assert ASKS not in config.text.replace('"# ?"', "")
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
    assert "2 like" in proposal.said[0]


def test_other_units_are_told_by_names_units_row_and_magnitude(tmp_path):
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
    assert [q for q in config.questions if "floor" not in q] == []


def test_a_row_of_units_above_the_names(tmp_path):
    si = plain()
    path = table(
        tmp_path / "run.csv", {k: si[k] for k in ("t", "left_vel", "right_vel", "x", "y", "yaw")}
    )
    rows = path.read_text().splitlines()
    path.write_text("\n".join(["made by hand", "s,rad/s,rad/s,m,m,rad", *rows]) + "\n")
    head = head_of(path)
    assert (head.units_row, head.names_row, head.first_data_row) == (2, 3, 4)
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


def test_a_voltage_of_the_battery_is_left_out_and_effort_is_asked_for(tmp_path):
    si = plain()
    lines = {**si, "vl": 24.0 - 0.1 * np.abs(si["cur_left"]), "vr": 24.0 + 0 * si["t"]}
    lines |= {"effort_left": si["cur_left"], "effort_right": si["cur_right"]}
    _, config = proposed(table(tmp_path / "run.csv", lines), **ROBOT)
    assert "voltage" not in layout_in(config)["columns"]
    assert "# voltage = { columns" in config.text
    assert any(q.startswith("wheel_torque: what is it") for q in config.questions)


def test_rates_and_repeats_are_said(tmp_path):
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


def test_files_without_names_are_by_position_and_all_is_asked(tmp_path):
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
    assert sum("by its numbers: is it?" in q for q in config.questions) == 5


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


def test_what_the_reader_refuses_is_said(tmp_path):
    si = plain()
    path = table(tmp_path / "run.csv", si)
    rows = path.read_text().splitlines()
    rows[100] += ",7"
    path.write_text("\n".join(rows) + "\n")
    _, config = proposed(path, **ROBOT)
    assert any("the reader says" in q and "row 101" in q for q in config.questions)


# several files ----------------------------------------------------------------------------------


def three_files(root: Path, epoch: float = 1.7e9) -> None:
    """Of a run: joints at 100 Hz in ns, a quaternion at 30 Hz in s, currents at 10 Hz in ms."""
    time = np.arange(0, 10, 0.01)
    angle, _ = motion(time)
    stamps = [f"{round((epoch + t) * 1e9):d}" for t in time]
    table(
        root / "joint_states.csv",
        {
            "stamp": np.array(stamps),
            "left_wheel_joint_position": angle[:, 0],
            "right_wheel_joint_position": angle[:, 1],
        },
    )
    time = np.arange(0.003, 10, 1 / 30)
    _, pose = motion(time)
    half = pose[:, 2] / 2
    table(
        root / "mocap.csv",
        {
            "stamp": np.array([f"{epoch + t:.6f}" for t in time]),
            **{"x": pose[:, 0], "y": pose[:, 1], "qx": 0 * half, "qy": 0 * half},
            **{"qz": np.sin(half), "qw": np.cos(half)},
        },
    )
    time = np.arange(0, 10, 0.1)
    currents = 0.5 * wheel_speeds(time)
    table(
        root / "drivers.csv",
        {
            "time_ms": np.array([f"{(epoch + t) * 1e3:.0f}" for t in time]),
            **{"current_left": currents[:, 0], "current_right": currents[:, 1]},
        },
    )


def test_three_files_of_a_run_at_three_rates(tmp_path):
    for run in ("run1", "run2", "run3"):
        three_files(tmp_path / run)
    _, config = proposed(tmp_path, **ROBOT)
    layout = layout_in(config)
    assert layout["columns"]["time"]["unit"] == "ns"
    assert set(layout["beside"]) == {"mocap.csv", "drivers.csv"}
    assert layout["beside"]["mocap.csv"]["columns"]["time"]["unit"] == "s"
    assert layout["beside"]["drivers.csv"]["columns"]["time"]["unit"] == "ms"
    turned = layout["beside"]["mocap.csv"]["columns"]["pose_quaternion"]
    assert turned["columns"] == ["qx", "qy", "qz", "qw"]
    assert tomllib.loads(config.text)["logs"][0]["glob"] == "run*/joint_states.csv"
    # folders are runs here and no floors: that is all that is left to say
    assert [q.partition(":")[0] for q in config.questions] == ["surface"]
    data = read(config, tmp_path)
    assert len(data) == 3
    log = data.logs[0]
    angle, pose = motion(log.time)
    assert log.pose_fresh is not None
    assert 25 < log.pose_fresh.sum() / log.duration < 31
    np.testing.assert_allclose(log.pose[log.pose_fresh], pose[log.pose_fresh], atol=1e-4)
    np.testing.assert_allclose(log.wheel_angle, angle - angle[0], atol=1e-3)
    assert log.current is not None


def test_one_file_of_a_run_finds_the_pose_beside_it(tmp_path):
    three_files(tmp_path)
    _, config = proposed(tmp_path / "joint_states.csv", **ROBOT)
    assert "mocap.csv" in layout_in(config)["beside"]
    assert len(read(config, tmp_path)) == 1


def test_a_file_beside_may_be_called_after_the_run(tmp_path):
    for k in (1, 2):
        si = plain(8.0 + k)
        wheels = ("t", "left_vel", "right_vel")
        table(tmp_path / "sand" / f"run{k}.csv", {n: si[n] for n in wheels})
        table(tmp_path / "sand" / f"run{k}_pose.csv", {n: si[n] for n in ("t", "x", "y", "yaw")})
    _, config = proposed(tmp_path, **ROBOT)
    assert set(layout_in(config)["beside"]) == {"{stem}_pose.csv"}
    assert config.questions == ()
    assert {log.surface for log in read(config, tmp_path).logs} == {"sand"}


def test_files_at_other_times_are_not_of_the_run(tmp_path):
    si = plain()
    table(tmp_path / "wheels.csv", {n: si[n] for n in ("t", "left_vel", "right_vel")})
    table(tmp_path / "pose.csv", {**{n: si[n] for n in ("x", "y", "yaw")}, "t": si["t"] + 900})
    proposal, config = proposed(tmp_path, **ROBOT)
    assert "beside" not in layout_in(config)
    assert any(line.startswith("left out") and "pose.csv" in line for line in proposal.said)
    assert any("no pose was found" in question for question in config.questions)


def test_parquet(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    (tmp_path / "grass").mkdir()
    parquet.write_table(pyarrow.table(plain()), tmp_path / "grass" / "run.parquet")
    _, config = proposed(tmp_path, **ROBOT)
    assert config.questions == ()
    assert "delimiter" not in layout_in(config)
    assert len(read(config, tmp_path)) == 1


# nothing to look at -----------------------------------------------------------------------------


def test_what_is_no_log_is_one_clear_error(tmp_path):
    with pytest.raises(DataError, match="no such file or folder"):
        propose(tmp_path / "none.csv", Told())
    (tmp_path / "empty.csv").write_bytes(b"")
    with pytest.raises(DataError, match="the file is empty"):
        propose(tmp_path / "empty.csv", Told())
    (tmp_path / "words.csv").write_text("a,b\nc,d\n" * 20)
    with pytest.raises(DataError, match="no rows of numbers"):
        propose(tmp_path / "words.csv", Told())
    (tmp_path / "binary.csv").write_bytes(b"\0\1\2\3" * 100)
    with pytest.raises(DataError, match="a binary file"):
        propose(tmp_path / "binary.csv", Told())
    with pytest.raises(DataError, match="no log in 3 files"):
        propose(tmp_path, Told())
    (tmp_path / "sub").mkdir()
    with pytest.raises(DataError, match="no CSV or Parquet file below it"):
        propose(tmp_path / "sub", Told())
    rows = "\n".join(f"{k},5;0,1" for k in range(30))
    (tmp_path / "sub" / "comma.csv").write_text(f"t;x\n{rows}\n")
    with pytest.raises(DataError, match="decimal points, not commas"):
        propose(tmp_path / "sub" / "comma.csv", Told())


def test_a_file_of_which_no_column_is_known_is_a_question_and_still_a_config(tmp_path):
    lines = {name: np.arange(30.0) ** 2 + k for k, name in enumerate(("foo", "bar", "baz"))}
    _, config = proposed(table(tmp_path / "run.csv", lines))
    assert any("which column holds what? There are: foo, bar, baz" in q for q in config.questions)


# published logs ---------------------------------------------------------------------------------


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


def test_robotino_2021(real_data):
    _, config = proposed(real_data / "robotino2021")
    assert set(formats(config)) == {"robotino2021", "robotino2021_field"}
    assert '# format = "robotino2021_motor"' in config.text
    assert tomllib.loads(config.text)["robot"]["gear_ratio"] == 16


def test_omni3_has_no_names(real_data):
    proposal, config = proposed(real_data / "omni3_optitrack")
    layout = layout_in(config)
    assert layout["ticks_are_increments"] is True
    columns = {name: channel.get("column") for name, channel in layout["columns"].items()}
    assert columns | {"wheel_ticks": 0} == {
        **{"time": 0, "pose_x": 1, "pose_y": 2, "pose_heading": 3},
        "wheel_ticks": 0,
    }
    assert layout["columns"]["wheel_ticks"]["columns"] == [4, 5, 6]
    assert any("format = omni3_optitrack" in line for line in proposal.said)
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
