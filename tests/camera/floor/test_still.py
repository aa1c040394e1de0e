"""The floor without the robot: the median of a video at each place."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slipid.camera.video import MEDIAN_FRAMES, VideoStream, still
from slipid.support.errors import DataError

FLOOR = np.full((80, 120, 3), (40, 120, 200), np.uint8)


def film(path, frames, stands=0):
    """Write a video of a white robot that stands for some frames and then drives."""
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (120, 80))
    for k in range(frames):
        shown = FLOOR.copy()
        x = 5 + int(80 * max(0, k - stands) / frames)
        shown[20:50, x : x + 25] = 255
        video.write(shown)
    video.release()
    return path


@pytest.mark.parametrize("frames", [9, 10 * MEDIAN_FRAMES + 3])
def test_moving_objects_are_gone(tmp_path, frames):
    shown = still(film(tmp_path / "video.avi", frames)).picture.astype(int)
    assert shown.shape == FLOOR.shape
    assert np.abs(shown - FLOOR).max() < 12  # by the compression of the video


def test_an_object_that_stands_most_of_the_time_stays(tmp_path):
    shown = still(film(tmp_path / "video.avi", 60, stands=45)).picture.astype(int)
    assert shown[25:45, 10:25].min() > 240
    assert np.abs(shown[60:] - FLOOR[60:]).max() < 12


def test_frames_are_spread_over_a_video_that_does_not_know_its_length(tmp_path, monkeypatch):
    path = film(tmp_path / "video.avi", 300, stands=20)
    monkeypatch.setattr(VideoStream, "count", None)
    shown = still(path).picture.astype(int)
    assert np.abs(shown - FLOOR).max() < 12


def test_a_picture_is_itself(tmp_path):
    half = FLOOR.copy()
    half[:, :60] = 30
    cv2.imwrite(str(tmp_path / "floor.png"), half)
    np.testing.assert_array_equal(still(tmp_path / "floor.png").picture, half)


def test_a_single_colour_is_no_floor(tmp_path):
    cv2.imwrite(str(tmp_path / "floor.png"), FLOOR)
    with pytest.raises(DataError, match=r"floor\.png: every pixel has the same colour"):
        still(tmp_path / "floor.png")


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("none.avi", None, "No such file"),
        ("empty.avi", b"", "the file is empty"),
        ("words.avi", b"no video at all", "not a video that can be opened"),
        ("words.png", b"no picture", "not an image that OpenCV reads"),
    ],
)
def test_other_files_are_refused_by_their_name(tmp_path, name, data, message):
    if data is not None:
        (tmp_path / name).write_bytes(data)
    with pytest.raises(DataError, match=rf"{name}: .*{message}"):
        still(tmp_path / name)
