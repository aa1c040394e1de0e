"""A new config: questions of each drive, the written text, and the drawing of the robot."""

from __future__ import annotations

import math
import tomllib
from itertools import chain
from pathlib import Path

import numpy as np
import pytest

from slipid.app.config import geometry, given_settings, parsed
from slipid.app.new.config_lines import QUESTION_MARK, ConfigLine, drawing
from slipid.app.new.config_text import new_config
from slipid.app.new.draft import template_draft
from slipid.app.new.robot_questions import DRIVES, ask
from slipid.data.reading.presets import declared_layout
from slipid.model import geometry as g
from slipid.support.errors import DataError

SIZES = {
    "wheel_radius_m": "0.08",
    "gear_ratio": "12",
    "mass_kg": "20",
    "ticks_per_revolution": "512",
}
LIMITS = {
    "speed_m_s": "1.5",
    "yaw_rate_rad_s": "",
    "acceleration_m_s2": "from the logs",
    "wheel_speed_rad_s": "30",
    "voltage_v": "",
}
BOX = {"wheelbase_m": "0.5", "track_m": "0.6"}
CORNERS = [(0.25, 0.3), (0.25, -0.3), (-0.25, 0.3), (-0.25, -0.3)]
FOUR = {
    "places_m": "0.2, 0.1; 0.2, -0.1; -0.3, 0",
    "directions_deg": "0, 0, 90",
    "rollers_deg": "none, none, 45",
}
CASES = {
    "omni": (
        {"azimuths_deg": "45, 135, 225, 315", "base_radius_m": "0.2"},
        [(0.2 * math.cos(a), 0.2 * math.sin(a)) for a in np.radians([45, 135, 225, 315])],
        [135, 225, 315, 45],
        4,
    ),
    "mecanum": ({**BOX, "shared": "no"}, CORNERS, [0] * 4, 4),
    "skid": ({**BOX, "shared": "yes"}, CORNERS, [0] * 4, 2),
    "differential": ({"track_m": "0.6"}, [(0, 0.3), (0, -0.3)], [0, 0], 2),
    "steered": (
        {"wheelbase_m": "0.4", "driven": "front", "encoders": "2"},
        [(0.4, 0)] * 2,
        [0, 0],
        2,
    ),
    "general": (FOUR, [(0.2, 0.1), (0.2, -0.1), (-0.3, 0)], [0, 0, 90], 3),
}


def made(drive: str, **more: str):
    told = {**CASES[drive][0], **SIZES, "drive": drive, **more}
    return new_config(template_draft(ask(told, None)), "mine.toml")


def refuse(*_: object) -> str:
    raise AssertionError("asked, though everything was told")


@pytest.mark.parametrize("drive", CASES)
def test_wheels_stand_where_the_answers_place_them(drive):
    _, places, directions, drives = CASES[drive]
    told = {**CASES[drive][0], **SIZES, "drive": drive}
    told |= {} if drive == "steered" else LIMITS
    config = new_config(template_draft(ask(told, refuse)), "mine.toml")
    content = parsed(Path("mine.toml"), config.text).content
    robot = geometry(content.robot)
    place = np.asarray(robot.place) * float(robot.base_radius)
    np.testing.assert_allclose(place, places, atol=1e-6)
    turned = np.degrees(robot.drive_angle) % 360
    np.testing.assert_allclose(turned, directions, atol=1e-9)
    assert robot.drives == drives
    assert float(robot.wheel_radius) == pytest.approx(0.08)
    assert (robot.gear_ratio, content.robot.mass_kg) == (12, 20)
    limits = {} if drive == "steered" else {"limits.speed": 1.5, "limits.wheel_speed": 30.0}
    assert given_settings(content.wheels) == limits
    assert ("\n# voltage_v = 24 " in config.text) is (drive != "steered")
    layout = declared_layout(content.layouts["mine"], "mine")
    assert len(layout.channels["wheel_ticks"].columns) == drives
    assert (layout.ticks_per_revolution, layout.gear_ratio) == (512, 12)


def test_every_drive_has_a_case():
    assert set(CASES) == set(DRIVES)


@pytest.mark.parametrize("drive", CASES)
def test_a_config_has_only_what_its_drive_has(drive):
    robot = tomllib.loads(made(drive).text)["robot"]
    common = {"drive", "wheel_radius_m", "gear_ratio", "mass_kg"}
    own = {
        "omni": {"wheel_azimuths_deg", "base_radius_m"},
        "mecanum": {"half_length_m", "half_width_m"},
        "skid": {"half_length_m", "half_width_m", "drives"},
        "differential": {"track_m"},
        "steered": {"wheelbase_m", "driven", "encoders"},
        "general": {"wheel_places_m", "drive_directions_deg", "roller_angles_deg"},
    }
    assert set(robot) == common | own[drive]


def test_every_key_is_explained():
    for line in made("skid").text.splitlines():
        key = line.partition(" = ")[0]
        if key in ("half_width_m", "drives", "delimiter", "first_data_row", "glob", "load"):
            assert " # " in line or line.startswith("#"), line
    assert "half the distance between the middles of the left" in made("skid").text


def test_logs_without_ticks_have_speeds():
    columns = tomllib.loads(made("skid", ticks_per_revolution="0").text)["layouts"]["mine"]
    assert "ticks_per_revolution" not in columns
    assert "wheel_ticks" not in columns["columns"]
    assert columns["columns"]["wheel_speed"]["columns"] == ["speed_left", "speed_right"]


def test_missing_answers_are_questions_in_the_file_and_in_the_list():
    config = new_config(template_draft(ask({"drive": "skid", "track_m": "0.5"}, None)), "mine.toml")
    asked = [question.partition(":")[0] for question in config.questions]
    assert "half_length_m" in asked
    assert "half_width_m" not in asked
    lines = config.text.splitlines()
    assert sum(line.startswith(QUESTION_MARK) for line in lines) == len(config.questions)
    assert lines[
        lines.index(next(x for x in lines if x.startswith("half_length_m"))) - 1
    ].startswith(QUESTION_MARK)


def test_only_questions_of_the_drive_are_put_and_repeated_after_wrong_answers():
    said: list[tuple[str, str]] = []
    answers = iter(["skidd", "skid", "0.5", "-1", "wide", "0.6", "yes", "0.08", "1", "20", "0"])
    answers = chain(answers, ["0", "2.5", "", "from the logs", "fast", "9", "48"])

    def asker(asks: str, default: str, wrong: str) -> str:
        said.append((asks.split(",")[0], wrong))
        return next(answers)

    known = ask({}, asker)
    assert (known.drive, known.wheelbase_m, known.track_m, known.shared) == ("skid", 0.5, 0.6, True)
    assert not known.defaults
    wrong = [text for _, text in said if text]
    assert wrong[0] == (
        "'skidd': no such drive, did you mean skid?; "
        "expected one of omni, mecanum, skid, differential, steered, general"
    )
    assert wrong[1:] == [
        "'-1': expected a number from 0.0001 to 1000 m",
        "'wide': expected a number",
        "'0': expected a number from 0.0001 to 50 m/s",
        "'fast': expected a number",
    ]
    limits = (known.speed_m_s, known.yaw_rate_rad_s, known.acceleration_m_s2)
    assert (*limits, known.wheel_speed_rad_s, known.voltage_v) == (2.5, None, None, 9.0, 48.0)
    assert not [asks for asks, _ in said if "azimuth" in asks or "stand" in asks]


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"drive": "omny"}, "--drive 'omny': no such drive, did you mean omni?"),
        ({"drive": "motor"}, "--drive 'motor': a motor on a bench needs no config"),
        ({"wheel_radius_m": "0,05"}, "--wheel-radius-m '0,05': expected a number with a decimal"),
        ({"mass_kg": "0"}, "--mass-kg '0': expected a number from 1e-06 to 1e+07 kg"),
        ({"mass_kg": "nan"}, "--mass-kg 'nan': expected a number from 1e-06"),
        ({"mass_kg": "1e308"}, "--mass-kg '1e308': expected a number from 1e-06"),
        (
            {"drive": "skid", "azimuths_deg": "1,2,3"},
            "--azimuths-deg: not an option for drive skid",
        ),
        ({"wheels": "4", "azimuths_deg": "1,2,3"}, "3 angles; expected 4, one per wheel"),
        ({"azimuths_deg": "60,60,420"}, "expected at least three different ones"),
        ({"drive": "skid", "shared": "perhaps"}, "--shared 'perhaps': expected yes or no"),
        ({"drive": "general", "places_m": "1, 2"}, "--places-m '1, 2': expected x, y of each"),
        ({"drive": "general", **FOUR, "rollers_deg": "0, 1, 2"}, "run freely along it"),
    ],
)
def test_a_wrong_option_is_one_clear_error(told, message):
    with pytest.raises(DataError) as caught:
        new_config(template_draft(ask(told, None)), "mine.toml")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_long_comments_stand_above_their_key():
    line = ConfigLine("key", '"' + "x" * 70 + '"', "a comment that does not fit beside it")
    assert line.text().splitlines()[0] == "# a comment that does not fit beside it"


# drawings ---------------------------------------------------------------------------------------

SKID = r"""seen from above, arrows: direction of a positive wheel speed

                ^ x
    1↑A         |         2↑B
                |
                |
                |
                |
     y <--------+




    3↑A                   4↑B

wheel 1: front left   x = +0.256 m, y = +0.275 m, drives ahead, no rollers
wheel 2: front right  x = +0.256 m, y = -0.275 m, drives ahead, no rollers
wheel 3: rear left    x = -0.256 m, y = +0.275 m, drives ahead, no rollers
wheel 4: rear right   x = -0.256 m, y = -0.275 m, drives ahead, no rollers
motor A, column 1 of the logs: wheels 1 and 3
motor B, column 2 of the logs: wheels 2 and 4"""
OMNI = r"""seen from above, arrows: direction of a positive wheel speed

               ^ x
     1↙        |       3↖
               |
               |
    y <--------+




              2→

wheel 1: front left   x = +0.063 m, y = +0.108 m, drives back left (150 deg), rollers at 90 deg
wheel 2: rear         x = -0.125 m, y = +0.000 m, drives right, rollers at 90 deg
wheel 3: front right  x = +0.063 m, y = -0.108 m, drives ahead left (30 deg), rollers at 90 deg"""


@pytest.mark.parametrize(
    ("robot", "golden"),
    [
        (g.skid_steer(0.256, 0.275, 0.165, 1.0, (0, 1, 0, 1)), SKID),
        (g.omni([60.0, 180.0, 300.0], 0.125, 0.04), OMNI),
    ],
    ids=["skid", "omni"],
)
def test_drawings(robot, golden):
    assert drawing(robot) == golden


def test_a_drawing_shows_an_order_that_is_wrong():
    right = drawing(g.omni([60.0, 180.0, 300.0], 0.125, 0.04))
    assert drawing(g.omni([300.0, 180.0, 60.0], 0.125, 0.04)) != right
    assert drawing(g.omni([-60.0, -180.0, -300.0], 0.125, 0.04)) != right


def test_rollers_of_mecanum_wheels_make_an_x_from_above():
    lines = drawing(g.mecanum(0.2, 0.15, 0.05)).splitlines()
    assert [line[-1] for line in lines if line.startswith("wheel ")] == ["\\", "/", "/", "\\"]


def test_wheels_beside_each_other_do_not_hide_one_another():
    robot = g.general([(0.3, 0.2), (0.3, 0.19), (-0.3, 0.0)], [0.0] * 3, [None] * 3, 0.1)
    text = drawing(robot)
    assert all(f"{k}↑" in text for k in (1, 2, 3))


def test_the_drawing_is_in_the_config_as_a_comment():
    config = made("skid")
    for line in config.drawing.splitlines():
        assert f"# {line}".rstrip() in config.text.splitlines()
