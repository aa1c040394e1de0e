"""Poses of a video from Python are those of the command."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import slipid as sl
from tests.helpers.track_command import LONE, ROBOT, TARGETS, made_in, track


def test_a_lone_marker_is_tracked_as_by_the_command(tmp_path):
    made = made_in(tmp_path)
    video = made.video("robot", ROBOT)
    result = sl.track(video, sl.OverheadCamera.load(made.camera), sl.LoneMarker(0.131, 0.25))
    assert track(made, video, tmp_path / "poses.csv", *LONE).exit_code == 0
    table = pd.read_csv(tmp_path / "poses.csv")
    columns = table[["x", "y", "heading"]].to_numpy()
    np.testing.assert_allclose(result.tracks[0].pose, columns, atol=1e-6)
    assert result.write(tmp_path / "again.csv") == [tmp_path / "again.csv"]
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "poses.csv").read_bytes()


def test_targets_come_from_their_file_and_other_files_than_cameras_are_refused(tmp_path):
    made = made_in(tmp_path)
    (tmp_path / "targets.toml").write_text(TARGETS)
    video = made.video("robot", ROBOT)
    result = sl.track(video, made.camera, tmp_path / "targets.toml", quiet=True)
    assert [one.target.name for one in result.tracks] == ["one", "two"]
    assert result.tracks[0].share == 1.0
    assert result.tracks[1].share == 0.0
    with pytest.raises(sl.DataError, match=r"none\.json: .*; expected a camera file"):
        sl.track(video, tmp_path / "none.json", sl.LoneMarker(0.131, 0.25))
