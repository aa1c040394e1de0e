"""A config proposed from bags: topics, joints in the order of the wheels, open questions."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from slipid.app.new.config_text import new_config
from slipid.app.new.propose import propose
from slipid.data.reading.bag.layout import declared_bag_layout
from tests.helpers.made_bags import (
    ROBOTINO,
    Message,
    in_order,
    joint_states,
    pose_fields,
    transform,
    vector,
    write_bag,
)
from tests.helpers.one_bag import runs_of

TIME = 1.7e9 + np.arange(0.0, 10.0, 0.02)
JOINTS = ["rear_left_wheel_joint", "front_left_wheel_joint", "front_right_wheel_joint"]
JOINTS += ["rear_right_wheel_joint"]
POSE = "geometry_msgs/msg/PoseStamped"


def messages(pose: str = POSE, effort: bool = False, more: tuple[str, ...] = ()):
    angle = np.outer(TIME - TIME[0], np.arange(1, len(JOINTS) + len(more) + 1))
    arrays = {"position": angle, "velocity": angle} | ({"effort": angle} if effort else {})
    states = joint_states("/joint_states", TIME, [*JOINTS, *more], **arrays)
    poses = [
        Message(
            "/where",
            pose,
            pose_fields(pose, float(t), 0.1 * float(t - TIME[0]), 0.0, 0.0),
            float(t),
        )
        for t in TIME[::5]
    ]
    twist = [
        Message("/cmd_vel", "geometry_msgs/msg/Twist", {"linear": vector(1)}, t)
        for t in TIME[::10].tolist()
    ]
    return in_order(states, poses, twist)


def proposed(path: Path, **told: str):
    return new_config(propose(path, told), "mine.toml")


SKID = {
    "drive": "skid",
    "wheelbase_m": "0.5",
    "track_m": "0.5",
    "shared": "no",
    "wheel_radius_m": "0.1",
    "gear_ratio": "1",
    "mass_kg": "30",
}


def test_joints_stand_in_the_order_of_the_wheels_and_the_bag_reads(tmp_path):
    bag = write_bag(tmp_path / "run1", "mcap", messages())
    config = proposed(tmp_path, **SKID)
    there = tomllib.loads(config.text)
    layout = there["layouts"]["mine"]
    order = ("front_left", "front_right", "rear_left", "rear_right")
    assert layout["joints"] == [f"{where}_wheel_joint" for where in order]
    assert there["logs"][0]["glob"] == "run1/metadata.yaml"
    assert [q.partition(":")[0] for q in config.questions] == ["surface"]
    (run,) = runs_of(bag, declared_bag_layout(layout, "mine"))
    assert set(run.signals) >= {"wheel_angle", "wheel_speed", "pose_x", "twist_command_x"}
    ends = run.signals["wheel_angle"].values[-1] / run.signals["wheel_angle"].values[-1, 2]
    np.testing.assert_allclose(ends, [2, 3, 1, 4])


def test_effort_odometry_and_other_joints_raise_questions(tmp_path):
    path = tmp_path / "run.bag"
    write_bag(path, "rosbag1", messages("nav_msgs/msg/Odometry", effort=True, more=("arm",)))
    config = proposed(path, **SKID)
    said = "\n".join(config.questions)
    assert "what is the effort: a current (A)" in said
    assert "Odometry of wheels is of no use" in said
    assert "are these joints no wheels: arm" in said
    assert "current" not in tomllib.loads(config.text)["layouts"]["mine"]["topics"]


def test_motor_readings_have_ticks_and_currents(tmp_path):
    fields = {"velocities": [1, 2, 3], "positions": [4, 5, 6], "currents": [0.1, 0.2, 0.3]}
    kind = "robotino_msgs/msg/MotorReadings"
    said = [Message("/motors", kind, {"stamp": float(t), **fields}, float(t)) for t in TIME]
    write_bag(tmp_path / "run1", "mcap", said, ROBOTINO)
    config = proposed(tmp_path)
    there = tomllib.loads(config.text)
    assert there["robot"]["drive"] == "omni"
    assert set(there["layouts"]["mine"]["topics"]) == {"wheel_ticks", "motor_speed", "current"}
    said = "\n".join(config.questions)
    assert "ticks_per_revolution: how many, of the motor shaft" in said
    assert "no topic with a pose was found" in said


def test_frames_of_transforms_raise_a_question(tmp_path):
    tf = [
        Message(
            "/tf",
            "tf2_msgs/msg/TFMessage",
            {"transforms": [transform(t, "map", "base", 0, 0, 0)]},
            t,
        )
        for t in TIME[::5].tolist()
    ]
    others = [one for one in messages() if one.topic != "/where"]
    write_bag(tmp_path / "run1", "sqlite3", in_order(others, tf))
    config = proposed(tmp_path, **SKID)
    assert any("which frame and which child? There are: map -> base" in q for q in config.questions)
    pose = tomllib.loads(config.text)["layouts"]["mine"]["topics"]["pose"]
    assert pose == {"topic": "/tf", "frame": "map", "child": "base"}


@pytest.mark.parametrize("count", [1, 2])
def test_several_bags_have_one_glob(tmp_path, count):
    for k in range(count):
        write_bag(tmp_path / f"run{k}.bag", "rosbag1", messages())
    glob = tomllib.loads(proposed(tmp_path, **SKID).text)["logs"][0]["glob"]
    assert glob == ("run0.bag" if count == 1 else "run*.bag")


MOTOR_STATE = {"base_msgs/msg/MotorState": "float32[] currents # A\nfloat32[] voltages # V\n"}


def _drive_with_pauses(fields_per_wheel: int = 4):
    """Three drives of two seconds, two seconds apart, and the currents of every motor."""
    moving = (TIME - TIME[0]) % 4.0 < 2.0
    angle = np.cumsum(moving * 0.02)[:, None] * np.ones(len(JOINTS))
    states = joint_states("/joint_states", TIME, JOINTS, position=angle)
    pose = [
        Message("/where", POSE, pose_fields(POSE, float(t), 0.1 * float(x), 0.0, 0.0), float(t))
        for t, x in zip(TIME, angle[:, 0], strict=True)
    ]
    many = {"currents": [0.5] * fields_per_wheel, "voltages": [6.0] * fields_per_wheel}
    motors = [Message("/motors", "base_msgs/msg/MotorState", many, float(t)) for t in TIME]
    return in_order(states, pose, motors)


def test_currents_in_messages_of_an_unknown_type_are_proposed_with_a_question(tmp_path):
    bag = write_bag(tmp_path / "run1", "mcap", _drive_with_pauses(), MOTOR_STATE)
    config = proposed(tmp_path, **SKID)
    layout = tomllib.loads(config.text)["layouts"]["mine"]
    assert layout["topics"]["current"] == {"topic": "/motors", "field": "currents", "unit": "A"}
    said = [q for q in config.questions if q.startswith(("current:", "voltage:"))]
    assert len(said) == 2
    assert all("from the name of the field" in q for q in said)
    assert "motor.resistance" in tomllib.loads(config.text)["parameters"]
    read = runs_of(bag, declared_bag_layout(layout, "mine"))
    np.testing.assert_allclose(read[0].signals["voltage"].values, 6.0)


def test_fields_for_another_number_of_wheels_are_not_proposed(tmp_path):
    write_bag(tmp_path / "run1", "mcap", _drive_with_pauses(2), MOTOR_STATE)
    topics = tomllib.loads(proposed(tmp_path, **SKID).text)["layouts"]["mine"]["topics"]
    assert not {"current", "voltage"} & topics.keys()


def test_a_long_drive_with_pauses_is_cut_at_them_in_one_session(tmp_path):
    bag = write_bag(tmp_path / "run1", "mcap", _drive_with_pauses(), MOTOR_STATE)
    there = tomllib.loads(proposed(tmp_path, **SKID).text)
    layout = there["layouts"]["mine"]
    assert layout["runs"] == {"pause_s": 1}
    assert there["logs"][0]["session"] == "file"
    assert len(runs_of(bag, declared_bag_layout(layout, "mine"))) == 3


def test_wheels_with_topics_of_their_own_are_known_by_the_topics_names(tmp_path):
    ticks = np.round(2000.0 * (TIME - TIME[0])) * 10.0
    shown = (ticks + 2**15) % 2**16 - 2**15
    wheels = [
        [
            Message(topic, "std_msgs/msg/Int16", {"data": int(n)}, t)
            for n, t in zip(shown, TIME.tolist(), strict=True)
        ]
        for topic in ("/right_ticks", "/left_ticks", "/left_battery")
    ]
    poses = [one for one in messages() if one.topic == "/where"]
    path = write_bag(tmp_path / "bag", "mcap", in_order(*wheels, poses))
    draft = propose(path, {"drive": "differential", "ticks_per_revolution": "4000"})
    layout = tomllib.loads(new_config(draft, "mine.toml").text)["layouts"]["mine"]
    assert layout["topics"]["wheel_ticks"]["topics"] == ["/left_ticks", "/right_ticks"]
    assert layout["tick_bits"] == 16
    assert any("/left_ticks, /right_ticks (std_msgs/msg/Int16)" in s for s in draft.sentences)
    (run,) = runs_of(path, declared_bag_layout(layout, "layout"))
    turned = run.signals["wheel_ticks"].values
    np.testing.assert_array_equal(turned - turned[0], np.column_stack([ticks, ticks]))
