"""Damaged bags are read up to the damage, or refused with a clear error."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from slipid.data.reading.bag.layout import declared_bag_layout
from slipid.data.reading.bag.topics import topics_of
from slipid.support.errors import DataError
from tests.helpers.kept import kept
from tests.helpers.made_bags import Message, in_order, joint_states, transform, write_bag
from tests.helpers.one_bag import runs_of

TIME = 1.7e9 + np.arange(0.0, 3.0, 0.01)
ANGLE = np.column_stack([TIME - TIME[0], TIME[0] - TIME])
LAYOUT = declared_bag_layout(
    {
        "joints": ["l", "r"],
        "topics": {
            "wheel_angle": {"topic": "/joint_states"},
            "pose": {"topic": "/tf", "frame": "map", "child": "base"},
        },
    },
    "layout",
)


def messages():
    tf = [
        Message(
            "/tf",
            "tf2_msgs/msg/TFMessage",
            {"transforms": [transform(t, "map", "base", t, 0, 0)]},
            t,
        )
        for t in TIME.tolist()
    ]
    return in_order(joint_states("/joint_states", TIME, ["l", "r"], position=ANGLE), tf)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return a file of each storage."""
    folder = tmp_path_factory.mktemp("whole")
    written = messages()
    found = {"rosbag1": write_bag(folder / "bag.bag", "rosbag1", written)}
    for storage, suffix in (("sqlite3", "db3"), ("mcap", "mcap")):
        found[storage] = next(write_bag(folder / storage, storage, written).glob(f"*.{suffix}"))
    many = write_bag(folder / "chunks", "mcap", [*written, *filler()])
    found["chunks"] = next(many.glob("*.mcap"))
    return found


def filler():
    """Return two megabytes, so that an MCAP file has more than one chunk."""
    pixels = np.zeros(300_000, dtype=np.uint8)
    return [
        Message("/camera", "sensor_msgs/msg/Image", {"data": pixels}, TIME[-1] + k)
        for k in range(8)
    ]


def refused(path, *words):
    with pytest.raises(DataError) as caught:
        runs_of(path, LAYOUT)
    text = str(caught.value)
    assert "expected " in text, text
    assert all(word in text for word in words), text


def cut(tmp_path, file, share):
    short = tmp_path / file.name
    data = file.read_bytes()
    short.write_bytes(data[: int(share * len(data))])
    return short


# no bags


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("log.csv", b"t,x\n1,2\n", ("not a bag", "b't,x", ".mcap file")),
        ("a.bag", b"", ("the file is empty",)),
        ("a.mcap", b"#ROSBAG V2.0\n", ("a rosbag1 bag", "rename it to a.bag")),
        ("old.bag", b"#ROSBAG V1.2\n", ("version 102 is not supported",)),
    ],
)
def test_files_that_are_no_bags(tmp_path, name, data, words):
    (tmp_path / name).write_bytes(data)
    refused(tmp_path / name, *words)


def test_folders_that_are_no_bags(tmp_path):
    refused(tmp_path / "none", "no such file or folder", "ros2 bag record")
    (tmp_path / "some.csv").write_text("a")
    refused(tmp_path, "without a .db3 or .mcap file", "some.csv")


# cut off


def test_a_rosbag1_whose_recording_was_cut_off(tmp_path, whole):
    data = bytearray(whole["rosbag1"].read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    (tmp_path / "bag.bag").write_bytes(data)
    refused(tmp_path / "bag.bag", "has no index", f"run: rosbag reindex {tmp_path / 'bag.bag'}")


@pytest.mark.parametrize(
    ("storage", "remedy"),
    [("rosbag1", "rosbag reindex"), ("sqlite3", ".recover"), ("mcap", "mcap recover")],
)
def test_a_file_that_was_copied_in_part(tmp_path, whole, storage, remedy):
    refused(cut(tmp_path, whole[storage], 0.4), "damaged or was cut off", remedy)


def test_an_mcap_file_is_read_up_to_its_last_whole_record(tmp_path, whole):
    file = cut(tmp_path, whole["chunks"], 0.7)
    (run,) = runs_of(file, LAYOUT)
    np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE)
    np.testing.assert_allclose(run.signals["pose_x"].values[:, 0], TIME)
    assert "was cut off" in run.notes[0]
    assert "last complete record" in run.notes[0]
    assert {topic.name for topic in topics_of(file)} == {"/joint_states", "/tf", "/camera"}


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_folder_without_metadata(tmp_path, whole, storage):
    shutil.copy(whole[storage], tmp_path)
    (run,) = runs_of(tmp_path, LAYOUT)
    np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE)
    assert run.notes == ("the folder has no metadata.yaml: the recording was cut off",)


def test_parts_of_a_recording_follow_each_other_by_number(tmp_path):
    written = messages()
    for number, half in ((9, written[: len(written) // 2]), (10, written[len(written) // 2 :])):
        folder = write_bag(tmp_path / f"part_{number}", "mcap", half)
        shutil.move(next(folder.glob("*.mcap")), tmp_path)
        shutil.rmtree(folder)
    (run,) = runs_of(tmp_path, LAYOUT)
    np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE)
    np.testing.assert_array_equal(run.signals["wheel_angle"].source.lines, 1 + np.arange(len(TIME)))


def test_metadata_that_names_a_missing_file(tmp_path, whole):
    folder = tmp_path / "bag"
    shutil.copytree(whole["sqlite3"].parent, folder)
    next(folder.glob("*.db3")).rename(folder / "other.db3")
    refused(folder, "files are missing", "ros2 bag reindex")


def test_messages_that_wait_in_a_log_beside_the_bag(tmp_path, whole):
    shutil.copy(whole["sqlite3"], tmp_path)
    (tmp_path / (whole["sqlite3"].name + "-wal")).write_bytes(b"x")
    (run,) = runs_of(tmp_path / whole["sqlite3"].name, LAYOUT)
    assert "wal_checkpoint" in run.notes[0]


# damaged anywhere


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["rosbag1", "sqlite3", "mcap", "chunks"])
def test_a_bag_cut_anywhere_is_read_or_refused(tmp_path, whole, storage):
    ends = np.random.default_rng(1).uniform(0.0, 1.0, 40)
    outcomes = [outcome(cut(tmp_path, whole[storage], share)) for share in ends]
    assert outcomes.count("refused") > 5


@pytest.mark.slow
@pytest.mark.parametrize(
    "storage", kept(["rosbag1", "sqlite3", "mcap", "chunks"], ["rosbag1", "mcap"])
)
def test_a_bag_with_other_bytes_is_read_or_refused(tmp_path, whole, storage):
    rng = np.random.default_rng(2)
    data = np.frombuffer(whole[storage].read_bytes(), np.uint8)
    for k in range(80):
        broken = data.copy()
        # the heads and ends of the files, and all of them; one byte, or a block
        span = {0: len(data), 1: 6000, 2: 60}[k % 3]
        size = 1 if k % 2 else 16
        at = int(rng.integers(0, min(span, len(data)) - size))
        at = at if k % 4 < 2 else len(data) - at - size
        broken[at : at + size] = rng.integers(0, 256, size)
        file = tmp_path / whole[storage].name
        file.write_bytes(broken.tobytes())
        outcome(file)


def outcome(file):
    """Return `read` or `refused`; anything else is an error without information for the user."""
    texts = [outcome_of(lambda: runs_of(file, LAYOUT)), outcome_of(lambda: topics_of(file))]
    for text in filter(None, texts):
        assert str(file.parent) in text
        assert "expected " in text
        # a mistake of ours that would pass for a damaged bag
        assert "Type-check" not in text
    return "read" if texts[0] is None else "refused"


def outcome_of(read):
    """Return the text of the error, None without one."""
    try:
        read()
    except DataError as error:
        return str(error)
    return None
