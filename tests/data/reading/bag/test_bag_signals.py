"""Signals written as messages come back from each storage as they were."""

from __future__ import annotations

from math import tau

import numpy as np
import pytest

from slipid.data.reading.bag.layout import declared_bag_layout
from slipid.data.reading.reader import read_logs
from tests.helpers.made_bags import (
    ROBOTINO,
    STORAGES,
    Message,
    header,
    joint_states,
    pose_fields,
    vector,
    write_bag,
)
from tests.helpers.one_bag import ANGLE, RESOLUTION, TIME, bag, read


@pytest.mark.parametrize("storage", STORAGES)
def test_joint_states_come_back(tmp_path, storage):
    messages = joint_states(
        "/joint_states", TIME, ["left", "right"], position=ANGLE, velocity=-ANGLE, effort=ANGLE / 7
    )
    topics = {
        "wheel_angle": {"topic": "/joint_states"},
        "motor_speed": {"topic": "/joint_states", "scale": [1.0, -1.0]},
        "current": {"topic": "/joint_states", "field": "effort", "unit": "mA"},
    }
    run = read(bag(tmp_path, storage, messages), topics=topics)
    assert run.identity.name == ""
    assert run.notes == ()
    for name, values in (
        ("wheel_angle", ANGLE),
        ("motor_speed", -ANGLE * [1.0, -1.0]),
        ("current", ANGLE / 7e3),
    ):
        signal = run.signals[name]
        np.testing.assert_allclose(signal.time, TIME, rtol=0, atol=RESOLUTION)
        np.testing.assert_allclose(signal.values, values, rtol=1e-14)
        assert signal.source.columns == ("left", "right")
        assert signal.source.topic == "/joint_states"
        np.testing.assert_array_equal(signal.source.lines, 1 + np.arange(len(TIME)))


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize(
    "name",
    [
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/TransformStamped",
        "nav_msgs/msg/Odometry",
    ],
)
def test_poses_come_back(tmp_path, storage, name):
    heading = np.linspace(2.0, 9.0, len(TIME))  # beyond the half turn
    messages = [
        Message("/pose", name, pose_fields(name, t, x, -x, h), t + 0.01)
        for t, x, h in zip(TIME.tolist(), ANGLE[:, 0].tolist(), heading.tolist(), strict=True)
    ]
    run = read(bag(tmp_path, storage, messages), topics={"pose": {"topic": "/pose"}})
    assert list(run.signals) == ["pose_x", "pose_y", "pose_heading"]
    x, y, turn = (signal.values[:, 0] for signal in run.signals.values())
    np.testing.assert_allclose(x, ANGLE[:, 0], atol=1e-12)
    np.testing.assert_allclose(y, -ANGLE[:, 0], atol=1e-12)
    np.testing.assert_allclose(turn, heading, atol=1e-12)


@pytest.mark.parametrize("storage", STORAGES)
def test_other_sensors_come_back_at_their_own_times(tmp_path, storage):
    slow, fast = TIME[::10], TIME[::2]
    imu = [
        Message("/imu", "sensor_msgs/msg/Imu", imu_fields(t, k), t)
        for k, t in enumerate(fast.tolist())
    ]
    battery = [
        Message(
            "/battery", "sensor_msgs/msg/BatteryState", {"header": header(t), "voltage": 12.5}, t
        )
        for t in slow.tolist()
    ]
    plain = [
        Message(
            "/cmd", "geometry_msgs/msg/Twist", {"linear": vector(1, 2), "angular": vector(z=3)}, t
        )
        for t in slow.tolist()
    ]
    motors = [
        Message("/motors", "robotino_msgs/msg/MotorReadings", readings(t, k), t + 0.5)
        for k, t in enumerate(slow.tolist())
    ]
    topics = {
        "gyro": {"topic": "/imu", "scale": -1.0},
        "bus_voltage": {"topic": "/battery"},
        "twist_command": {"topic": "/cmd"},
        "motor_speed": {"topic": "/motors"},
        "wheel_ticks": {"topic": "/motors"},
        "current": {"topic": "/motors"},
    }
    path = bag(tmp_path, storage, imu, battery, plain, motors, definitions=ROBOTINO)
    run = read(path, topics=topics, ticks_per_revolution=2000)
    have = {name: (s.time, s.values) for name, s in run.signals.items()}
    np.testing.assert_allclose(have["gyro"][0], fast, rtol=0, atol=RESOLUTION)
    np.testing.assert_allclose(have["gyro"][1][:, 0], -np.arange(len(fast)))
    np.testing.assert_allclose(have["bus_voltage"][1], np.full((len(slow), 1), 12.5))
    for axis, value in (("x", 1.0), ("y", 2.0), ("yaw", 3.0)):
        time, values = have[f"twist_command_{axis}"]
        np.testing.assert_allclose(time, slow, rtol=0, atol=RESOLUTION)
        np.testing.assert_array_equal(values, np.full((len(slow), 1), value))
    np.testing.assert_allclose(have["motor_speed"][0], slow, rtol=0, atol=RESOLUTION)
    np.testing.assert_allclose(have["motor_speed"][1][0], np.array([60, 30, -60]) * tau / 60)
    np.testing.assert_array_equal(have["wheel_ticks"][1][-1], np.array([1, 2, 3]) * (len(slow) - 1))
    np.testing.assert_array_equal(have["current"][1][5], [0.5, 1.5, 2.5])


def test_the_twist_of_odometry_is_a_motion_of_its_own(tmp_path):
    """It needs no field and no unit, and stands for the travel of a robot without wheels."""
    twist = {"linear": vector(0.4), "angular": vector(z=-0.2)}
    messages = [
        Message(
            "/odom", "nav_msgs/msg/Odometry", {"header": header(t), "twist": {"twist": twist}}, t
        )
        for t in TIME.tolist()
    ]
    layout = declared_bag_layout({"topics": {"twist": {"topic": "/odom"}}}, "layout")
    path = bag(tmp_path, "mcap", messages)
    (log,) = read_logs(path, layout, path.parent, None, "as_built").logs
    assert log.wheels == 0
    seconds = TIME[-1] - TIME[0]
    np.testing.assert_allclose(log.travel[-1], [0.4 * seconds, 0.0, -0.2 * seconds], atol=1e-5)


def imu_fields(t, k):
    return {"header": header(t, "imu"), "angular_velocity": vector(7.0, 8.0, k)}


def readings(t, k):
    return {
        "stamp": t,
        "velocities": [60.0, 30.0, -60.0],
        "positions": [k, 2 * k, 3 * k],
        "currents": [0.5, 1.5, 2.5],
    }


@pytest.mark.parametrize(
    ("storage", "compression"),
    [
        *(("rosbag1", how) for how in ("LZ4", "BZ2")),
        *(("sqlite3", how) for how in ("MESSAGE", "FILE")),
        *(("mcap", how) for how in ("MESSAGE", "FILE", "STORAGE")),
    ],
)
def test_compressed_bags(tmp_path, storage, compression):
    messages = joint_states("/joint_states", TIME, ["left", "right"], position=ANGLE)
    path = bag(tmp_path, storage, messages, compression=compression)
    run = read(path, topics={"wheel_angle": {"topic": "/joint_states"}})
    np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE, rtol=1e-14)


def test_a_bag_is_named_by_its_file_its_folder_or_its_metadata(tmp_path):
    messages = joint_states("/joint_states", TIME, ["left", "right"], position=ANGLE)
    for storage, suffix in (("sqlite3", "db3"), ("mcap", "mcap")):
        folder = write_bag(tmp_path / storage, storage, messages)
        topics = {"wheel_angle": {"topic": "/joint_states"}}
        (file,) = folder.glob(f"*.{suffix}")
        runs = [read(path, topics=topics) for path in (folder, folder / "metadata.yaml", file)]
        for run in runs:
            np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE)
        assert runs[0].identity.sha256 == runs[1].identity.sha256 != runs[2].identity.sha256


def test_the_hash_is_what_sha256sum_prints(tmp_path):
    import hashlib

    messages = joint_states("/joint_states", TIME, ["left", "right"], position=ANGLE)
    topics = {"wheel_angle": {"topic": "/joint_states"}}
    file = write_bag(tmp_path / "bag.bag", "rosbag1", messages)
    assert (
        read(file, topics=topics).identity.sha256 == hashlib.sha256(file.read_bytes()).hexdigest()
    )
    folder = write_bag(tmp_path / "bag", "mcap", messages)
    files = sorted(folder.iterdir())
    lines = "".join(f"{hashlib.sha256(f.read_bytes()).hexdigest()}  {f.name}\n" for f in files)
    assert read(folder, topics=topics).identity.sha256 == hashlib.sha256(lines.encode()).hexdigest()


def test_a_big_endian_message(tmp_path):
    from slipid.data.reading.bag.definitions import TEXT, ArrayType, MessageType
    from slipid.data.reading.bag.shape import shape_of

    kind = MessageType("x/msg/Y", {"s": TEXT, "v": ArrayType("f8", None)})
    text = b"\0\0\0\x03ab\0\0"  # and one byte up to the next length
    raw = b"\0\0\0\0" + text + b"\0\0\0\x01" + b"\0\0\0\0" + np.array([2.5], ">f8").tobytes()
    shape = shape_of(raw, kind, cdr=True)
    assert shape.texts("s") == ("ab",)
    (place,) = shape.places("v")
    assert place.of(np.frombuffer(raw, np.uint8)[None])[0] == 2.5


def test_importing_slipid_reads_no_bags():
    import subprocess
    import sys

    code = (
        "import sys, slipid, slipid.data.reading.bag.topics, slipid.data.reading.bag.topics\n"
        "print([m for m in sys.modules if m.startswith(('rosbags', 'apsw', 'lz4'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
