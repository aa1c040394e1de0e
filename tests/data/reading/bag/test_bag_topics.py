"""Topics of a bag are listed with their fields, joints, frames and channels."""

from __future__ import annotations

import numpy as np
import pytest

from slipid.data.reading.bag.topics import topics_of
from tests.helpers.made_bags import (
    ROBOTINO,
    STORAGES,
    SUFFIX,
    Message,
    in_order,
    joint_states,
    transform,
    vector,
    without_definitions,
    write_bag,
)

TIME = 1.7e9 + np.arange(0.0, 40.0, 0.1)
ANGLE = np.zeros((len(TIME), 2))


@pytest.fixture
def messages():
    motors = [
        Message(
            "/motors",
            "robotino_msgs/msg/MotorReadings",
            {"stamp": t, "velocities": [1, 2, 3], "positions": [4, 5, 6], "currents": [7, 8, 9]},
            t,
        )
        for t in TIME[100:200].tolist()
    ]
    tf = [
        Message(
            "/tf",
            "tf2_msgs/msg/TFMessage",
            {"transforms": [transform(t, "map", "base", 0, 0, 0)]},
            t,
        )
        for t in TIME.tolist()
    ]
    commands = [Message("/cmd", "geometry_msgs/msg/Twist", {"linear": vector(1)}, TIME[0] + 2.0)]
    states = joint_states("/joint_states", TIME, ["l", "r"], position=ANGLE, velocity=ANGLE)
    return in_order(states, motors, tf, commands)


@pytest.mark.parametrize("storage", STORAGES)
def test_topics_are_described(tmp_path, storage, messages):
    empty = {"/imu": "sensor_msgs/msg/Imu"} if storage != "rosbag1" else {}
    path = write_bag(tmp_path / f"bag{SUFFIX[storage]}", storage, messages, ROBOTINO, empty)
    topics = {topic.name: topic for topic in topics_of(path)}
    assert topics.keys() == {"/cmd", "/joint_states", "/motors", "/tf", *empty}
    joints = topics["/joint_states"]
    assert (joints.type, joints.count) == ("sensor_msgs/msg/JointState", len(TIME))
    assert joints.joints == ("l", "r")
    assert joints.serves == ("wheel_angle", "wheel_speed")
    fields = {field.path: (field.type, field.count) for field in joints.fields}
    assert fields["position"] == ("float64[]", 2)
    assert fields["effort"] == ("float64[]", 0)
    assert fields["name"] == ("text[]", 2)
    motors = topics["/motors"]
    assert motors.serves == ("wheel_ticks", "motor_speed", "current")
    assert motors.count == 100
    assert motors.rate == pytest.approx(10.0, rel=1e-3)
    assert topics["/tf"].frames == ("map -> base",)
    assert topics["/tf"].serves == ("pose",)
    assert topics["/cmd"].serves == ("twist_command",)
    assert topics["/cmd"].rate is None
    for name in empty:
        assert (topics[name].count, topics[name].rate, topics[name].fields) == (0, None, ())


def test_a_type_that_is_defined_nowhere_is_a_problem_of_its_topic_alone(tmp_path, messages):
    path = without_definitions(write_bag(tmp_path / "bag", "sqlite3", messages, ROBOTINO))
    topics = {topic.name: topic for topic in topics_of(path)}
    assert topics["/joint_states"].joints == ("l", "r")
    assert topics["/motors"].count == 100
    assert "no definition of robotino_msgs/msg/MotorReadings" in str(topics["/motors"].problem)
