"""Numbers and paths that no robot, floor, motor or camera can have are refused with their key."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from slipid.app.config import ConfigContent, LogsSection, WheeledDrive
from slipid.app.logs import files_of, matching_files
from slipid.app.new.robot_questions import DRIVES, ask
from slipid.data.reading import reader
from slipid.data.reading.bag.layout import declared_bag_layout
from slipid.data.reading.presets import declared_layout
from slipid.data.reading.reader import find_logs, without_beside
from slipid.support.errors import DataError
from slipid.support.quantities import Bounds, bounds_of, inside
from slipid.support.toml_file import checked
from tests.app.test_config import GOOD, job_of, written
from tests.helpers.broken_logs import GENERIC, GENERIC_LAYOUT, ROBOTINO, write_good
from tests.helpers.nonsense import refuse_nonsense
from tests.helpers.one_log import read_log

WHEELS = {"wheel_radius_m": 0.04, "gear_ratio": 16.0, "mass_kg": 12.0}
SETTINGS = {
    "limits": {
        "speed_m_s": 1.0,
        "yaw_rate_rad_s": 1.0,
        "acceleration_m_s2": 1.0,
        "wheel_speed_rad_s": 9.0,
        "voltage_v": 24.0,
    },
    "sensors": {
        "ammeter_std_a": 0.1,
        "voltmeter_std_v": 0.1,
        "gyro_std_rad_s": 0.1,
        "gyro_bias_std_rad_s": 0.1,
        "stale_s": 0.1,
    },
    "actuators": {"delay_s": 0.1, "lag_s": 0.1},
}
ROBOTS: tuple[dict[str, object], ...] = (
    {"drive": "omni", "base_radius_m": 0.1, "wheel_azimuths_deg": [60, 180, 300], **SETTINGS},
    {"drive": "skid", "half_length_m": 0.1, "half_width_m": 0.1},
    {"drive": "differential", "track_m": 0.1},
    {"drive": "steered", "wheelbase_m": 0.1},
    {
        "drive": "general",
        "wheel_places_m": [[0.1, 0.1], [-0.1, 0.1]],
        "drive_directions_deg": [0, 90],
        "roller_angles_deg": [90, 45],
    },
)
TABLES = {
    "logs": [{"glob": "a/*.csv", "format": "g", "min_rows": 3}],
    "camera": {"image_centre_m": [0.0, 1.0]},
    "parameters": {
        "camera.lag": {"start": 0.1, "prior": {"mean": [0.1], "std": 0.1}},
        "camera.scale": {"fixed": 1.0},
    },
    "weights": {
        "a": {"std_kg": 0.1, "kg": [1.0, 2.0]},
        "b": {"std_kg": 0.1, "like": "a", "mass_kg": -1.0, "place_m": [0.1, 0.2]},
    },
    "fit": {
        "windows_per_piece": 4,
        "longest_window_s": 3.0,
        "rounds": 30,
        "tolerance": 0.02,
        "seed": 0,
    },
    "selftest": {
        "headings": 12,
        "speeds_m_s": [0.1],
        "turns": 2,
        "distance_m": 0.7,
        "truth": {"camera.lag": 0.1},
    },
}
OPTIONAL = {"mass_kg", *(key for one in SETTINGS.values() for key in one), "longest_window_s"}
OPTIONAL |= {"start", "fixed", "torque_constant", "wheel_radius", "row_period", "metres_per_pixel"}
LAYOUT = {
    **GENERIC_LAYOUT,
    "columns": {
        **GENERIC_LAYOUT["columns"],
        "gyro": {"column": "x", "unit": "deg/s", "scale": [-1.0], "offset": 2.0},
    },
    "tick_bits": 32,
    "torque_constant": 0.05,
    "wheel_radius": 0.05,
    "max_gap": 1.0,
    "max_pose_jump": 0.5,
    "max_heading_jump": 1.6,
    "names_row": 1,
    "units_row": 0,
    "first_data_row": 2,
    "row_period": 0.1,
    "metres_per_pixel": 0.01,
}
BAG = {
    "topics": {"wheel_ticks": {"topic": "/ticks", "scale": [1.0, -1.0], "offset": 0.5}},
    "ticks_per_revolution": 500.0,
    "max_disorder": 0.1,
    "runs": {"pause_s": 2.0},
}


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot["drive"])
def test_every_number_of_a_config_has_bounds(robot):
    content = {"robot": {**WHEELS, **robot}, **(TABLES if robot is ROBOTS[0] else {"logs": []})}
    content["logs"] = TABLES["logs"]
    count = refuse_nonsense(content, lambda m: checked("c.toml", m, ConfigContent), OPTIONAL)
    assert count > 4


def test_every_number_of_a_layout_has_bounds():
    assert refuse_nonsense(LAYOUT, lambda m: declared_layout(m, "layout"), OPTIONAL) == 15
    optional = {"ticks_per_revolution"}
    assert refuse_nonsense(BAG, lambda m: declared_bag_layout(m, "layout"), optional) == 6


@pytest.mark.parametrize(
    ("key", "wrong", "message"),
    [
        ("ticks_per_revolution", 1e-320, "1e-320; expected a number from 0.1 to 1e+09"),
        ("tick_bits", 100_000, "tick_bits: 100000; expected a whole number from 1 to 64"),
        ("tick_bits", 10**400, "tick_bits: a whole number of 1329 bits; expected a whole number"),
        ("tick_bits", 32.0, "tick_bits: 32.0; expected a whole number"),
        ("format", [], "no format '[]'"),
        ("beside", {"../poses.csv": {}}, "beside: '../poses.csv' leaves its folder"),
        ("beside", {"{stem}.p.csv": {}}, "no columns; expected a table of channels"),
        (
            "beside",
            {"{stem}.p.csv": {"columns": {"gyro": {"column": "g", "unit": "rad/s"}}}},
            "beside.'{stem}.p.csv': no time column",
        ),
    ],
)
def test_layouts_with_nonsense_are_refused(key, wrong, message):
    with pytest.raises(DataError) as caught:
        declared_layout({**GENERIC_LAYOUT, key: wrong}, "layout")
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"wheel_ticks": (1e10, 0.0)}, "row 3, column 'left': the wheel turns 4.0"),
        ({"motor_speed": (1e18, 0.0)}, "row 2, column 'left_rpm': a motor_speed of 4e+19 rad/s"),
        ({"pose_y": (1.0, 1e12)}, "row 2, column 'y': a coordinate of 1e+09 m"),
        ({"time": (1e15, 0.0)}, "row 3, column 'time': rows 2e+13 s apart"),
        ({"time": (-1.0, 0.0)}, "row 3, column 'time': time goes backwards"),
    ],
)
def test_what_a_scale_makes_of_numbers_is_checked(tmp_path, columns, message):
    """The columns have their own numbers times a factor, and an offset."""
    write_good(tmp_path)
    declared = {
        name: {**of, "scale": columns[name][0], "offset": columns[name][1]}
        if name in columns
        else of
        for name, of in GENERIC_LAYOUT["columns"].items()
    }
    layout = declared_layout({**GENERIC_LAYOUT, "columns": declared}, "layout")
    with pytest.raises(DataError) as caught:
        read_log(tmp_path / GENERIC, layout, root=tmp_path)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("glob", "message"),
    [
        (".", "'.' is the folder itself; expected files inside it"),
        ("./", "is the folder itself"),
        ("", "expected a path of 1 to 300 printable characters"),
        ("../other/*.csv", "'../other/*.csv' leaves its folder"),
        ("a/../../b.csv", "leaves its folder"),
        ("..\\b.csv", "leaves its folder"),
        ("/abs/*.csv", "leaves its folder"),
        ("C:/logs/*.csv", "leaves its folder"),
        ("a/" * 150 + "*.csv", "expected a path of 1 to 300 printable characters"),
        ("a" * 250, "expected names of at most 240 bytes"),
        ("a\0.csv", "printable characters"),
    ],
)
def test_globs_and_tables_stay_in_their_folder(tmp_path, glob, message):
    write_good(tmp_path)
    for keys in ({"glob": glob}, {"glob": "*.csv", "end_poses": glob}):
        with pytest.raises(DataError) as caught:
            checked("c.toml", {"format": "g", **keys}, LogsSection)
        assert f"c.toml: {[*keys][-1]}: " in str(caught.value)
        assert message in str(caught.value)
    with pytest.raises(DataError) as caught:
        find_logs(tmp_path, glob)
    assert message in str(caught.value)


def test_a_search_of_very_many_files_is_refused(tmp_path, monkeypatch):
    write_good(tmp_path)
    assert find_logs(tmp_path, "**/*.csv") == sorted(tmp_path.rglob("*.csv"))
    with pytest.raises(DataError, match=r"has several \*\*; expected at most one"):
        find_logs(tmp_path, "**/a/**/*.csv")
    monkeypatch.setattr(reader, "MOST_FILES", 3)
    with pytest.raises(DataError, match="searches more than 3 files; expected a glob with the"):
        find_logs(tmp_path, "**/*.csv")
    assert find_logs(tmp_path, "generic/**/*.csv") == [tmp_path / GENERIC]
    with pytest.raises(DataError, match="leaves its folder"):
        matching_files(job_config(tmp_path), job_config(tmp_path).content.logs, tmp_path, "../*")


def job_config(folder: Path):
    from slipid.app.config import read_config

    return read_config(written(folder, GOOD))


def test_a_link_that_leads_outside_is_followed(tmp_path):
    write_good(tmp_path / "elsewhere")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "link").symlink_to(tmp_path / "elsewhere")
    assert find_logs(tmp_path / "data", "link/generic/*.csv")
    config = job_config(tmp_path)
    assert not files_of(config, config.content.logs, tmp_path / "data")[0]


def test_an_additional_file_is_not_the_main_file(tmp_path):
    write_good(tmp_path)
    poses = {k: v for k, v in GENERIC_LAYOUT["columns"].items() if k.startswith(("time", "pose"))}
    wheels = {k: v for k, v in GENERIC_LAYOUT["columns"].items() if not k.startswith("pose")}
    table = {**GENERIC_LAYOUT, "columns": wheels, "beside": {"{stem}.csv": {"columns": poses}}}
    with pytest.raises(DataError, match=r"run\.csv: '\{stem\}\.csv', the name of an additional"):
        without_beside([tmp_path / GENERIC], declared_layout(table, "layout"))
    table["beside"] = {"{stem}" + "x" * 230: {"columns": poses}}
    with pytest.raises(DataError, match=r"missing; expected in the folder of run\.csv"):
        read_log(tmp_path / GENERIC, declared_layout(table, "layout"), root=tmp_path)


@pytest.mark.parametrize("drive", DRIVES)
def test_options_of_new_have_the_bounds_of_the_config(drive):
    for name in ("wheelbase_m", "track_m", "base_radius_m", "gear_ratio", "ticks_per_revolution"):
        for text in ("1e308", "nan", "-1"):
            with pytest.raises(DataError, match=r"expected a number from|not an option for drive"):
                ask({"drive": drive, name: text}, None)
    if drive == "general":
        with pytest.raises(DataError, match="expected a number from -1000 to 1000 m"):
            ask({"drive": drive, "places_m": "0,1e308; 1,1"}, None)


def test_bounds_are_inclusive_and_say_what_they_are():
    bounds = bounds_of(WheeledDrive.model_fields["wheel_radius_m"].metadata[0])
    assert bounds == Bounds(1e-4, 1e3, "m")
    assert bounds_of(float | None) is None
    assert bounds.checked(1000) == 1000.0
    assert isinstance(bounds.checked(1), float)
    assert not bounds.holds(math.nan)
    assert Bounds(1e-3, 3, "m/s", of_size=True).holds(-2.0)
    assert inside("a/./b..csv") == "a/./b..csv"


def test_a_wrong_glob_is_named_with_its_key(tmp_path):
    write_good(tmp_path)
    with pytest.raises(DataError, match=r"my.toml: logs\[1\].glob: '\.' is the folder itself"):
        job_of(tmp_path, GOOD.replace("one_surface/*/*.csv", "."))
    assert (tmp_path / ROBOTINO).is_file()
