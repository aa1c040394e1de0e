"""`slipid track`: bad input is one clear message and exit code 2, before the long work."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pandas as pd
import pytest

from slipid.camera.tracking.detector import MarkerTracker
from tests.helpers.made_sources import write_video
from tests.helpers.track_command import (
    FIVE,
    LONE,
    OTHER,
    ROBOT,
    STAGE,
    TARGETS,
    Made,
    made_in,
    track,
)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Made:
    return made_in(tmp_path_factory.mktemp("videos"))


def refusal(made, source, *words, out=None) -> str:
    """Return the one message of a command that ends with exit code 2."""
    done = track(made, source, out or made.folder / "never.csv", *words)
    assert done.exit_code == 2, done.stdout + done.stderr
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    assert not (made.folder / "never.csv").exists()
    return done.stderr


@pytest.mark.slow
def test_other_markers_than_the_requested_ones(made):
    assert "no marker of any dictionary" in refusal(made, made.video("empty", count=3), *LONE)
    words = refusal(made, made.video("empty", count=3), *LONE, "--id", 4)
    assert "marker 4 is in no frame so far; expected it in view" in words
    five = made.video("five", FIVE, count=3)
    assert "marker 3 of 5X5_50 in view; expected --dictionary 5X5_50" in refusal(made, five, *LONE)
    words = refusal(made, five, *LONE, "--id", 3)
    assert "marker 3 of the dictionary 5X5_50" in words
    both = made.video("two", ROBOT, OTHER, count=3)
    assert "markers 0, 7 in view; expected --id" in refusal(made, both, *LONE)
    assert "but markers 0, 7 in view; expected --id 0" in refusal(made, both, *LONE, "--id", 4)


def test_mirrored_videos_are_refused_as_such(made):
    frames = [np.ascontiguousarray(f[:, ::-1]) for f in STAGE.film([ROBOT], 3)]
    mirrored = write_video(made.folder / "mirrored.avi", frames)
    for words in ((), ("--id", 0)):
        message = refusal(made, mirrored, *LONE, *words)
        assert "marker 0 can be read only mirrored; expected pixels as the sensor" in message
    message = refusal(made, mirrored, *LONE, "--dictionary", "5X5_50")
    assert "marker 0 of 4X4_50 can be read only mirrored" in message


def test_frozen_and_empty_videos_are_refused(made):
    frozen = write_video(made.folder / "frozen.avi", STAGE.film([ROBOT], 1) * 5)
    assert "all 5 frames are identical" in refusal(made, frozen, *LONE)
    black = write_video(made.folder / "black.avi", [np.zeros((270, 480), np.uint8)] * 3)
    assert "every pixel of the last searched frame is 0" in refusal(made, black, *LONE)
    assert "identical" in refusal(made, black, *LONE, "--id", 0)
    levels = [np.full((270, 480), 40 * k, np.uint8) for k in range(3)]
    grey = write_video(made.folder / "grey.avi", levels)
    assert "is the lens covered" in refusal(made, grey, *LONE, "--id", 0)


def test_region_decides_between_several(made, tmp_path):
    both = made.video("two", ROBOT, OTHER, count=3)
    middle = STAGE.camera.pixels(np.array([*OTHER.pose_at(0.0)[:2], 0.25]))
    x, y = middle.astype(int).tolist()
    part = f"{x - 45},{y - 45},{x + 45},{y + 45}"
    assert track(made, both, tmp_path / "p.csv", *LONE, "--region", part).exit_code == 0
    table = pd.read_csv(tmp_path / "p.csv")
    np.testing.assert_allclose(table[["x", "y"]], OTHER.poses(3)[:, :2], atol=1e-3)
    elsewhere = refusal(made, both, *LONE, "--region", "0,0,40,40")
    assert "no marker of any dictionary" in elsewhere
    outside = refusal(made, both, *LONE, "--id", 0, "--region=-9,-9,-1,-1")
    assert "--region is outside the image" in outside
    assert "expected four whole numbers" in refusal(made, both, *LONE, "--region", "1,2")


SIZES = {
    "--marker-size": (
        "--marker-size",
        0,
        "--marker-height",
        0.25,
    ),
    "--marker-size nan": ("--marker-size", "nan", "--marker-height", 0.25),
    "--marker-height inf": ("--marker-size", 0.131, "--marker-height", "inf"),
    "'--marker-size'": ("--marker-size", 131, "--marker-height", 0.25),
    "'--marker-height'": ("--marker-size", 0.131, "--marker-height", 131_000),
    "--marker-yaw nan": (*LONE, "--marker-yaw", "nan"),
    "--id 50; expected 0 to 49": (*LONE, "--id", 50),
    "below the camera": ("--marker-size", 0.131, "--marker-height", 1.7),
    "expected --marker-size and": ("--marker-size", 0.131),
    "no marker dictionary '4X4_5'": (*LONE, "--dictionary", "4X4_5"),
    "'--fps'": (*LONE, "--fps", 0),
    "--seconds is for devices": (*LONE, "--seconds", 3),
    "no frame 99; expected 0 to 19": (*LONE, "--preview", "look.png", "--preview-frame", 99),
}


def test_no_file_of_another_kind_is_lost(made, tmp_path):
    log = tmp_path / "run07.csv"
    log.write_text("time,ticks_1\n0.0,1\n")
    video = made.video("robot", ROBOT)
    assert "would be overwritten" in refusal(made, video, *LONE, out=log)
    for name in ("run07.parquet", "photo.jpg", "photo.png"):
        foreign = tmp_path / name
        shutil.copy(log, foreign)
        out, more = (foreign, ()) if "run" in name else (None, ("--preview", foreign))
        found = refusal(made, video, *LONE, *more, out=out)
        assert f"{name}: exists and was not written by slipid" in found
        assert foreign.read_text() == log.read_text()
    assert log.read_text() == "time,ticks_1\n0.0,1\n"
    assert ".csv or .parquet" in refusal(made, video, *LONE, out=tmp_path / "a.xlsx")
    assert not (tmp_path / "a.xlsx").exists()


@pytest.mark.parametrize("words", SIZES)
def test_options_that_cannot_be(made, words, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    done = track(made, made.video("robot", ROBOT), tmp_path / "p.csv", *SIZES[words])
    assert done.exit_code == 2
    # some versions of Typer refuse what is no number by themselves, without showing it
    assert words.removesuffix(" nan").removesuffix(" inf") in done.stderr


def test_sources_that_cannot_be_read(made, tmp_path):
    assert "no such file" in refusal(made, tmp_path / "absent.avi", *LONE)
    (tmp_path / "zero.avi").write_bytes(b"")
    assert "the file is empty" in refusal(made, tmp_path / "zero.avi", *LONE)
    (tmp_path / "folder").mkdir()
    assert "no image" in refusal(made, tmp_path / "folder", *LONE, "--fps", 30)
    cv2.imwrite(str(tmp_path / "folder" / "a.png"), STAGE.frame(0.0, [ROBOT]))
    assert "--fps or --times" in refusal(made, tmp_path / "folder", *LONE)
    assert "expected --seconds with the recording's duration" in refusal(made, 99, *LONE)
    assert "OpenCV cannot open it" in refusal(made, 99, *LONE, "--seconds", 1)
    (tmp_path / "t.csv").write_text("frame,time\n0,0\n1,0\n", encoding="utf-8")
    video = made.video("robot", ROBOT)
    assert "times that increase" in refusal(made, video, *LONE, "--times", tmp_path / "t.csv")
    both = ("--times", tmp_path / "t.csv", "--fps", 30)
    assert "both --fps and --times are given" in refusal(made, video, *LONE, *both)


def test_cameras_that_do_not_fit(made, tmp_path):
    small = write_video(tmp_path / "small.avi", [np.zeros((90, 160), np.uint8)] * 2)
    assert "calibrated at 480 x 270; expected the same resolution" in refusal(made, small, *LONE)
    lens = json.loads(made.camera.read_text(encoding="utf-8"))
    del lens["place_m"]
    (tmp_path / "camera.json").write_text(json.dumps(lens), encoding="utf-8")
    video = made.video("robot", ROBOT)
    assert "a lens without a pose above" in refusal(Made(tmp_path), video, *LONE)
    (tmp_path / "camera.json").unlink()
    assert "No such file" in refusal(Made(tmp_path), video, *LONE)


def test_unwritable_files_are_reported_before_the_work(made, tmp_path, monkeypatch):
    def never(*_):
        raise AssertionError("the work began")

    monkeypatch.setattr(MarkerTracker, "detect", never)
    video = made.video("robot", ROBOT)
    (tmp_path / "file").write_text("", encoding="utf-8")
    words = (*LONE, "--id", 0)
    assert "cannot be written" in refusal(made, video, *words, out=tmp_path / "file" / "p.csv")
    assert "a folder; expected the name" in refusal(made, video, *words, out=tmp_path)
    assert "expected one that ends in .png or .jpg" in refusal(
        made, video, *words, "--preview", tmp_path / "p.docx"
    )
    blocked = tmp_path / "file" / "p.png"
    assert "cannot be written" in refusal(made, video, *words, "--preview", blocked)


WRONG_TARGETS = {
    "": "target",
    "[[target]]": "no marker; expected",
    TARGETS.replace('"two"', '"one"'): "two targets have the same name",
    TARGETS.replace("first_id = 7", "first_id = 0"): "marker 0 occurs twice",
    TARGETS.replace("first_id = 7", "first_id = 50"): "marker 50; expected 0 to 49",
    TARGETS.replace("0.131", "-1.0"): "size_m",
    TARGETS.replace("0.131", "131.0"): "size_m: 131.0; expected",
    TARGETS.replace("height_m = 0.25", "height_m = -0.1"): "height_m: -0.1; expected",
    TARGETS.replace("[0.1, -0.05]", "[1e6, 0.0]"): "place_m[1]: 1000000.0; expected",
    TARGETS.replace("height_m", "hight_m"): "height_m",
    TARGETS.replace('name = "two"', 'name = "a/b"'): "name",
    TARGETS.replace('name = "two"', 'dictionary = "5X5_50"\nname = "two"'): "several dictionaries",
    TARGETS.replace('name = "two"', 'dictionary = "9X9"\nname = "two"'): "no marker dictionary",
    TARGETS.replace("height_m = 0.25", "height_m = 1.7"): "below the camera",
    "[[target": "targets.toml",
}


@pytest.mark.parametrize("text", WRONG_TARGETS)
def test_wrong_targets(made, tmp_path, text):
    (tmp_path / "targets.toml").write_text(text, encoding="utf-8")
    words = ("--targets", tmp_path / "targets.toml", "--quiet")
    message = refusal(made, made.video("robot", ROBOT), *words)
    assert WRONG_TARGETS[text] in message
