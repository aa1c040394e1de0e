"""Logs of PX4 are read like bags, and files of other kinds name what converts them."""

from __future__ import annotations

import struct
import sys
from importlib.util import find_spec

import numpy as np
import pytest

from slipid.data.reading.bag.topics import topics_of
from slipid.data.reading.table import bytes_of
from slipid.support.errors import DataError
from tests.helpers.made_ulogs import write_ulog
from tests.helpers.one_bag import read
from tests.helpers.proposals import layout_in, proposed

FORMATS = {
    "wheel_encoders": "uint64_t timestamp;float[2] wheel_speed;float[2] wheel_angle;",
    "vehicle_local_position": (
        "uint64_t timestamp;float x;float y;float z;float heading;bool valid;uint8_t[3] _padding0;"
    ),
    "vehicle_visual_odometry": "uint64_t timestamp;float[3] position;float[4] q;",
    "esc_report": "uint64_t timestamp;int32_t esc_rpm;float esc_current;uint8_t[4] _padding0;",
    "esc_status": "uint64_t timestamp;esc_report[2] esc;uint8_t count;uint8_t[7] _padding0;",
}
needs_pyulog = pytest.mark.skipif(
    find_spec("pyulog") is None,
    reason="ULog files need slipid[ulog], which the development environment has",
)
TIME = 7_000_000 + 20_000 * np.arange(100)  # us
TURN = 0.01 * np.arange(100)


@pytest.fixture
def log(tmp_path):
    """Two wheels, a pose of the filter, one of a camera system, and two motor controllers."""
    messages = []
    for t, a in zip(TIME.tolist(), TURN.tolist(), strict=True):
        half = np.cos(a / 2), np.sin(a / 2)
        messages += [
            ("wheel_encoders", 0, struct.pack("<Q4f", t, 2.0, 1.0, 20 * a, 10 * a)),
            ("vehicle_local_position", 1, struct.pack("<Q4f?", t + 5, a, 2 * a, 0.0, a, True)),
            (
                "vehicle_visual_odometry",
                2,
                struct.pack("<Q7f", t + 9, a, 2 * a, 0.0, half[0], 0.0, 0.0, half[1]),
            ),
            (
                "esc_status:1",
                3,
                struct.pack("<QQif4xQif4xB", t, t, 300, 1.5, t, -100, 0.25, 2),
            ),
        ]
    return write_ulog(tmp_path / "run.ulg", FORMATS, messages)


@needs_pyulog
def test_topics_come_back(log):
    topics = {
        "wheel_angle": {"topic": "wheel_encoders"},
        "wheel_speed": {"topic": "wheel_encoders"},
        "pose": {"topic": "vehicle_local_position"},
        "current": {
            "topic": "esc_status:1",
            "field": ["esc[0].esc_current", "esc[1].esc_current"],
            "unit": "A",
        },
    }
    run = read(log, topics=topics)
    angle = run.signals["wheel_angle"]
    np.testing.assert_allclose(angle.time, TIME / 1e6, atol=1e-9)
    # the first of PX4 is the right wheel, ours the left one
    np.testing.assert_allclose(angle.values, np.outer(TURN, [10.0, 20.0]), rtol=1e-6)
    np.testing.assert_array_equal(run.signals["wheel_speed"].values[0], [1.0, 2.0])
    np.testing.assert_array_equal(run.signals["current"].values[-1], [1.5, 0.25])
    # x north and y east are turned to x ahead and y to the left
    for name, factor in (("pose_x", 1.0), ("pose_y", -2.0), ("pose_heading", -1.0)):
        np.testing.assert_allclose(run.signals[name].values[:, 0], factor * TURN, atol=1e-6)
    assert any("z points down" in note for note in run.notes)


@needs_pyulog
def test_a_pose_may_have_a_quaternion_that_begins_with_w(log):
    run = read(log, topics={"pose": {"topic": "vehicle_visual_odometry"}})
    np.testing.assert_allclose(run.signals["pose_heading"].values[:, 0], -TURN, atol=1e-6)
    np.testing.assert_allclose(run.signals["pose_y"].values[:, 0], -2 * TURN, atol=1e-6)


@needs_pyulog
def test_topics_are_described_and_proposed(log):
    found = {topic.name: topic for topic in topics_of(log)}
    assert found["wheel_encoders"].serves == ("wheel_angle", "wheel_speed")
    assert found["vehicle_local_position"].serves == ("pose",)
    assert found["wheel_encoders"].rate == pytest.approx(50.0)
    assert "esc.esc_rpm" in [field.path for field in found["esc_status:1"].fields]
    _, config = proposed(log)
    layout = layout_in(config)
    assert layout["topics"]["wheel_angle"] == {"topic": "wheel_encoders"}
    assert layout["topics"]["pose"]["topic"] == "vehicle_local_position"
    assert '"differential"' in config.text


@needs_pyulog
def test_a_damaged_log_is_named(log):
    log.write_bytes(log.read_bytes()[:12])
    with pytest.raises(DataError, match=r"run\.ulg: the bag is damaged.*from the robot again"):
        topics_of(log)


def test_without_the_package_the_message_names_it(log, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(DataError, match=r"a ULog file needs the package pyulog.*\[ulog\]'"):
        topics_of(log)


@pytest.mark.parametrize(
    ("name", "program"),
    [
        ("log.BIN", "mavlogdump"),
        ("log.tlog", "mavlogdump"),
        ("run.mat", "writetable"),
        ("run.hdf5", "h5py"),
        ("run.rrd", "Rerun"),
    ],
)
def test_other_kinds_of_files_name_what_converts_them(tmp_path, name, program):
    path = tmp_path / name
    path.write_bytes(b"\x00\x01 some bytes")
    for reader in (topics_of, bytes_of):
        with pytest.raises(DataError, match=rf"expected a CSV or Parquet file.*{program}"):
            reader(path)
