"""Errors about bags say what is there and what to do."""

from __future__ import annotations

import numpy as np
import pytest

from slipid.data.reading.bag.layout import declared_bag_layout
from slipid.support.errors import DataError
from tests.helpers.made_bags import (
    Message,
    header,
    in_order,
    joint_states,
    pose_fields,
    vector,
    without_definitions,
    write_bag,
)
from tests.helpers.one_bag import runs_of

START = 1.7e9
TIME = START + np.arange(0.0, 2.0, 0.01)
ANGLE = np.column_stack([TIME - START, START - TIME])
IMU, POSE = "sensor_msgs/msg/Imu", "geometry_msgs/msg/PoseStamped"


def wheels(time=TIME, topic="/joint_states", **arrays):
    arrays = arrays or {"position": ANGLE, "velocity": ANGLE, "effort": ANGLE}
    return joint_states(topic, time, ["wheel_left", "wheel_right"], **arrays)


def poses(time=TIME, x=None):
    x = time - START if x is None else x
    return [
        Message("/pose", POSE, pose_fields(POSE, t, float(x[k]), 0, 0), t)
        for k, t in enumerate(time.tolist())
    ]


def imu(time=TIME, stamps=None):
    stamps = time if stamps is None else stamps
    return [
        Message("/imu", IMU, {"header": header(float(s)), "angular_velocity": vector(z=1)}, t)
        for t, s in zip(time.tolist(), stamps, strict=True)
    ]


def commands(time=TIME):
    return [Message("/cmd_vel", "geometry_msgs/msg/Twist", {}, t) for t in time.tolist()]


def refused(tmp_path, messages, topics, *words, joints=("wheel_left", "wheel_right"), **given):
    options = {name: given.pop(name) for name in ("definitions", "empty") if name in given}
    path = write_bag(tmp_path / "bag", given.pop("storage", "mcap"), messages, **options)
    layout = declared_bag_layout({"joints": list(joints), "topics": topics, **given}, "layout")
    with pytest.raises(DataError) as caught:
        runs_of(path, layout)
    text = str(caught.value)
    assert text.startswith(str(path)), text
    assert "; expected " in text, text
    assert all(word in text for word in words), text


def accepted(tmp_path, messages, topics, **given):
    path = write_bag(tmp_path / "bag", "mcap", messages)
    joints = ["wheel_left", "wheel_right"]
    layout = declared_bag_layout({"joints": joints, "topics": topics, **given}, "layout")
    (run,) = runs_of(path, layout)
    return run


# topics and their types


def test_a_missing_topic_is_answered_with_near_names_and_fitting_topics(tmp_path):
    messages = in_order(wheels(), imu(), wheels(topic="/arm/states"))
    topics = {"wheel_angle": {"topic": "/joint_state"}}
    words = ("no topic '/joint_state' for wheel_angle", "did you mean /joint_states")
    refused(
        tmp_path, messages, topics, *words, "one of /arm/states, /joint_states, which have such"
    )


def test_where_no_topic_fits_all_are_listed(tmp_path):
    refused(tmp_path, imu(), {"pose": {"topic": "/odom"}}, "no topic '/odom'", "one of /imu")


def test_an_empty_topic(tmp_path):
    topics = {"gyro": {"topic": "/imu"}}
    words = ("topic '/imu'", "no message", "topic of gyro", "was its driver on?")
    refused(tmp_path, wheels(), topics, *words, empty={"/imu": IMU})


def test_a_topic_with_messages_of_two_types(tmp_path):
    from tests.helpers.made_bags import message, types_of, writer_of

    store = types_of("rosbag1")
    with writer_of(tmp_path / "bag.bag", "rosbag1") as writer:
        for k, name in enumerate((IMU, POSE)):
            connection = writer.add_connection("/both", name, typestore=store)
            writer.write(connection, k + 1, store.serialize_ros1(message(store, name, {}), name))
    layout = declared_bag_layout({"topics": {"gyro": {"topic": "/both"}}}, "layout")
    with pytest.raises(DataError, match=f"several types \\({IMU} and {POSE}\\)"):
        runs_of(tmp_path / "bag.bag", layout)


@pytest.mark.parametrize(
    ("channel", "spec", "words"),
    [
        (
            "gyro",
            {"topic": "/pose"},
            (POSE, "field for gyro is not known", "sensor_msgs/Imu"),
        ),
        (
            "pose",
            {"topic": "/imu"},
            ("no pose of type", "TransformStamped", "that contains it"),
        ),
        ("twist_command", {"topic": "/pose"}, ("no twist_command", "geometry_msgs/Twist")),
        ("bus_voltage", {"topic": "/imu"}, ("BatteryState", "field = one of its numbers")),
        (
            "gyro",
            {"topic": "/imu", "field": "angular_velocty.z"},
            ("no field 'angular_velocty.z'", "did you mean angular_velocity.z"),
        ),
        (
            "gyro",
            {"topic": "/imu", "field": "header.frame_id", "unit": "rad/s"},
            ("is a string", "a field with numbers"),
        ),
        (
            "gyro",
            {"topic": "/imu", "field": "linear_acceleration.z"},
            ("gyro without a unit", 'such as "rad/s"'),
        ),
        (
            "gyro",
            {"topic": "/imu", "field": "angular_velocity.z[2]"},
            ("no numbers in angular_velocity.z[2]", "requested index"),
        ),
        (
            "gyro",
            {"topic": "/imu", "field": "orientation_covariance"},
            ("gyro without a unit",),
        ),
        (
            "gyro",
            {"topic": "/imu", "field": "orientation_covariance", "unit": "rad/s"},
            ("9 numbers for gyro", "by its index"),
        ),
        (
            "wheel_speed",
            {"topic": "/joint_states", "field": "position"},
            ("'rad' cannot be converted to rad/s", "are possible for", "wheel_angle"),
        ),
        (
            "wheel_speed",
            {"topic": "/joint_states", "field": "speed"},
            ("no array 'speed'", "one of position, velocity, effort"),
        ),
        (
            "wheel_angle",
            {"topic": "/joint_states", "scale": [1.0, 1.0, -1.0]},
            ("2 columns, but 3 scales",),
        ),
        (
            "pose",
            {"topic": "/imu", "frame": "map", "child": "base"},
            ("with frame and child", "TFMessage"),
        ),
    ],
)
def test_types_and_fields_that_do_not_fit(tmp_path, channel, spec, words):
    messages = in_order(wheels(), imu(), poses())
    refused(tmp_path, messages, {channel: spec}, *words)


def test_odometry_is_no_command(tmp_path):
    name = "nav_msgs/msg/Odometry"
    messages = [Message("/odom", name, pose_fields(name, t, 0, 0, 0), t) for t in TIME.tolist()]
    words = ("the measured twist", "the commanded twist")
    refused(tmp_path, messages, {"twist_command": {"topic": "/odom"}}, *words)


# joints


def test_wrong_joint_names(tmp_path):
    topics = {"wheel_angle": {"topic": "/joint_states"}}
    words = (
        "no joint 'wheel_lft'",
        "did you mean wheel_left",
        "in the messages: wheel_left, wheel_right",
    )
    refused(tmp_path, wheels(), topics, *words, joints=("wheel_lft", "wheel_right"))


def test_no_joint_names(tmp_path):
    topics = {"wheel_angle": {"topic": "/joint_states"}}
    words = (
        "no joints are named",
        "order of the drives",
        "the messages have: wheel_left, wheel_right",
    )
    refused(tmp_path, wheels(), topics, *words, joints=())


def test_effort_without_a_meaning(tmp_path):
    choices = ('"A" (current)', '"N*m" (motor_torque', '"V" (voltage)', '"1" (duty)')
    topics = {"current": {"topic": "/joint_states"}}
    refused(tmp_path, wheels(), topics, "effort without a unit", *choices)
    table = {"topics": {"voltage": {"topic": "/joint_states", "field": "effort"}}}
    with pytest.raises(DataError) as caught:
        declared_bag_layout(table, "layout")
    assert all(choice in str(caught.value) for choice in choices)


def test_an_array_of_joints_that_is_left_empty(tmp_path):
    topics = {"wheel_speed": {"topic": "/joint_states"}}
    words = ("velocity of joint 'wheel_left' is empty", "another field meant")
    refused(tmp_path, wheels(position=ANGLE), topics, *words)


def test_channels_that_disagree_on_the_number_of_wheels(tmp_path):
    messages = in_order(
        wheels(),
        [
            Message("/amps", "std_msgs/msg/Float32MultiArray", {"data": [1.0, 2.0, 3.0]}, t)
            for t in TIME.tolist()
        ],
    )
    topics = {
        "wheel_angle": {"topic": "/joint_states"},
        "current": {"topic": "/amps", "unit": "A"},
    }
    refused(
        tmp_path, messages, topics, "2 in wheel_angle, 3 in current", "by index", stamp="received"
    )


def test_an_array_that_changes_its_length(tmp_path):
    messages = [
        Message("/amps", "std_msgs/msg/Float32MultiArray", {"data": [1.0] * (2 + (k == 17))}, t)
        for k, t in enumerate(TIME.tolist())
    ]
    topics = {"current": {"topic": "/amps", "unit": "A"}}
    refused(tmp_path, messages, topics, "message 18", "3 numbers, but 2 in earlier messages")


# numbers


def test_poses_without_numbers(tmp_path):
    x = TIME - START
    x[40:60] = np.nan
    topics = {"pose": {"topic": "/pose"}}
    words = ("message 41", "pose.position.x is nan", "20 such values among 200", "drop_nan = true")
    refused(tmp_path, poses(x=x), topics, *words)
    run = accepted(tmp_path / "kept", poses(x=x), topics, drop_nan=True)
    assert len(run.signals["pose_x"].time) == 180
    assert "20 messages without a number" in run.notes[0]


def test_all_poses_without_numbers(tmp_path):
    topics = {"pose": {"topic": "/pose"}}
    words = ("200 such values among 200", "does the driver fill")
    refused(tmp_path, poses(x=np.full(len(TIME), np.nan)), topics, *words, drop_nan=True)


def test_a_quaternion_that_is_not_filled_in(tmp_path):
    messages = [
        Message("/pose", POSE, {"header": header(t), "pose": {"position": vector(t)}}, t)
        for t in TIME.tolist()
    ]
    refused(
        tmp_path, messages, {"pose": {"topic": "/pose"}}, "quaternion of length 0", "filled in?"
    )


# clocks


def test_stamps_that_are_all_zero(tmp_path):
    messages = imu(stamps=np.zeros(len(TIME)))
    topics = {"gyro": {"topic": "/imu"}}
    words = ("topic '/imu'", "every time stamp is zero", 'stamp = "received"')
    refused(tmp_path, messages, topics, *words)
    run = accepted(tmp_path / "kept", messages, topics, stamp="received")
    np.testing.assert_allclose(run.signals["gyro"].time, TIME, rtol=0, atol=1e-6)


def test_one_stamp_that_is_zero(tmp_path):
    stamps = TIME.copy()
    stamps[30] = 0.0
    topics = {"gyro": {"topic": "/imu"}}
    refused(tmp_path, imu(stamps=stamps), topics, "message 31", "stamp is zero")


def test_a_clock_that_jumps_back(tmp_path):
    stamps = TIME.copy()
    stamps[100:] -= 0.5
    topics = {"gyro": {"topic": "/imu"}}
    words = ("message 101", "jumps back by 0.49 s", "max_disorder = 0.1", 'stamp = "received"')
    refused(tmp_path, imu(stamps=stamps), topics, *words)


def test_messages_slightly_out_of_order_are_sorted_with_a_note(tmp_path):
    stamps = TIME.copy()
    stamps[[50, 51]] = stamps[[51, 50]]
    run = accepted(tmp_path, imu(stamps=stamps), {"gyro": {"topic": "/imu"}})
    np.testing.assert_allclose(run.signals["gyro"].time, TIME, rtol=0, atol=1e-6)
    assert run.signals["gyro"].source.lines[[50, 51]].tolist() == [52, 51]
    assert run.notes == ("topic /imu: 1 messages out of order by up to 0.01 s were sorted",)


def test_of_messages_with_one_stamp_the_last_stands(tmp_path):
    stamps = TIME.copy()
    stamps[50] = stamps[49]
    run = accepted(tmp_path, imu(stamps=stamps), {"gyro": {"topic": "/imu"}})
    assert run.signals["gyro"].source.lines[48:51].tolist() == [49, 51, 52]
    assert "1 messages with the same stamp as another were left out" in run.notes[0]


@pytest.mark.parametrize(("apart", "notes"), [(0.2, 0), (3.0, 1)])
def test_two_clocks_are_compared(tmp_path, apart, notes):
    messages = in_order(imu(stamps=TIME - apart), commands())
    topics = {"gyro": {"topic": "/imu"}, "twist_command": {"topic": "/cmd_vel"}}
    run = accepted(tmp_path, messages, topics)
    assert len(run.notes) == notes
    assert all("/imu differ by 3 s" in note and "/cmd_vel" in note for note in run.notes)


def test_two_clocks_that_have_nothing_in_common(tmp_path):
    messages = in_order(imu(stamps=TIME - START + 1.0), commands())
    topics = {"gyro": {"topic": "/imu"}, "twist_command": {"topic": "/cmd_vel"}}
    refused(tmp_path, messages, topics, "stamps of /imu differ by 1.7e+09 s", "one clock for all")


# definitions


def test_a_definition_that_is_nowhere(tmp_path):
    text = {"my_msgs/msg/Amps": "my_msgs/Inner inner\n", "my_msgs/msg/Inner": "float32 x\n"}
    messages = [
        Message("/amps", "my_msgs/msg/Amps", {"inner": {"x": 1.0}}, t) for t in TIME.tolist()
    ]
    path = without_definitions(write_bag(tmp_path / "bag", "sqlite3", messages, text))
    topics = {"current": {"topic": "/amps", "field": "inner.x", "unit": "A"}}
    with pytest.raises(
        DataError, match=r"no definition of my_msgs/msg/Amps in the bag; .*definitions = "
    ):
        runs_of(path, declared_bag_layout({"topics": topics}, "layout"))
    (tmp_path / "Amps.msg").write_text("my_msgs/Inner inner\n")
    given = {"topics": topics, "definitions": str(tmp_path)}
    with pytest.raises(DataError, match=r"Inner, which my_msgs/msg/Amps contains.* no Inner.msg"):
        runs_of(path, declared_bag_layout(given, "layout"))
    (tmp_path / "Inner.msg").write_text("float64 x\n")
    with pytest.raises(
        DataError, match=r"topic '/amps' message 1: the message is no my_msgs/msg/Amps"
    ):
        runs_of(path, declared_bag_layout(given, "layout"))
    (tmp_path / "Inner.msg").write_text("float32 ; x\n")
    with pytest.raises(
        DataError, match=r"Inner.msg: cannot be read .*the definition of my_msgs/msg/Inner"
    ):
        runs_of(path, declared_bag_layout(given, "layout"))
