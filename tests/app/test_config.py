"""Configs: accepted keys, refusals and their messages, and the fit task of a config."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from slipid.app.check import overview
from slipid.app.config import geometry, given_settings, read_config
from slipid.app.problem import read_fit_task
from slipid.report.checks import show_check
from slipid.report.page import text_of
from slipid.support.errors import DataError
from tests.helpers.broken_logs import generic_text, robotino_text, write_good
from tests.helpers.said import KeptMessages

CONFIGS = sorted((Path(__file__).resolve().parents[2] / "configs").glob("*.toml"))

GOOD = """
[robot]
drive = "omni"
wheel_radius_m = 0.04
base_radius_m = 0.125
wheel_azimuths_deg = [60, 180, 300]
gear_ratio = 16
mass_kg = 12.0

[[logs]]
glob = "one_surface/*/*.csv"
format = "robotino2022"

[parameters]
"camera.lag" = { prior = { mean = 0.05, std = 0.01 } }
"surface.*.lead" = { fixed = 0.001 }
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "my.toml"
    path.write_text(text, encoding="utf-8")
    return path


def refused(folder: Path, text: str) -> str:
    with pytest.raises(DataError) as caught:
        read_config(written(folder, text))
    message = str(caught.value)
    assert all(line.startswith(f"{folder / 'my.toml'}: ") for line in message.splitlines())
    return message


@pytest.mark.parametrize(
    "path", [p for p in CONFIGS if not p.name.startswith("testsite")], ids=lambda p: p.name
)
def test_configs_that_ship_are_good(path):
    content = read_config(path).content
    assert content.logs
    if content.robot.drive == "motor":
        assert len(content.robot.names) == 3
        return
    skid = path.name in ("husky.toml", "warthog.toml")
    shape = geometry(content.wheels)
    assert (shape.wheels, shape.drives) == ((4, 2) if skid else (3, 3))


def test_all_four_configs_ship():
    names = {path.name for path in CONFIGS}
    assert names >= {"robotino.toml", "robotino2021.toml", "robotino2022.toml", "omni3.toml"}


def test_units_reach_the_geometry(tmp_path):
    robot = geometry(read_config(written(tmp_path, GOOD)).content.robot)
    assert float(robot.wheel_radius) == 0.04
    assert float(robot.base_radius) == pytest.approx(0.125)
    assert robot.gear_ratio == 16
    assert np.degrees(robot.drive_angle) == pytest.approx([150, 270, 390])


@pytest.mark.parametrize(
    ("section", "wheels", "grips"),
    [
        ('drive = "mecanum"\nhalf_length_m = 0.2\nhalf_width_m = 0.15', 4, False),
        ('drive = "skid"\nhalf_length_m = 0.2\nhalf_width_m = 0.15', 4, True),
        (
            'drive = "general"\nwheel_places_m = [[0, 0.1], [0, -0.1]]\n'
            'drive_directions_deg = [0, 0]\nroller_angles_deg = ["none", 90]',
            2,
            None,
        ),
    ],
)
def test_other_drives(tmp_path, section, wheels, grips):
    head, tail = GOOD.split("[[logs]]")
    text = f"[robot]\n{section}\nwheel_radius_m = 0.05\n[[logs]]{tail}"
    shape = geometry(read_config(written(tmp_path, text)).content.robot)
    assert shape.wheels == wheels
    if grips is None:
        assert shape.grips == (True, False)
    else:
        assert set(shape.grips) == {grips}
    assert head


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("base_radius_m", "base_radius", ["robot.base_radius: no such key", "mean base_radius_m"]),
        ("base_radius_m = 0.125\n", "", ["robot.base_radius_m: missing"]),
        ('"omni"', '"omny"', ["robot.drive: 'omny'", "did you mean omni", "mecanum, skid"]),
        (
            'drive = "omni"\n',
            "",
            ["robot.drive: missing", "omni, mecanum, skid, differential, steered, general"],
        ),
        (
            "[[logs]]",
            "[camera]\nimage_centre_m = [0.5]\n[[logs]]",
            ["camera.image_centre_m: [0.5]; expected more values than 1"],
        ),
        (
            "gear_ratio = 16",
            "gear_ratio = -16",
            ["robot.gear_ratio: -16", "a number from 0.001 to 100000"],
        ),
        ("gear_ratio = 16", 'gear_ratio = "16:1"', ["robot.gear_ratio: '16:1'", "number"]),
        ("mass_kg = 12.0", "mass_kg = nan", ["robot.mass_kg: nan", "finite"]),
        (
            "mass_kg = 12.0",
            "mass_kg = 12.0\nlimits = { speed_m_s = 0, speed = 1 }",
            ["robot.limits.speed_m_s: 0", "to 50 m/s", "speed: no such key, did you mean"],
        ),
        (
            "mass_kg = 12.0",
            "mass_kg = 12.0\nlimits = { wheel_speed_rad_s = 4000 }",
            ["robot.limits.wheel_speed_rad_s: 4000", "from 0.001 to 1000 rad/s"],
        ),
        (
            "mass_kg = 12.0",
            "mass_kg = 12.0\nsensors = { gyro_std_rad_s = -1 }\nactuators = { lag_s = -1 }",
            ["robot.sensors.gyro_std_rad_s: -1", "robot.actuators.lag_s: -1", "from 0 to 5 s"],
        ),
        ("[60, 180, 300]", "[60, 180]", ["robot.wheel_azimuths_deg", "at least 3"]),
        ("[[logs]]", "[[log]]", ["log: no such key", "did you mean logs", "logs: missing"]),
        ("glob =", "globb =", ["logs[1].globb: no such key", "mean glob", "logs[1].glob: missing"]),
        ("std = 0.01", "std = -0.01", ['"camera.lag".prior.std: -0.01', "a number from 1e-12"]),
        ("fixed = 0.001", "fixd = 0.001", ['"surface.*.lead".fixd', "did you mean fixed"]),
        (
            "fixed = 0.001",
            "fixed = 0.001, free = true",
            ['"surface.*.lead": fixed is given together with free'],
        ),
        ("[robot]", "[robot", ["not valid TOML", "line 2"]),
    ],
)
def test_mistakes_are_named_with_key_and_choices(tmp_path, old, new, expected):
    assert old in GOOD
    message = refused(tmp_path, GOOD.replace(old, new, 1))
    assert [part for part in expected if part not in message] == [], message


def test_general_needs_one_of_each_per_wheel(tmp_path):
    text = (
        '[robot]\ndrive = "general"\nwheel_radius_m = 0.05\nwheel_places_m = [[0, 1], [1, 0]]\n'
        'drive_directions_deg = [0]\nroller_angles_deg = [90, 90]\n[[logs]]\nglob = "*"\n'
        'format = "robotino2022"\n'
    )
    assert "1 drive_directions_deg; expected 2" in refused(tmp_path, text)


def test_absent_and_unreadable_files(tmp_path):
    with pytest.raises(DataError, match=r"No such file.*expected a config"):
        read_config(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="not UTF-8 text"):
        read_config(tmp_path / "binary.toml")


# from config and folder to a job ----------------------------------------------------------------


def job_of(folder: Path, text: str, said: KeptMessages | None = None):
    return read_fit_task(read_config(written(folder, text)), folder, said or KeptMessages())


def test_a_fit_task_reads_floors_from_folders_and_takes_the_mass(tmp_path):
    write_good(tmp_path)
    other = tmp_path / "one_surface/green_surface/exp01.csv"
    other.parent.mkdir()
    other.write_text(robotino_text(heading=50), encoding="utf-8")
    job = job_of(tmp_path, GOOD)
    assert job.robot.surfaces.labels == ("gray", "green")
    assert [log.name for log in job.dataset.logs] == [
        "one_surface/gray/exp07.csv",
        "one_surface/green_surface/exp01.csv",
    ]
    assert job.dataset.session == ("gray/as_built/0.10", "green/as_built/0.10")
    problem = job.problem()
    assert float(problem.robot.body.mass) == 12.0
    assert not [p for p in problem.space.slices if p.startswith("robot.") and "share" not in p]
    assert problem.windows.lag == pytest.approx(0.05)  # where the lag starts
    assert float(problem.robot.surfaces.lead[0]) == 0.001
    assert "surface.gray.lead" not in problem.space.slices


def test_values_of_the_robot_section_are_centres_of_priors(tmp_path):
    write_good(tmp_path)
    freed = '[parameters]\n"robot.*" = { free = true }\n"robot.base_radius" = { prior = '
    text = GOOD.replace("[parameters]", f"{freed}{{ mean = 0.13, std = 0.005 }} }}")
    space = job_of(tmp_path, text).problem().space

    def prior(path):
        at = space.slices[path]
        return np.exp(space.prior_mean[at]), space.prior_std[at]

    np.testing.assert_allclose(prior("robot.wheel_radius"), [[0.04], [0.02]])
    np.testing.assert_allclose(prior("robot.mass"), [[12.0], [0.1]])
    np.testing.assert_allclose(prior("robot.base_radius"), [[0.13], [0.005 / 0.13]])


def test_limits_are_those_of_the_config_and_else_of_the_logs(tmp_path):
    write_good(tmp_path)
    shown = job_of(tmp_path, GOOD).robot_settings
    assert {origin for _, origin in shown.values()} == {"logs"}
    table = "limits = { speed_m_s = 0.7 }\nactuators = { lag_s = 0 }\nmass_kg = 12.0"
    own = job_of(tmp_path, GOOD.replace("mass_kg = 12.0", table)).robot_settings
    both = {"limits.speed": (0.7, "config"), "actuators.lag_s": (0.0, "config")}
    assert own == shown | both != shown
    assert shown["limits.speed"][0] < 0.7


def test_the_limits_that_check_prints_can_be_pasted_into_the_config(tmp_path):
    write_good(tmp_path)
    job = job_of(tmp_path, GOOD)
    text = text_of(show_check, overview(job) | {"parameters": {}, "derived": {}, "messages": []})
    block = [line for line in text.splitlines() if line.startswith("[robot.") or " = " in line]
    pasted = GOOD.replace("[[logs]]", "\n".join([*block, "[[logs]]"]))
    given = given_settings(read_config(written(tmp_path, pasted)).content.wheels)
    assert {path: (value, "logs") for path, value in given.items()} == job.robot_settings != {}


def test_any_name_of_a_floor_will_do(tmp_path):
    write_good(tmp_path)
    (tmp_path / "one_surface/gray").rename(tmp_path / "one_surface/gray[1]*")
    problem = job_of(tmp_path, GOOD).problem()
    assert problem.robot.surfaces.labels == ("gray[1]*",)
    assert "surface.gray[1]*.slide_viscosity" not in problem.space.slices


@pytest.mark.parametrize(
    ("rule", "expected"),
    [("folder", "one_surface/gray"), ("file", "one_surface/gray/exp07.csv")],
)
def test_session_rules(tmp_path, rule, expected):
    write_good(tmp_path)
    text = GOOD.replace("[parameters]", f'session = "{rule}"\n[parameters]')
    assert job_of(tmp_path, text).dataset.session == (expected,)


def test_a_set_without_files_is_skipped_with_a_line(tmp_path):
    write_good(tmp_path)
    more = '[[logs]]\nglob = "wheel_load/*/*.csv"\nformat = "robotino2022"\nload = "moved"\n'
    settings = '"robot.load_share@moved" = { free = false }\n"surface.blue.creep" = { start = 0.2 }'
    said = KeptMessages()
    job = job_of(tmp_path, GOOD.replace("[parameters]", f"{more}\n[parameters]\n{settings}"), said)
    lines = said.lines
    assert len(job.dataset) == 1
    assert [line.partition(":")[0] for line in lines] == ["skipped"] * 3
    assert "wheel_load" in lines[0]
    assert "robot.load_share@moved" in lines[1]
    assert "surface.blue.creep" in lines[2]


def test_links_that_lead_nowhere_are_named(tmp_path):
    write_good(tmp_path)
    folder = tmp_path / "one_surface" / "gray"
    (folder / "lost.csv").symlink_to(tmp_path / "nowhere.csv")
    noted = KeptMessages()
    assert len(job_of(tmp_path, GOOD, noted).dataset) == 1
    assert noted.lines[0].startswith("skipped: 1 link leads nowhere (")
    assert "lost.csv); expected files" in noted.lines[0]
    (folder / "exp07.csv").unlink()
    with pytest.raises(DataError, match=r"1 link leads nowhere \(.*lost.csv\); expected files"):
        job_of(tmp_path, GOOD)


def test_no_log_at_all_names_what_is_there(tmp_path):
    write_good(tmp_path)
    with pytest.raises(DataError, match=r"no file matches 'runs/\*'.*generic/, my.toml, one_sur"):
        job_of(tmp_path, GOOD.replace("one_surface/*/*.csv", "runs/*"))


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("camera.lag", "camera.lagg", "no such parameter, did you mean camera.lag"),
        ("mean = 0.05", "mean = [0.05, 0.1]", "camera.lag: 2 values; expected 1"),
        ('"robotino2022"', '"robotino22"', "no such layout, did you mean robotino2022"),
        ("[60, 180, 300]", "[0, 90, 180, 270]", "4 wheels, but one_surface/gray/exp07.csv has 3"),
        ("one_surface", "/one_surface", "logs[1].glob: '/one_surface/*/*.csv' leaves its folder"),
    ],
)
def test_config_and_logs_must_fit_each_other(tmp_path, old, new, expected):
    write_good(tmp_path)
    with pytest.raises(DataError) as caught:
        job_of(tmp_path, GOOD.replace(old, new, 1))
    assert expected in str(caught.value)


def test_a_file_found_twice_is_refused(tmp_path):
    write_good(tmp_path)
    again = '[[logs]]\nglob = "one_surface/gray/*.csv"\nformat = "robotino2022"\n[parameters]'
    with pytest.raises(DataError, match="found by two globs"):
        job_of(tmp_path, GOOD.replace("[parameters]", again))


def test_short_runs_can_be_left_out(tmp_path):
    write_good(tmp_path)
    short = tmp_path / "one_surface/gray/exp08.csv"
    short.write_text(robotino_text(rows=30), encoding="utf-8")
    said = KeptMessages()
    job = job_of(tmp_path, GOOD.replace("[parameters]", "min_rows = 50\n[parameters]"), said)
    assert len(job.dataset) == 1
    assert said.lines == ["skipped: 1 runs with fewer rows than the min_rows of their section"]


def with_duty(folder, cells):
    """A log with columns of two duties and the bus voltage, and the text of its config."""
    lines = generic_text().splitlines()
    lines = [f"{lines[0]},d1,d2,bus"] + [f"{line},{cells}" for line in lines[1:]]
    (folder / "run.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    columns = {
        "time": {"column": "time", "unit": "s"},
        "wheel_ticks": {"columns": ["left", "right"], "unit": "tick"},
        "duty": {"columns": ["d1", "d2"], "unit": "1"},
        "bus_voltage": {"column": "bus", "unit": "V"},
        "pose_x": {"column": "x", "unit": "mm"},
        "pose_y": {"column": "y", "unit": "mm"},
        "pose_heading": {"column": "heading", "unit": "deg"},
    }
    inline = "\n".join(
        f"{name} = {{ " + ", ".join(f"{k} = {json.dumps(v)}" for k, v in spec.items()) + " }"
        for name, spec in columns.items()
    )
    return (
        '[robot]\ndrive = "general"\nwheel_radius_m = 0.05\n'
        "wheel_places_m = [[0, 0.1], [0, -0.1]]\ndrive_directions_deg = [0, 0]\n"
        'roller_angles_deg = ["none", "none"]\n'
        "[layouts.mine]\nticks_per_revolution = 500\ngear_ratio = 10\n"
        f"[layouts.mine.columns]\n{inline}\n"
        '[[logs]]\nglob = "*.csv"\nformat = "mine"\nsurface = "floor"\n'
    )


def test_duty_and_bus_voltage_make_a_voltage(tmp_path):
    text = with_duty(tmp_path, "0.25,-50e-2,24")
    voltage = job_of(tmp_path, text).dataset.voltage
    assert voltage is not None
    assert voltage[0] == pytest.approx([6.0, -12.0])


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        ("0.25,-50e-2,24000", "row 2, column 'bus': bus_voltage of 2.4e+04 V"),
        ("50,-50e-2,24", "row 2, column 'd1': duty of 50 (1 is the full supply voltage)"),
    ],
)
def test_what_makes_a_voltage_is_refused_by_its_own_name(tmp_path, cells, expected):
    text = with_duty(tmp_path, cells)
    with pytest.raises(DataError) as caught:
        job_of(tmp_path, text)
    assert expected in str(caught.value)


def test_a_mistake_in_a_column_names_its_key(tmp_path):
    text = with_duty(tmp_path, "0.25,-50e-2,24").replace('column = "time"', "column = 1.5")
    with pytest.raises(DataError, match=r"columns\.time: column: 1\.5; expected"):
        job_of(tmp_path, text)
