"""Poses from chains of transforms, against compositions by hand."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from slipid.data.reading.bag.layout import declared_bag_layout
from slipid.support.errors import DataError
from tests.helpers.made_bags import (
    STORAGES,
    SUFFIX,
    Message,
    in_order,
    transform,
    vector,
    write_bag,
)
from tests.helpers.one_bag import runs_of

TIME = 100.0 + np.arange(0.0, 5.0, 0.02)
TF = "tf2_msgs/msg/TFMessage"


def message(topic, *transforms, received):
    return Message(topic, TF, {"transforms": list(transforms)}, received)


def pose_of(path, frame, child, topic="/tf"):
    topics = {"pose": {"topic": topic, "frame": frame, "child": child}}
    (run,) = runs_of(path, declared_bag_layout({"topics": topics}, "layout"))
    x, y, heading = (run.signals[f"pose_{name}"] for name in ("x", "y", "heading"))
    return x.time, np.column_stack([x.values, y.values, heading.values]), run


@pytest.fixture
def parts():
    """Return map -> odom (10 Hz), odom -> base (50 Hz), base -> camera (static), another robot."""
    odom = [
        message("/tf", transform(t, "map", "odom", 1.0 + 0.1 * (t - 100), 2.0, 0.0), received=t)
        for t in TIME[::5].tolist()
    ]
    base = [
        message(
            "/tf",
            transform(t, "elsewhere", "other", 5, 5, 5),
            transform(t, "odom", "base", t - 100, 0.5 * (t - 100), t - 100),
            received=t + 0.001,
        )
        for t in TIME.tolist()
    ]
    camera = [
        message("/tf_static", transform(0.0, "/base", "/camera", 0.2, 0.1, pi / 2), received=99)
    ]
    return camera, odom, base


@pytest.mark.parametrize("storage", STORAGES)
def test_a_chain_is_composed(tmp_path, storage, parts):
    path = write_bag(tmp_path / f"bag{SUFFIX[storage]}", storage, in_order(*parts))
    time, pose, run = pose_of(path, "map", "camera")
    s = time - 100.0
    # up to the last time at which all of the chain is known
    np.testing.assert_allclose(time, TIME[: len(TIME) - 4], rtol=0, atol=1e-6)
    expected = np.column_stack(
        [
            1.0 + 0.1 * s + s + 0.2 * np.cos(s) - 0.1 * np.sin(s),
            2.0 + 0.5 * s + 0.2 * np.sin(s) + 0.1 * np.cos(s),
            s + pi / 2,
        ]
    )
    np.testing.assert_allclose(pose, expected, atol=1e-6)
    assert run.signals["pose_x"].source.columns == ("camera in map",)


def test_a_chain_may_go_up_and_down(tmp_path, parts):
    path = write_bag(tmp_path / "bag", "mcap", in_order(*parts))
    time, pose, _ = pose_of(path, "base", "map")
    s = time - 100.0
    x, y = 1.0 + 1.1 * s, 2.0 + 0.5 * s
    expected = np.column_stack([-x * np.cos(s) - y * np.sin(s), x * np.sin(s) - y * np.cos(s), -s])
    np.testing.assert_allclose(pose, expected, atol=1e-6)


def test_one_edge_needs_no_composition(tmp_path, parts):
    path = write_bag(tmp_path / "bag", "mcap", in_order(*parts))
    time, pose, _ = pose_of(path, "odom", "base")
    np.testing.assert_allclose(time, TIME, rtol=0, atol=1e-6)
    np.testing.assert_allclose(pose[:, 2], TIME - 100.0, atol=1e-6)


def test_a_frame_that_lies_on_its_side_is_noted(tmp_path):
    side = {"x": np.sin(pi / 4), "y": 0.0, "z": 0.0, "w": np.cos(pi / 4)}
    messages = []
    for t in TIME.tolist():
        one = transform(t, "mocap", "base", t, 0, 0)
        one["transform"] = {"translation": vector(t), "rotation": side}
        messages.append(message("/tf", one, received=t))
    _, _, run = pose_of(write_bag(tmp_path / "bag", "mcap", messages), "mocap", "base")
    assert "tilts by up to 90 deg" in run.notes[0]


@pytest.mark.parametrize(
    ("frame", "child", "words"),
    [
        ("map", "bse", ("no frame 'bse'", "did you mean base", "camera", "odom")),
        ("map", "other", ("no transforms lead from 'map' to 'other'", "elsewhere -> other")),
        ("base", "camera", ("published only once", "frames that move")),
    ],
)
def test_frames_that_do_not_lead_there(tmp_path, parts, frame, child, words):
    path = write_bag(tmp_path / "bag", "mcap", in_order(*parts))
    with pytest.raises(DataError) as caught:
        pose_of(path, frame, child)
    assert all(word in str(caught.value) for word in words), caught.value


def test_transforms_need_frames(tmp_path, parts):
    path = write_bag(tmp_path / "bag", "mcap", in_order(*parts))
    layout = declared_bag_layout({"topics": {"pose": {"topic": "/tf"}}}, "layout")
    with pytest.raises(DataError, match=r"expected frame and child.*map -> odom"):
        runs_of(path, layout)
