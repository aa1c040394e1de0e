"""`slipid track`: the files it writes, and its doubts."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pandas as pd
import pytest

from slipid.camera.tracking.outputs import write_poses
from slipid.camera.tracking.target import read_targets
from tests.helpers.made_drives import round_trip
from tests.helpers.made_sources import write_video
from tests.helpers.made_videos import Body, Printed
from tests.helpers.track_command import (
    ASIDE,
    COUNT,
    LONE,
    OTHER,
    ROBOT,
    STAGE,
    TARGETS,
    Made,
    made_in,
    track,
)
from tests.helpers.tracked import target_of, tracked


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Made:
    return made_in(tmp_path_factory.mktemp("videos"))


# files --------------------------------------------------------------------------------


def test_poses_are_written_as_csv_and_parquet(made, tmp_path):
    video, picture = made.video("robot", ROBOT), tmp_path / "look.png"
    shown = tmp_path / "shown.json"
    words = (*LONE, "--preview", picture, "--json", shown)
    done = track(made, video, tmp_path / "poses.csv", *words)
    assert done.exit_code == 0, done.stderr
    assert "20 of 20 frames have a pose" in done.stdout
    table = pd.read_csv(tmp_path / "poses.csv")
    true = ROBOT.poses(COUNT)
    np.testing.assert_allclose(table["time"], np.arange(COUNT) / 30, atol=1e-5)
    np.testing.assert_allclose(table[["x", "y"]], true[:, :2], atol=1e-3)
    np.testing.assert_allclose(table["heading"], true[:, 2], atol=8e-3)
    assert table["flag"].eq("ok").all()
    assert table["var_x"].between(1e-9, 1e-6).all()
    assert table[["rejected_x", "rejected_y", "rejected_heading"]].isna().all(axis=None)
    assert cv2.imread(str(picture)).shape == (270, 480, 3)
    content = json.loads(shown.read_text(encoding="utf-8"))
    assert (content["schema"], content["frames"]) == ("slipid.track/1", COUNT)
    assert content["targets"]["robot"]["flags"]["ok"] == COUNT
    assert content["targets"]["robot"]["height_told_m"] == pytest.approx(0.25, abs=0.02)
    photo = tmp_path / "look.jpg"
    again = track(made, video, tmp_path / "poses.csv", *LONE, "--preview", picture)
    assert again.exit_code == 0, again.stderr
    for _ in range(2):  # slipid's own files are replaced
        done = track(made, video, tmp_path / "poses.parquet", *LONE, "--preview", photo)
        assert done.exit_code == 0, done.stderr
    assert cv2.imread(str(photo)).shape == (270, 480, 3)
    other = pd.read_parquet(tmp_path / "poses.parquet")
    assert list(other.columns) == list(table.columns)
    pd.testing.assert_frame_equal(other, table, check_dtype=False, rtol=1e-3, atol=1e-6)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        ["look.jpg", "look.png", "poses.csv", "poses.parquet", "shown.json"]
    )


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_file_keeps_every_number_of_a_track(tmp_path, suffix):
    markers = (Printed(ahead=0.15, left=0.04),)  # away from the middle: no entry is near zero
    body = Body(round_trip(), markers)
    (track,) = tracked(STAGE, STAGE.film([body], 6), tmp_path, target_of(markers))
    write_poses(tmp_path / f"p{suffix}", track)
    read = pd.read_csv if suffix == ".csv" else pd.read_parquet
    table = read(tmp_path / f"p{suffix}")
    np.testing.assert_allclose(table[["x", "y", "heading"]], track.pose, atol=1e-6)
    names = [["var_x", "cov_xy", "cov_x_heading"], ["cov_xy", "var_y", "cov_y_heading"]]
    names.append(["cov_x_heading", "cov_y_heading", "var_heading"])
    for row in range(3):
        np.testing.assert_allclose(table[names[row]], track.covariance[:, row], rtol=1e-3)
    np.testing.assert_allclose(table["size"], track.size, atol=1e-5)
    assert np.linalg.eigvalsh(track.covariance).min() > 0


def test_bad_frames_are_rows_with_a_reason(made, tmp_path):
    pictures = STAGE.film([ROBOT], COUNT)
    pictures[5] = np.zeros_like(pictures[5])
    pictures[11] = STAGE.frame(11 / 30, [Body(lambda t: ROBOT.pose_at(t) + ASIDE)])
    video = write_video(tmp_path / "a.avi", pictures)
    assert track(made, video, tmp_path / "p.csv", *LONE).exit_code == 0
    table = pd.read_csv(tmp_path / "p.csv")
    assert table["flag"][[5, 11]].tolist() == ["missing", "jump"]
    assert table.loc[[5, 11], ["x", "y", "heading", "var_x"]].isna().all(axis=None)
    moved = ROBOT.pose_at(11 / 30) + ASIDE
    rejected = table.loc[11, ["rejected_x", "rejected_y", "rejected_heading"]].to_numpy(float)
    np.testing.assert_allclose(rejected, moved, atol=8e-3)
    assert table["flag"].eq("ok").sum() == COUNT - 2


def test_a_turned_marker_turns_the_heading(made, tmp_path):
    video = made.video("robot", ROBOT)
    assert track(made, video, tmp_path / "p.csv", *LONE, "--marker-yaw", 90).exit_code == 0
    heading = pd.read_csv(tmp_path / "p.csv")["heading"]
    np.testing.assert_allclose(heading, ROBOT.poses(COUNT)[:, 2] - np.pi / 2, atol=8e-3)


def test_targets_of_a_file_get_a_file_each(made, tmp_path):
    (tmp_path / "targets.toml").write_text(TARGETS, encoding="utf-8")
    video = made.video("both", ROBOT, OTHER)
    words = ("--targets", tmp_path / "targets.toml", "--quiet")
    done = track(made, video, tmp_path / "p.csv", *words)
    assert done.exit_code == 0, done.stderr
    one, two = (pd.read_csv(tmp_path / f"p_{name}.csv") for name in ("one", "two"))
    true = ROBOT.poses(COUNT)
    heading = true[:, 2] - np.radians(30)
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    np.testing.assert_allclose(one["heading"], heading, atol=8e-3)
    body = true[:, :2] - 0.1 * ahead + 0.05 * left
    np.testing.assert_allclose(one[["x", "y"]], body, atol=2e-3)
    np.testing.assert_allclose(two[["x", "y"]], OTHER.poses(COUNT)[:, :2], atol=1e-3)


def test_a_board_lies_row_by_row_from_ahead_on_the_left(tmp_path):
    text = TARGETS.replace("columns = 1", "columns = 3").replace("rows = 1", "rows = 2")
    (tmp_path / "t.toml").write_text(text, encoding="utf-8")
    board = read_targets(tmp_path / "t.toml")[1]
    middles = {m.id: m.corners.mean(axis=0) for m in board.markers}
    assert sorted(middles) == [7, 8, 9, 10, 11, 12]
    np.testing.assert_allclose(middles[7], [0.0705, 0.141, 0.25])
    np.testing.assert_allclose(middles[9], [0.0705, -0.141, 0.25])
    np.testing.assert_allclose(middles[10], [-0.0705, 0.141, 0.25])
    np.testing.assert_allclose(
        board.markers[0].corners[0] - middles[7], [0.0655, 0.0655, 0.0], atol=1e-12
    )


# doubts -----------------------------------------------------------------------------------------


def test_wrong_height_is_reported_and_ends_with_one(made, tmp_path):
    words = ("--marker-size", 0.131, "--marker-height", 0.0, "--quiet")
    done = track(made, made.video("robot", ROBOT), tmp_path / "p.csv", *words)
    assert done.exit_code == 1
    assert "DOUBTFUL: robot: markers appear +18" in done.stdout
    assert (tmp_path / "p.csv").exists()


def test_a_video_that_was_cut_off_ends_with_one(made, tmp_path):
    data = made.video("robot", ROBOT).read_bytes()
    (tmp_path / "cut.avi").write_bytes(data[: len(data) // 2])
    done = track(made, tmp_path / "cut.avi", tmp_path / "p.csv", *LONE)
    assert done.exit_code == 1
    table = pd.read_csv(tmp_path / "p.csv")
    assert 5 < len(table) < 15
    assert f"the first {len(table)} frames are used" in " ".join(done.stdout.split())


def test_few_poses_end_with_one(made, tmp_path):
    empty = STAGE.film([], 30)
    video = write_video(tmp_path / "a.avi", [*STAGE.film([ROBOT], 8), *empty])
    done = track(made, video, tmp_path / "p.csv", *LONE)
    assert done.exit_code == 1
    assert "DOUBTFUL: robot: only 8 of 38 frames have a pose" in done.stdout
