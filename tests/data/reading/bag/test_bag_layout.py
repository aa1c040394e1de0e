"""Layouts of bags as a config declares them."""

from __future__ import annotations

import tomllib

import pytest

from slipid.data.reading.bag.layout import declared_bag_layout
from slipid.support.errors import DataError

WHOLE = """
kind = "bag"
joints = ["left", "right"]
runs = { pause_s = 2.0 }
max_disorder = 0.5
ticks_per_revolution = 2000
[topics]
wheel_ticks = { topic = "/motors", unit = "tick", field = "positions", scale = [1.0, -1.0] }
pose = { topic = "/tf", frame = "map", child = "base_link" }
twist_command = { topic = "/cmd_vel" }
"""


def test_a_whole_layout():
    layout = declared_bag_layout(tomllib.loads(WHOLE), "robot.toml [layouts.mine]")
    assert layout.joints == ("left", "right")
    assert layout.topics["wheel_ticks"].topics == ("/motors",)
    assert layout.topics["wheel_ticks"].scale == (1.0, -1.0)
    assert layout.topics["pose"].child == "base_link"
    assert layout.runs is not None
    assert layout.runs.pause_s == 2.0
    assert (layout.stamp, layout.max_disorder) == ("header", 0.5)


def test_definitions_count_from_the_folder_of_the_config(tmp_path):
    (tmp_path / "msgs").mkdir()
    table = {"topics": {"gyro": {"topic": "/imu"}}, "definitions": "msgs"}
    assert declared_bag_layout(table, "layout", tmp_path).definitions == tmp_path / "msgs"


GYRO = {"gyro": {"topic": "/imu"}}


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({}, ("topics", "missing")),
        ({"topics": {}}, ("topics", "a table of channels")),
        ({"topics": {"gyr": {"topic": "/imu"}}}, ("no channel 'gyr', did you mean gyro",)),
        ({"topics": {"time": {"topic": "/clock"}}}, ("no channel 'time'",)),
        ({"topics": GYRO, "joint": ["a"]}, ("joint: no such key, did you mean joints",)),
        ({"topics": {"gyro": {"topic": "/imu", "scael": 2.0}}}, ("scael", "did you mean scale")),
        ({"topics": {"gyro": {}}}, ("topics.gyro", "missing")),
        (
            {"topics": {"gyro": {"topic": "/imu", "field": "a..b"}}},
            ("not a path of", "a..b"),
        ),
        ({"topics": {"gyro": {"topic": "/imu", "field": "a[x]"}}}, ("motors[0].current",)),
        ({"topics": {"gyro": {"topic": "/imu", "unit": "m"}}}, ("cannot be converted to rad/s",)),
        ({"topics": {"gyro": {"topic": ["/a", "/b"]}}}, ("2 topics", "expected one")),
        ({"topics": {"gyro": {"topic": "/a", "frame": "x", "child": "y"}}}, ("for poses only",)),
        ({"topics": {"pose": {"topic": "/tf", "frame": "map"}}}, ("only one of frame and child",)),
        ({"topics": {"pose": {"topic": "/p", "unit": "mm"}}}, ("pose_x, pose_y, pose_heading",)),
        (
            {"topics": {"pose": {"topic": "/p"}, "pose_x": {"topic": "/q", "unit": "m"}}},
            ("pose and pose_x",),
        ),
        ({"topics": {"pose_x": {"topic": "/q", "unit": "m"}}}, ("only one of pose_x and pose_y",)),
        ({"topics": {"wheel_ticks": {"topic": "/m"}}}, ("without ticks_per_revolution",)),
        ({"topics": GYRO, "joints": ["a", "a"]}, ("each name only once",)),
        ({"topics": GYRO, "stamp": "sent"}, ("stamp", "'header' or 'received'")),
        ({"topics": GYRO, "definitions": "nowhere"}, ("no folder nowhere", ".msg files")),
        ({"topics": GYRO, "runs": {}}, ("one of topic, pause_s and table",)),
        ({"topics": GYRO, "runs": {"pause_s": 1.0, "topic": "/x"}}, ("one of topic, pause_s",)),
        ({"topics": GYRO, "runs": {"pause": 1.0}}, ("pause", "did you mean pause_s")),
        (
            {"topics": GYRO, "runs": {"pause_s": 1.0}},
            ("without a channel of the wheels", "wheel_angle"),
        ),
    ],
)
def test_what_a_layout_may_not_say(table, words):
    with pytest.raises(DataError) as caught:
        declared_bag_layout(table, "robot.toml [layouts.mine]")
    text = str(caught.value)
    assert text.startswith("robot.toml [layouts.mine]"), text
    assert all(word in text for word in words), text
