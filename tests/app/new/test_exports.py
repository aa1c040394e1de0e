"""Tables as other programs write them: dates, stamps in two columns, topics as names, text."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from slipid.app.new.units import duty_unit
from slipid.data.reading.column_names import meaning_of, stamp_columns
from slipid.data.reading.presets import declared_layout
from slipid.support.errors import DataError
from tests.helpers.made_tables import motion, plain, table
from tests.helpers.one_log import read_log
from tests.helpers.proposals import ROBOT, layout_in, proposed, read

BEGIN = datetime(2023, 11, 14, 22, 13, 20, tzinfo=UTC)
ZONED = timedelta(hours=2)


def with_time(**columns):
    """The plain run with other columns of time."""
    return columns | {name: values for name, values in plain().items() if name != "t"}


def dates(text):
    return [text(BEGIN + timedelta(seconds=t)) for t in plain()["t"].tolist()]


def reads_as_plain(path):
    """Return the layout that is proposed for a file, which is read as the plain run."""
    _, config = proposed(path, **ROBOT)
    log = read(config, path.parent).logs[0]
    time = plain()["t"]
    np.testing.assert_allclose(log.time, time, atol=1e-6)
    angle, pose = motion(time)
    np.testing.assert_allclose(log.wheel_angle, angle - angle[0], atol=2e-3)
    np.testing.assert_allclose(log.pose, pose, atol=1e-6)
    return layout_in(config)


@pytest.mark.parametrize(
    "text",
    [
        lambda date: f"{date:%Y-%m-%d %H:%M:%S.%f}789",  # of pandas, with nanoseconds
        lambda date: date.isoformat(),
        lambda date: f"{date + ZONED:%Y-%m-%dT%H:%M:%S.%f}+02:00",
        lambda date: f'"{date:%Y/%m/%d %H:%M:%S.%f}Z"',
    ],
)
def test_dates_are_times(tmp_path, text):
    path = table(tmp_path / "run.csv", with_time(stamp=dates(text)))
    assert reads_as_plain(path)["columns"]["time"] == {"column": "stamp", "unit": "s"}


@pytest.mark.parametrize("unit", ["ns", "us", "ms"])
@pytest.mark.parametrize("zone", [None, "UTC"])
def test_dates_in_parquet_are_times(tmp_path, unit, zone):
    pyarrow = pytest.importorskip(
        "pyarrow", reason="Parquet needs slipid[parquet], which the development environment has"
    )
    from pyarrow import parquet

    stamps = pyarrow.array(dates(lambda date: date.replace(tzinfo=None)))
    stamps = stamps.cast(pyarrow.timestamp(unit, zone))
    path = tmp_path / "run.parquet"
    parquet.write_table(pyarrow.table(with_time(stamp=stamps)), path)
    assert reads_as_plain(path)["columns"]["time"] == {"column": "stamp", "unit": "s"}


def test_a_date_in_milliseconds_is_refused(tmp_path):
    path = table(tmp_path / "run.csv", with_time(stamp=dates(datetime.isoformat)))
    columns = {
        "time": {"column": "stamp", "unit": "ms"},
        "wheel_speed": {"columns": ["left_vel", "right_vel"], "unit": "rad/s"},
    }
    with pytest.raises(DataError, match=r"row 2, column 'stamp'.*date.*'ms'.*expected unit = 's'"):
        read_log(path, declared_layout({"columns": columns}, "layout"))


@pytest.mark.parametrize(
    ("seconds", "nanoseconds"),
    [("header.stamp.sec", "header.stamp.nanosec"), ("sec", "nsec"), ("stamp_secs", "stamp_nsecs")],
)
def test_seconds_and_nanoseconds_are_one_time(tmp_path, seconds, nanoseconds):
    whole = np.round(plain()["t"] * 1e9).astype(int) + 1_700_000_000 * 10**9
    parts = {seconds: whole // 10**9, nanoseconds: whole % 10**9}
    path = table(tmp_path / "run.csv", with_time(**parts))
    columns = reads_as_plain(path)["columns"]
    assert columns["time"] == {"columns": [seconds, nanoseconds], "unit": "s"}
    wrong = {"columns": columns | {"time": columns["time"] | {"unit": "ms"}}}
    with pytest.raises(DataError, match=r"seconds and nanoseconds in 'ms'; expected unit = 's'"):
        declared_layout(wrong, "layout")


@pytest.mark.parametrize("names", [("sec", "x"), ("motor.sec", "motor.nsec"), ("fl_s", "fl_ns")])
def test_other_pairs_are_no_time(names):
    assert stamp_columns(names) is None


@pytest.mark.parametrize(
    "above",
    ["sep=;", "# made by a robot", "# what; ever; it; is; that; we; say; in; our; note"],
)
def test_lines_above_the_names(tmp_path, above):
    path = table(tmp_path / "run.csv", plain(), delimiter=";")
    path.write_text(f"{above}\n{path.read_text()}")
    layout = reads_as_plain(path)
    assert (layout["delimiter"], layout["names_row"], layout["first_data_row"]) == (";", 2, 3)


def test_names_may_follow_the_sign_of_a_comment(tmp_path):
    path = table(tmp_path / "run.csv", plain())
    path.write_text(f"# a robot\n# {path.read_text()}")
    assert reads_as_plain(path)["columns"]["time"]["column"] == "# t"


def test_columns_of_text_are_skipped_even_if_they_are_the_most(tmp_path):
    text = {name: ["auto"] * len(plain()["t"]) for name in map(str.upper, "abcdefghijklm")}
    path = table(tmp_path / "run.csv", text | plain())
    assert set(reads_as_plain(path)["columns"]["wheel_speed"]["columns"]) == {
        "left_vel",
        "right_vel",
    }


@pytest.mark.parametrize(
    ("name", "channel", "label"),
    [
        ("/joint_states/position[0]", "wheel_position", "0"),
        ("wheel/left/velocity", "wheel_speed", "l"),
        ("/husky_3/front_left_wheel/velocity", "wheel_speed", "fl"),
        ("/vrpn_client_node/robot/pose/position/x", "pose_x", ""),
        ("/mocap_7/rigid_bodies/pose/orientation/w", "pose_quaternion", "w"),
        ("/my_odom/pose/position/x", "odometry", ""),
        ("/rover_2/cmd_vel/linear/x", "twist_command_x", ""),
    ],
)
def test_topics_as_names(name, channel, label):
    found = meaning_of(name)
    assert (found.channel, found.label) == (channel, label)


@pytest.mark.parametrize(
    "names",
    [
        ("fl_vel", "fr_vel", "rl_vel", "rr_vel"),
        ("vel_FL", "vel_FR", "vel_BL", "vel_BR"),
        ("FrontLeftSpeed", "FrontRightSpeed", "RearLeftSpeed", "RearRightSpeed"),
        ("/wheel/lf/vel", "/wheel/rf/vel", "/wheel/lb/vel", "/wheel/rb/vel"),
    ],
)
def test_four_wheels_are_in_the_order_of_drives(tmp_path, names):
    data = plain()
    speeds = {name: data["left_vel"] + k for k, name in enumerate(names)}
    rest = {name: data[name] for name in ("x", "y", "yaw")}
    mixed = {name: speeds[name] for name in sorted(names, reverse=True)}
    path = table(tmp_path / "run.csv", {"t": data["t"]} | mixed | rest)
    _, config = proposed(path, drive="skid", gear_ratio="1")
    assert layout_in(config)["columns"]["wheel_speed"]["columns"] == list(names)


@pytest.mark.parametrize(
    ("values", "unit", "asked"),
    [
        ([[0.0, 255.0]], "1", "counts of 0 to 255"),
        ([[0.0, 90.0], [-80.0, 3.0]], "1", "counts of 0 to 255"),
        ([[0.0, 90.5]], "percent", ""),
        ([[0.0, 100.0]], "percent", ""),
        ([[0.0, 0.9]], "1", ""),
        ([[0.0, 1023.0]], "1", "scale = 1 / value at full duty"),
    ],
)
def test_counts_of_a_timer_are_not_called_percent(values, unit, asked):
    guess = duty_unit(np.array(values))
    assert guess.unit == unit
    assert asked in guess.doubt
    assert bool(asked) == bool(guess.doubt)
