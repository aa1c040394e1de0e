"""Signals written as messages come back from each storage as they were."""

from __future__ import annotations

from math import tau

import numpy as np
import pytest

from slipid.data.reading.bag.layout import declared_bag_layout
from slipid.data.reading.bag.reader import read_bag
from tests.helpers.made_bags import (
    ROBOTINO,
    STORAGES,
    SUFFIX,
    Said,
    header,
    in_order,
    joint_states,
    pose_fields,
    turned,
    vector,
    without_definitions,
    write_bag,
)

TIME = 1.7e9 + np.arange(0.0, 4.0, 0.01)
ANGLE = np.column_stack([3.0 * np.sin(TIME - TIME[0]), np.linspace(0.0, 9.0, len(TIME))])
RESOLUTION = 3e-7
"""Of a double that counts seconds from 1970."""


def layout(joints=("left", "right"), **given):
    return declared_bag_layout({"kind": "bag", "joints": list(joints), **given}, "layout")


def read(path, **given):
    (run,) = read_bag(path, layout(**given))
    return run


def bag(tmp_path, storage, *said, **options):
    return write_bag(tmp_path / f"bag{SUFFIX[storage]}", storage, in_order(*said), **options)


@pytest.mark.parametrize("storage", STORAGES)
def test_joint_states_come_back(tmp_path, storage):
    said = joint_states(
        "/joint_states", TIME, ["left", "right"], position=ANGLE, velocity=-ANGLE, effort=ANGLE / 7
    )
    topics = {
        "wheel_angle": {"topic": "/joint_states"},
        "motor_speed": {"topic": "/joint_states", "scale": [1.0, -1.0]},
        "current": {"topic": "/joint_states", "field": "effort", "unit": "mA"},
    }
    run = read(bag(tmp_path, storage, said), topics=topics)
    assert run.name_suffix == ""
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
    said = [
        Said("/pose", name, pose_fields(name, t, x, -x, h), t + 0.01)
        for t, x, h in zip(TIME.tolist(), ANGLE[:, 0].tolist(), heading.tolist(), strict=True)
    ]
    run = read(bag(tmp_path, storage, said), topics={"pose": {"topic": "/pose"}})
    assert list(run.signals) == ["pose_x", "pose_y", "pose_heading"]
    x, y, turn = (signal.values[:, 0] for signal in run.signals.values())
    np.testing.assert_allclose(x, ANGLE[:, 0], atol=1e-12)
    np.testing.assert_allclose(y, -ANGLE[:, 0], atol=1e-12)
    np.testing.assert_allclose(turn, heading, atol=1e-12)


@pytest.mark.parametrize("storage", STORAGES)
def test_other_sensors_come_back_at_their_own_times(tmp_path, storage):
    slow, fast = TIME[::10], TIME[::2]
    imu = [
        Said("/imu", "sensor_msgs/msg/Imu", imu_fields(t, k), t)
        for k, t in enumerate(fast.tolist())
    ]
    battery = [
        Said("/battery", "sensor_msgs/msg/BatteryState", {"header": header(t), "voltage": 12.5}, t)
        for t in slow.tolist()
    ]
    plain = [
        Said("/cmd", "geometry_msgs/msg/Twist", {"linear": vector(1, 2), "angular": vector(z=3)}, t)
        for t in slow.tolist()
    ]
    motors = [
        Said("/motors", "robotino_msgs/msg/MotorReadings", readings(t, k), t + 0.5)
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
    said = joint_states("/joint_states", TIME, ["left", "right"], position=ANGLE)
    path = bag(tmp_path, storage, said, compression=compression)
    run = read(path, topics={"wheel_angle": {"topic": "/joint_states"}})
    np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE, rtol=1e-14)


def test_a_bag_is_named_by_its_file_its_folder_or_its_metadata(tmp_path):
    said = joint_states("/joint_states", TIME, ["left", "right"], position=ANGLE)
    for storage, suffix in (("sqlite3", "db3"), ("mcap", "mcap")):
        folder = write_bag(tmp_path / storage, storage, said)
        topics = {"wheel_angle": {"topic": "/joint_states"}}
        (file,) = folder.glob(f"*.{suffix}")
        runs = [read(path, topics=topics) for path in (folder, folder / "metadata.yaml", file)]
        for run in runs:
            np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE)
        assert runs[0].sha256 == runs[1].sha256 != runs[2].sha256


def test_the_hash_is_what_sha256sum_prints(tmp_path):
    import hashlib

    said = joint_states("/joint_states", TIME, ["left", "right"], position=ANGLE)
    topics = {"wheel_angle": {"topic": "/joint_states"}}
    file = write_bag(tmp_path / "bag.bag", "rosbag1", said)
    assert read(file, topics=topics).sha256 == hashlib.sha256(file.read_bytes()).hexdigest()
    folder = write_bag(tmp_path / "bag", "mcap", said)
    files = sorted(folder.iterdir())
    lines = "".join(f"{hashlib.sha256(f.read_bytes()).hexdigest()}  {f.name}\n" for f in files)
    assert read(folder, topics=topics).sha256 == hashlib.sha256(lines.encode()).hexdigest()


# joints


def test_joints_are_found_by_name_in_any_order(tmp_path):
    ahead = joint_states("/joint_states", TIME[::2], ["left", "right"], position=ANGLE[::2])
    back = joint_states(
        "/joint_states", TIME[1::2], ["arm", "right", "left"], position=with_arm(ANGLE[1::2])
    )
    topics = {"wheel_angle": {"topic": "/joint_states"}}
    run = read(bag(tmp_path, "mcap", ahead, back), joints=("right", "left"), topics=topics)
    np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE[:, ::-1])


def with_arm(angle):
    """Columns arm, right, left."""
    return np.column_stack([np.full(len(angle), 99.0), angle[:, 1], angle[:, 0]])


def test_messages_of_other_joints_are_left_out(tmp_path):
    wheels = joint_states("/joint_states", TIME, ["left", "right"], position=ANGLE)
    arm = joint_states("/joint_states", TIME + 0.005, ["arm"], position=ANGLE[:, :1])
    topics = {"wheel_angle": {"topic": "/joint_states"}}
    run = read(bag(tmp_path, "sqlite3", wheels, arm), topics=topics)
    np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE)
    np.testing.assert_array_equal(
        run.signals["wheel_angle"].source.lines, 1 + 2 * np.arange(len(TIME))
    )


def test_joints_in_messages_of_their_own_are_laid_side_by_side(tmp_path):
    straight = np.column_stack([TIME - TIME[0], 2.0 * (TIME - TIME[0])])
    left = joint_states("/left", TIME, ["left"], position=straight[:, :1])
    later = TIME + 0.003
    right = joint_states("/right", later, ["right"], position=straight[:, 1:] + 0.006)
    topics = {"wheel_angle": {"topic": ["/left", "/right"]}}
    run = read(bag(tmp_path, "mcap", left, right), topics=topics)
    signal = run.signals["wheel_angle"]
    np.testing.assert_allclose(signal.values, straight[1:], atol=1e-6)
    np.testing.assert_allclose(signal.time, TIME[1:], rtol=0, atol=RESOLUTION)
    assert "interpolated" in run.notes[0]
    assert "right" in run.notes[0]


def test_a_message_without_one_of_the_joints_is_left_out_with_a_note(tmp_path):
    said = joint_states("/joint_states", TIME, ["left", "right"], position=ANGLE)
    said[7] = joint_states("/joint_states", TIME[7:8], ["left"], position=ANGLE[7:8, :1])[0]
    topics = {"wheel_angle": {"topic": "/joint_states"}}
    run = read(bag(tmp_path, "mcap", said), topics=topics)
    np.testing.assert_allclose(run.signals["wheel_angle"].values, np.delete(ANGLE, 7, axis=0))
    assert "1 messages without all of left, right" in run.notes[0]


@pytest.mark.parametrize(
    ("channel", "unit", "factor"),
    [
        ("current", "A", 1.0),
        ("motor_torque", "N*m", 1.0),
        ("wheel_torque", "N m", 1.0),
        ("motor_torque", "N*mm", 1e-3),
        ("voltage", "V", 1.0),
        ("duty", "1", 1.0),
        ("duty", "%", 0.01),
    ],
)
def test_what_effort_may_mean(tmp_path, channel, unit, factor):
    said = joint_states("/joint_states", TIME, ["left", "right"], effort=ANGLE)
    topics = {channel: {"topic": "/joint_states", "field": "effort", "unit": unit}}
    run = read(bag(tmp_path, "mcap", said), topics=topics)
    np.testing.assert_allclose(run.signals[channel].values, ANGLE * factor)


# messages of one's own

CUSTOM = {
    "my_msgs/msg/Motor": "string name\nfloat32 current\nint16 duty\n",
    "my_msgs/msg/State": (
        "std_msgs/Header header\nbool on\nfloat64[3] spare\nmy_msgs/Motor[] motors\n"
        "float32[] volts\nint64 ticks\n"
    ),
}


def states(time):
    return [
        Said(
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
        Said("/amps", "std_msgs/msg/Float64MultiArray", {"data": [k, -k]}, t)
        for k, t in enumerate(TIME.tolist())
    ]
    one = [
        Said("/volts", "std_msgs/msg/Int32", {"data": 100 * k}, t)
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


def test_a_pose_inside_a_message_of_ones_own(tmp_path):
    text = {"my_msgs/msg/Seen": "std_msgs/Header header\ngeometry_msgs/Pose robot\nfloat32 x\n"}
    said = [
        Said(
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
    path = bag(tmp_path, "mcap", said, definitions=text)
    run = read(path, topics={"pose": {"topic": "/seen", "field": "robot"}})
    np.testing.assert_allclose(run.signals["pose_x"].values[:, 0], TIME - TIME[0], atol=1e-6)
    np.testing.assert_allclose(run.signals["pose_heading"].values, 0.5)


def test_standard_types_need_no_definition_in_the_bag(tmp_path):
    said = joint_states("/joint_states", TIME, ["left", "right"], position=ANGLE)
    path = without_definitions(bag(tmp_path, "sqlite3", said))
    run = read(path, topics={"wheel_angle": {"topic": "/joint_states"}})
    np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE)


def test_messages_with_ever_new_texts_are_read_too(tmp_path):
    said = [
        Said(
            "/joint_states",
            "sensor_msgs/msg/JointState",
            {"header": header(t, f"frame{k:04d}"), "name": ["left"], "position": [1.0 * k]},
            t,
        )
        for k, t in enumerate(TIME.tolist())
    ]
    topics = {"wheel_angle": {"topic": "/joint_states"}}
    run = read(bag(tmp_path, "mcap", said), joints=("left",), topics=topics)
    np.testing.assert_array_equal(run.signals["wheel_angle"].values[:, 0], np.arange(len(TIME)))


def test_a_big_endian_message(tmp_path):
    from slipid.data.reading.bag.messages.kinds import Field, Many, Message, Number, Text
    from slipid.data.reading.bag.messages.shape import shape_of, steps_of

    kind = Message("x/msg/Y", (Field("s", Text()), Field("v", Many(Number("f8"), None))))
    text = b"\0\0\0\x03ab\0\0"  # and one byte up to the next length
    raw = b"\0\0\0\0" + text + b"\0\0\0\x01" + b"\0\0\0\0" + np.array([2.5], ">f8").tobytes()
    shape = shape_of(raw, kind, cdr=True)
    assert shape.texts(steps_of("s")) == ("ab",)
    (place,) = shape.places(steps_of("v"))
    assert place.of(np.frombuffer(raw, np.uint8)[None])[0] == 2.5


def test_importing_slipid_reads_no_bags():
    import subprocess
    import sys

    code = (
        "import sys, slipid, slipid.data.reading.bag.reader, slipid.data.reading.bag.topics\n"
        "print([m for m in sys.modules if m.startswith(('rosbags', 'apsw', 'lz4'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
