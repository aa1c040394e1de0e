"""The floor without the robot: the middle of what a video shows at each place."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slipid.camera.frames.still import FRAMES, still
from slipid.camera.frames.video import Capture
from slipid.support.errors import DataError

FLOOR = np.full((80, 120, 3), (40, 120, 200), np.uint8)


def film(path, frames, stands=0):
    """A white robot that drives along the floor, and stands for some frames where it began."""
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (120, 80))
    for k in range(frames):
        shown = FLOOR.copy()
        x = 5 + int(80 * max(0, k - stands) / frames)
        shown[20:50, x : x + 25] = 255
        video.write(shown)
    video.release()
    return path


@pytest.mark.parametrize("frames", [9, 10 * FRAMES + 3])
def test_what_moves_is_gone(tmp_path, frames):
    shown = still(film(tmp_path / "video.avi", frames)).astype(int)
    assert shown.shape == FLOOR.shape
    assert np.abs(shown - FLOOR).max() < 12  # what the compression of the video changes


def test_what_stands_most_of_the_time_stays(tmp_path):
    shown = still(film(tmp_path / "video.avi", 60, stands=45)).astype(int)
    assert shown[25:45, 10:25].min() > 240
    assert np.abs(shown[60:] - FLOOR[60:]).max() < 12


def test_frames_are_spread_over_a_video_that_does_not_know_its_length(tmp_path, monkeypatch):
    path = film(tmp_path / "video.avi", 300, stands=20)
    monkeypatch.setattr(Capture, "value", lambda self, what: 0.0)
    shown = still(path).astype(int)
    assert np.abs(shown - FLOOR).max() < 12


def test_a_picture_is_itself(tmp_path):
    cv2.imwrite(str(tmp_path / "floor.png"), FLOOR)
    np.testing.assert_array_equal(still(tmp_path / "floor.png"), FLOOR)


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("none.avi", None, "No such file"),
        ("empty.avi", b"", "the file is empty"),
        ("words.avi", b"no video at all", "cannot open it"),
        ("words.png", b"no picture", "no picture that OpenCV reads"),
    ],
)
def test_what_is_neither_is_refused_by_its_name(tmp_path, name, data, said):
    if data is not None:
        (tmp_path / name).write_bytes(data)
    with pytest.raises(DataError, match=rf"{name}: .*{said}"):
        still(tmp_path / name)
