"""Custom message types are read by the paths of their fields."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.made_bags import (
    STORAGES,
    Message,
    header,
    joint_states,
    turned,
    vector,
    without_definitions,
)
from tests.helpers.one_bag import ANGLE, RESOLUTION, TIME, bag, read

CUSTOM = {
    "my_msgs/msg/Motor": "string name\nfloat32 current\nint16 duty\n",
    "my_msgs/msg/State": (
        "std_msgs/Header header\nbool on\nfloat64[3] spare\nmy_msgs/Motor[] motors\n"
        "float32[] volts\nint64 ticks\n"
    ),
}


def states(time):
    return [
        Message(
            "/state",
            "my_msgs/msg/State",
            {
                "header": header(t, f"frame{k % 3}"),
                "on": True,
                "motors": [
                    {"name": "a" * (k % 5), "current": k + 0.5, "duty": -k},
                    {"name": "b", "current": -k, "duty": 2 * k},
                ],
                "volts": [1.0 * k] * 2,
                "ticks": -5 * k,
            },
            t,
        )
        for k, t in enumerate(time.tolist())
    ]


@pytest.mark.parametrize("storage", STORAGES)
def test_custom_messages(tmp_path, storage):
    path = bag(tmp_path, storage, states(TIME), definitions=CUSTOM)
    topics = {
        "current": {"topic": "/state", "field": "motors.current", "unit": "mA"},
        "duty": {
            "topic": "/state",
            "field": ["motors[1].duty", "motors[0].duty"],
            "unit": "%",
            "scale": [1.0, -1.0],
        },
        "voltage": {"topic": "/state", "field": "volts", "unit": "V"},
        "bus_voltage": {"topic": "/state", "field": "volts[1]", "unit": "V", "offset": 1.0},
    }
    run = read(path, topics=topics)
    k = np.arange(len(TIME))
    values = {name: signal.values for name, signal in run.signals.items()}
    np.testing.assert_allclose(values["current"], np.column_stack([k + 0.5, -k]) * 1e-3)
    np.testing.assert_allclose(values["duty"], np.column_stack([2 * k, k]) / 100)
    np.testing.assert_allclose(values["voltage"], np.column_stack([k, k]))
    np.testing.assert_allclose(values["bus_voltage"][:, 0], k + 1.0)
    assert run.signals["duty"].source.columns == ("motors[1].duty", "motors[0].duty")


@pytest.mark.parametrize("package", ["my_msgs/msg", "."])
def test_definitions_in_a_folder(tmp_path, package):
    path = without_definitions(bag(tmp_path, "sqlite3", states(TIME), definitions=CUSTOM))
    folder = tmp_path / "definitions" / package
    folder.mkdir(parents=True)
    for name, text in CUSTOM.items():
        (folder / f"{name.split('/')[-1]}.msg").write_text(text)
    topics = {"bus_voltage": {"topic": "/state", "field": "volts[1]", "unit": "V"}}
    run = read(path, topics=topics, definitions=str(tmp_path / "definitions"))
    k = np.arange(len(TIME))
    np.testing.assert_allclose(run.signals["bus_voltage"].values[:, 0], k)


def test_plain_arrays_and_numbers(tmp_path):
    arrays = [
        Message("/amps", "std_msgs/msg/Float64MultiArray", {"data": [k, -k]}, t)
        for k, t in enumerate(TIME.tolist())
    ]
    one = [
        Message("/volts", "std_msgs/msg/Int32", {"data": 100 * k}, t)
        for k, t in enumerate(TIME.tolist())
    ]
    topics = {
        "current": {"topic": "/amps", "unit": "A"},
        "bus_voltage": {"topic": "/volts", "unit": "mV"},
    }
    run = read(bag(tmp_path, "mcap", arrays, one), topics=topics)
    k = np.arange(len(TIME))
    np.testing.assert_array_equal(run.signals["current"].values, np.column_stack([k, -k]))
    np.testing.assert_allclose(run.signals["bus_voltage"].values[:, 0], 0.1 * k)


def test_counters_of_several_topics_are_continued_before_they_are_joined(tmp_path):
    counts = [np.round(900.0 * sign * (TIME - TIME[0])) * 30.0 for sign in (1.0, -1.0)]
    shown = [(count + 2**15) % 2**16 - 2**15 for count in counts]
    messages = [
        [
            Message(topic, "std_msgs/msg/Int16", {"data": int(ticks)}, t + late)
            for ticks, t in zip(column, TIME.tolist(), strict=True)
        ]
        for topic, column, late in (("/left", shown[0], 0.0), ("/right", shown[1], 0.004))
    ]
    topics = {"wheel_ticks": {"topics": ["/left", "/right"], "unit": "tick", "scale": [1.0, -1.0]}}
    path = bag(tmp_path, "mcap", *messages)
    run = read(path, topics=topics, ticks_per_revolution=1000.0, tick_bits=16)
    ticks = run.signals["wheel_ticks"].values
    np.testing.assert_array_equal(ticks[:, 0], counts[0][1:])
    right = np.interp(TIME[1:], TIME + 0.004, -counts[1])
    np.testing.assert_allclose(ticks[:, 1], right, atol=0.01)
    assert "the wrap-around of the tick counter at 16 bits was removed" in run.notes
    assert any("/right were sampled at other times than /left" in note for note in run.notes)


def test_a_pose_inside_a_message_of_ones_own(tmp_path):
    text = {"my_msgs/msg/Seen": "std_msgs/Header header\ngeometry_msgs/Pose robot\nfloat32 x\n"}
    messages = [
        Message(
            "/seen",
            "my_msgs/msg/Seen",
            {
                "header": header(t),
                "robot": {"position": vector(t - TIME[0]), "orientation": turned(0.5)},
            },
            t,
        )
        for t in TIME.tolist()
    ]
    path = bag(tmp_path, "mcap", messages, definitions=text)
    run = read(path, topics={"pose": {"topic": "/seen", "field": "robot"}})
    np.testing.assert_allclose(run.signals["pose_x"].values[:, 0], TIME - TIME[0], atol=1e-6)
    np.testing.assert_allclose(run.signals["pose_heading"].values, 0.5)


def test_standard_types_need_no_definition_in_the_bag(tmp_path):
    messages = joint_states("/joint_states", TIME, ["left", "right"], position=ANGLE)
    path = without_definitions(bag(tmp_path, "sqlite3", messages))
    run = read(path, topics={"wheel_angle": {"topic": "/joint_states"}})
    np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE)


@pytest.mark.slow
def test_messages_with_ever_new_texts_are_read_too(tmp_path):
    messages = [
        Message(
            "/joint_states",
            "sensor_msgs/msg/JointState",
            {"header": header(t, f"frame{k:04d}"), "name": ["left"], "position": [1.0 * k]},
            t,
        )
        for k, t in enumerate(TIME.tolist())
    ]
    topics = {"wheel_angle": {"topic": "/joint_states"}}
    run = read(bag(tmp_path, "mcap", messages), joints=("left",), topics=topics)
    np.testing.assert_array_equal(run.signals["wheel_angle"].values[:, 0], np.arange(len(TIME)))


def test_a_topic_for_each_motor(tmp_path):
    straight = TIME - TIME[0]
    messages = [
        Message(f"/amps{j}", "std_msgs/msg/Float64", {"data": j + k * float(s)}, float(TIME[0] + s))
        for j, (k, times) in enumerate([(1.0, straight[::2]), (-3.0, straight)])
        for s in times
    ]
    topics = {"current": {"topic": ["/amps0", "/amps1"], "unit": "A"}}
    signal = read(bag(tmp_path, "mcap", messages), topics=topics).signals["current"]
    s = straight[::2]
    np.testing.assert_allclose(signal.time, TIME[0] + s, rtol=0, atol=RESOLUTION)
    np.testing.assert_allclose(signal.values, np.column_stack([s, 1.0 - 3.0 * s]), atol=1e-6)
    assert signal.source.topic == "/amps0, /amps1"
