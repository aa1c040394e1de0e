"""Layouts declared in a config, units of columns, and what the reader makes of sound oddities."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slipid.data.log import WheelReading
from slipid.data.reading.layout import PER_WHEEL
from slipid.data.reading.presets import PRESETS, declared_layout, preset
from slipid.data.reading.reader import find_logs
from slipid.data.reading.table import read_table
from slipid.data.reading.units import factor, same_unit
from slipid.support.errors import DataError
from tests.helpers.broken_logs import GENERIC, GENERIC_LAYOUT, ROBOTINO, generic_text, write_good
from tests.helpers.one_log import read_log

TURN = 2 * math.pi
POSE = ("pose_x", "pose_y", "pose_heading")


@pytest.fixture
def root(tmp_path):
    write_good(tmp_path)
    return tmp_path


def generic(root, **changes):
    columns = {**GENERIC_LAYOUT["columns"], **changes.pop("columns", {})}
    layout = declared_layout({**GENERIC_LAYOUT, **changes, "columns": columns}, "layout")
    return read_log(root / GENERIC, layout, root=root)


# units


@pytest.mark.parametrize(
    ("unit", "target", "expected"),
    [
        ("ms", "s", 1e-3),
        ("min", "s", 60.0),
        ("rpm", "rad/s", TURN / 60),
        ("rev/s", "rad/s", TURN),
        ("deg/s", "rad/s", TURN / 360),
        ("mm/s", "m/s", 1e-3),
        ("inch", "m", 0.0254),
        ("mA", "A", 1e-3),
        ("%", "1", 0.01),
        ("ticks", "tick", 1.0),
        ("pix", "pixel", 1.0),
        ("N·m", "N*m", 1.0),
        ("m s^-1", "m/s", 1.0),
        ("km * s**-1", "m/s", 1e3),
    ],
)
def test_factors(unit, target, expected):
    assert factor(unit, target) == pytest.approx(expected, rel=1e-14)


def test_units_agree_with_pints_own_registry():
    import pint

    registry = pint.UnitRegistry()
    for unit, target in [("rpm", "rad/s"), ("km/h", "m/s"), ("deg", "rad"), ("ft", "m")]:
        theirs = registry.Quantity(1.0, unit).to(target).magnitude
        assert factor(unit, target) == pytest.approx(theirs, rel=1e-12)


@pytest.mark.parametrize(
    ("unit", "target", "message"),
    [
        ("Hz", "rad/s", "unknown unit 'Hz'"),
        ("1/s", "rad/s", "cannot be converted"),
        ("rad", "1", "cannot be converted"),
        ("rad/ss", "rad/s", "did you mean rad/s"),
        ("", "m", "cannot be converted"),
        ("m^", "m", "unknown unit"),
        ("10**10**10", "s", r"unknown unit '10\*\*10\*\*10'"),
        ("s**2**9", "s", "unknown unit"),
        ("s**10", "s", "unknown unit"),
        ("10 s", "s", "unknown unit"),
        ("(s)", "s", "unknown unit"),
        ("*".join("m" * 7), "m", "unknown unit"),
        ("__import__('os')", "s", "unknown unit"),
    ],
)
def test_units_that_are_refused(unit, target, message):
    with pytest.raises(ValueError, match=message):
        factor(unit, target)


def test_same_unit():
    assert same_unit("pix", "pixel")
    assert same_unit("sec", "s")
    assert not same_unit("s", "ms")
    assert not same_unit("bananas", "s")


# layouts


def test_presets_are_layouts():
    for name, layout in PRESETS.items():  # the checks of a declared layout, on the preset itself
        assert declared_layout({"format": name}, "layout") == preset(name) == layout
        columns = {len(layout.channels[c].columns) for c in layout.channels if c in PER_WHEEL}
        assert columns == (set() if name in ("robotino2021_camera", "tracked") else {3})


def test_a_config_starts_from_a_preset_and_overrides_it(root):
    layout = declared_layout(
        {
            "format": "robotino2022",
            "gear_ratio": 8,
            "columns": {"current": False, "gyro": {"column": "setvel", "unit": "rad/s"}},
        },
        "my.toml [layout]",
    )
    log = read_log(root / ROBOTINO, layout, root=root)
    usual = read_log(root / ROBOTINO, preset("robotino2022"), root=root)
    assert log.current is None
    assert log.gyro.shape == log.time.shape
    np.testing.assert_allclose(log.wheel_angle, 2.0 * usual.wheel_angle)
    np.testing.assert_allclose(log.wheel_speed, 2.0 * usual.wheel_speed)


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"format": "robotino"}, "no format 'robotino', did you mean robotino20"),
        ({}, "no columns; expected a table of channels"),
        ({"format": "robotino2022", "gear_ration": 3}, "no key 'gear_ration', did you mean gear_"),
        ({"format": "robotino2022", "gear_ratio": 0}, "gear_ratio: 0; expected a number from"),
        ({"format": "robotino2022", "gear_ratio": "16"}, "gear_ratio: '16'; expected a number"),
        ({"format": "robotino2022", "names_row": True}, "names_row: True; expected a whole number"),
        ({"format": "robotino2022", "delimiter": ";;"}, "delimiter: ';;'; .*at most 1 char"),
        ({"format": "robotino2022", "new_run": "often"}, "new_run: 'often'; .*time_restarts"),
        (
            {"format": "robotino2022", "first_data_row": 2},
            "expected a row below those of names",
        ),
        (
            {"format": "robotino2022", "metres_per_pixel": [1, -1]},
            "metres_per_pixel.2.: -1; expected a number from",
        ),
        ({"format": "robotino2022", "columns": {"time": False}}, "no time column"),
        ({"format": "robotino2022", "columns": {"pose_x": False}}, "only one of pose_x and"),
        ({"format": "robotino2022", "columns": ["t"]}, "expected a table"),
        ({"format": "robotino2022", "columns": {"gyro": "g"}}, "columns.gyro: 'g'; expected"),
        (
            {"format": "robotino2022", "columns": {"gyro": {"unit": "V"}}},
            "columns.gyro: columns: missing",
        ),
        (
            {"format": "robotino2022", "columns": {"gyro": {"column": "g", "unit": "V"}}},
            "columns.gyro: unit 'V' cannot be converted to rad/s",
        ),
        (
            {"format": "robotino2022", "columns": {"gyro": {"column": "g", "unit": 3}}},
            "columns.gyro: unit: 3; .*valid string",
        ),
        (
            {"format": "robotino2022", "columns": {"gyro": {"columns": ["a", "b"], "unit": "V"}}},
            "2 columns; expected one column",
        ),
        (
            {
                "format": "robotino2022",
                "columns": {"gyro": {"column": "g", "unit": "rad/s", "scale": [1, 2]}},
            },
            "2 scales for 1 columns",
        ),
        (
            {
                "format": "robotino2022",
                "columns": {"gyro": {"column": "g", "unit": "rad/s", "sign": -1}},
            },
            "columns.gyro: sign: no such key; expected one of columns, unit, scale",
        ),
        ({**GENERIC_LAYOUT, "ticks_per_revolution": 0.0}, "0.0; expected a number from 0.1"),
        (
            {k: v for k, v in GENERIC_LAYOUT.items() if k != "ticks_per_revolution"},
            "wheel_ticks without ticks_per_revolution",
        ),
        ({**GENERIC_LAYOUT, "names_row": 0}, "columns are given by name, but names_row is 0"),
        (
            {
                **GENERIC_LAYOUT,
                "columns": {
                    **GENERIC_LAYOUT["columns"],
                    "pose_x": {"column": "x", "unit": "pixel"},
                },
            },
            "metres_per_pixel is not given",
        ),
    ],
)
def test_layouts_that_are_refused(mapping, message):
    with pytest.raises(DataError, match=rf"^my\.toml \[layout\].*{message}"):
        declared_layout(mapping, "my.toml [layout]")


# what the reader makes of sound oddities


def test_generic_csv(root):
    log = generic(root)
    assert log.wheels == 2
    assert log.current_is_signed
    np.testing.assert_allclose(log.wheel_speed, 4.0, rtol=1e-6)
    np.testing.assert_allclose(log.wheel_angle[-1], 4.0 * log.time[-1], rtol=1e-3)
    np.testing.assert_allclose(log.voltage[0], [6.0, 6.1])
    np.testing.assert_allclose(log.pose[-1], [0.2 * log.time[-1], 1e-3, math.radians(0.5)])
    assert log.twist_command is None
    assert log.wheel_speed_command is None


@pytest.mark.parametrize(
    ("channel", "unit", "scale"), [("wheel_angle", "mm", 50.0), ("wheel_speed", "m/s", 0.05)]
)
def test_travel_and_speed_of_rims_are_divided_by_the_radius(root, channel, unit, scale):
    """A column of rpm stands for speeds of wheels here, and one of ticks for their angles."""
    names = ["left", "right"] if channel == "wheel_angle" else ["left_rpm", "right_rpm"]
    columns = {k: v for k, v in GENERIC_LAYOUT["columns"].items() if k.startswith(("time", "pose"))}
    at_rim = columns | {channel: {"columns": names, "unit": unit, "scale": scale}}
    turned = columns | {channel: {"columns": names, "unit": "rad/s" if "s" in unit else "rad"}}
    layouts = [{"columns": at_rim, "wheel_radius": 0.05}, {"columns": turned}]
    found, expected = (read_log(root / GENERIC, declared_layout(one, "layout")) for one in layouts)
    np.testing.assert_allclose(found.wheel_angle, expected.wheel_angle, rtol=1e-9)
    assert f"{channel} in {unit} was divided by a wheel radius of 0.05 m" in found.notes
    with pytest.raises(
        DataError, match=rf"columns.{channel}: {channel} is in '{unit}', but wheel_"
    ):
        declared_layout({"columns": at_rim}, "layout")


@pytest.mark.parametrize(
    ("absent", "lacking"), [(["pose_heading"], [2]), (["pose_x", "pose_y"], [0, 1])]
)
def test_poses_may_lack_headings_or_positions(root, absent, lacking):
    columns = {k: v for k, v in GENERIC_LAYOUT["columns"].items() if k not in absent}
    log = read_log(root / GENERIC, declared_layout(GENERIC_LAYOUT | {"columns": columns}, "layout"))
    whole = generic(root)
    known = [k for k in range(3) if k not in lacking]
    assert np.isnan(log.pose[:, lacking]).all()
    np.testing.assert_array_equal(log.pose[:, known], whole.pose[:, known])
    assert log.pose_fresh[0]


@pytest.mark.parametrize(
    "change",
    [
        lambda raw: b"\xef\xbb\xbf" + raw,
        lambda raw: raw.replace(b"\n", b"\r\n"),
        lambda raw: raw.replace(b"\n", b",\n"),
        lambda raw: raw + b"\n\n",
        lambda raw: raw.rstrip(),
        lambda raw: raw.replace(b"time,left,", b'"time" , "left",', 1),
    ],
    ids=[
        "byte order mark",
        "crlf",
        "trailing delimiters",
        "blank end",
        "no last newline",
        "quotes",
    ],
)
def test_harmless_oddities_change_nothing(root, change):
    good = generic(root)
    path = root / GENERIC
    path.write_bytes(change(path.read_bytes()))
    odd = generic(root)
    np.testing.assert_array_equal(odd.wheel_angle, good.wheel_angle)
    np.testing.assert_array_equal(odd.pose, good.pose)


def test_text_in_columns_nobody_asked_for_is_no_error(root):
    path = root / GENERIC
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0] + ",remark", *(line + ",fine" for line in lines[1:])]))
    assert generic(root).samples == 200


def test_parquet_reads_as_csv_does(root):
    import pyarrow
    from pyarrow import parquet

    layout = declared_layout(GENERIC_LAYOUT, "layout")
    names, *rows = [line.split(",") for line in generic_text().splitlines()]
    columns = np.array(rows, dtype=float).T
    table = pyarrow.table({n: pyarrow.array(c) for n, c in zip(names, columns, strict=True)})
    path = root / "run.parquet"
    parquet.write_table(table, path)
    ours, csv = read_log(path, layout), generic(root)
    np.testing.assert_array_equal(ours.wheel_angle, csv.wheel_angle)
    np.testing.assert_array_equal(ours.pose, csv.pose)
    parquet.write_table(table.drop_columns(["left_rpm"]), path)
    with pytest.raises(DataError, match=r"run.parquet row 1, column 'left_rpm': no such column"):
        read_log(path, layout)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(
        DataError, match=r"run.parquet: cannot be read .*expected a complete Parquet file"
    ):
        read_log(path, layout)


def test_empty_cells_leave_a_pose_stale_and_are_noted(root):
    good = generic(root)
    path = root / GENERIC
    lines = path.read_text().splitlines()
    for row in (50, 51):
        cells = lines[row].split(",")
        cells[9] = ""
        lines[row] = ",".join(cells)
    path.write_text("\n".join(lines))
    log = generic(root)
    assert log.notes == ("column 'x' has empty cells: it is used at the times of its values",)
    there = np.delete(np.arange(len(good.pose)), [49, 50])
    np.testing.assert_allclose(log.pose[there], good.pose[there], atol=1e-12)
    np.testing.assert_array_equal(log.pose[49:51], good.pose[[48, 48]])
    assert not log.pose_fresh[49:51].any()
    assert log.pose_fresh[51]


@pytest.mark.parametrize("bits", [16, 32])
def test_counters_that_wrap_around_are_continued(root, bits):
    path = root / GENERIC
    good = generic(root)
    lines = path.read_text().splitlines()
    half = 2 ** (bits - 1)
    for i, line in enumerate(lines[1:], start=1):
        cells = line.split(",")
        cells[1] = str((int(cells[1]) + half - 500 + half) % (2 * half) - half)
        lines[i] = ",".join(cells)
    path.write_text("\n".join(lines))
    log = generic(root, tick_bits=bits)
    np.testing.assert_allclose(log.wheel_angle, good.wheel_angle, atol=1e-9)
    assert log.notes == (f"the wrap-around of the tick counter at {bits} bits was removed",)


def test_increments_and_signs(tmp_path):
    rows = [f"{0.04 * k},0,0,0,{-5},{3},{2}" for k in range(50)]
    path = tmp_path / "run.csv"
    path.write_text("\n".join(rows))
    layout = declared_layout(
        {"format": "omni3_optitrack", "columns": dict.fromkeys(POSE, False)}, "layout"
    )
    log = read_log(path, layout)
    turned = np.array([5.0, -3.0, -2.0]) * 49 * TURN / (1024 * 12)
    np.testing.assert_allclose(log.wheel_angle[-1], turned)


def test_angles_may_come_from_speeds_or_as_such(root):
    ticks = generic(root)
    speeds = generic(root, columns={"wheel_ticks": False})
    np.testing.assert_allclose(speeds.wheel_angle, ticks.wheel_angle, atol=2e-3)
    assert speeds.notes == ("wheel angle integrated from the reported speed",)
    turns = {"motor_angle": {"columns": ["left", "right"], "unit": "rev", "scale": 1 / 500}}
    angles = generic(root, columns={"wheel_ticks": False, **turns})
    np.testing.assert_allclose(angles.wheel_angle, ticks.wheel_angle, atol=1e-9)


def test_whole_angles_are_marked_as_perhaps_ticks(root):
    def read(unit, scale=1.0):
        turns = {"columns": ["left", "right"], "unit": unit, "scale": scale}
        columns = {"wheel_ticks": False, "motor_angle": turns}
        return generic(root, columns=columns).wheel_reading

    assert read("rad") == WheelReading("motor_angle", 10.0, True, ("left", "right"))
    assert not read("deg").whole  # of one degree an encoder may be
    assert not read("rad", 0.01).whole
    assert not generic(root).wheel_reading.whole  # ticks are whole as they should be


def test_all_columns_of_a_table(root):
    layout = preset("robotino2022")
    table = read_table(root / ROBOTINO, layout, all_columns=True)
    assert len(table.names) == 25
    assert table["dang"].shape == (200,)
    assert table.lines[0] == 4


def test_globs_that_match_nothing_name_what_is_there(root):
    assert find_logs(root, "one_surface/*/*.csv") == [root / ROBOTINO]
    with pytest.raises(DataError, match=r"no file matches 'one_surface/grey/\*\.csv'.*gray/"):
        find_logs(root, "one_surface/grey/*.csv")
    with pytest.raises(DataError, match="no such folder"):
        find_logs(root / "nowhere", "*.csv")
