"""`slipid calibrate`: the files it writes, and one message for each bad input."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from slipid.camera.calibration.board import Board, Picture, board_of, view_of
from slipid.camera.calibration.calibrate import floor_from_points, lens_from_file
from slipid.camera.calibration.views import usable
from slipid.camera.overhead import OverheadCamera
from slipid.support.errors import DataError
from tests.helpers import made_boards as made
from tests.helpers.calibrated import BOARD, CAMERA, GRID, SIZE, TRUE, WORDS, floor_points, picture
from tests.helpers.shared import invoke


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("7by5", 0.04, 0.03, "4X4_50", False), "7by5; expected the numbers of squares"),
        (("2x5", 0.04, 0.03, "4X4_50", False), "3x3 or more"),
        (("7x5", 0.03, 0.04, "4X4_50", False), "markers smaller than squares"),
        (("7x5", 40.0, 30.0, "4X4_50", False), "40 m; expected metres, and 1 m at most"),
        (("20x20", 0.04, 0.03, "4X4_50", False), "200 markers, but dictionary 4X4_50 has 50"),
        (("7x5", 0.04, 0.03, "4X4_51", False), "no marker dictionary '4X4_51'"),
    ],
)
def test_boards_that_cannot_be_are_refused(words, message):
    with pytest.raises(DataError, match=message):
        board_of(*words)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"columns": 5, "rows": 7}, "--board 7x5 --dictionary 4X4_50 without --legacy"),
        ({"dictionary": "6X6_250"}, "--board 7x5 --dictionary 4X4_50"),
        ({"columns": 9, "rows": 8}, "found 17 markers of 4X4_50 with numbers from 0 to 16"),
        ({"columns": 9, "rows": 8, "dictionary": "6X6_250"}, "use --dictionary 4X4_50"),
    ],
    ids=["swapped", "dictionary", "size", "both"],
)
def test_another_board_is_named(folder, change, message):
    other = replace(BOARD, **change)
    with pytest.raises(DataError, match=message) as caught:
        usable(other, [picture(folder / "lens" / "view04.png")])
    assert f"looked for {other}" in str(caught.value)


def test_legacy_boards_are_distinguished(tmp_path):
    print_ = made.drawing(7, 6, legacy=True)
    image = made.photo(TRUE, made.held(10, 5, 3, (0, 0, 0.5)), 0, print_=print_)
    picture = Picture(tmp_path / "old.png", image)
    old = Board(7, 6, 0.04, 0.03, legacy=True)
    assert len(view_of(old, picture).pixels) == 30
    with pytest.raises(DataError, match="7x6 --dictionary 4X4_50 --legacy"):
        usable(replace(old, legacy=False), [picture])


def test_command_writes_camera_and_pictures(camera_file, folder):
    out, done = camera_file
    assert done.exit_code == 0, done.output
    camera = OverheadCamera.load(out)
    assert np.abs(camera.place - CAMERA).max() < 0.002
    for text in ("held out of the fit", "verdict: good", "check by tape: the lens hangs 0.60"):
        assert text in done.output
    assert "H / (H - h)" in done.output
    assert camera.scale_std is not None
    for name in ("camera_coverage.png", "camera_floor.png"):
        assert cv2.imread(str(out.with_name(name))).std() > 5


def test_command_takes_a_known_lens(camera_file, tmp_path):
    points, _ = floor_points(GRID)
    path, out = tmp_path / "p.csv", tmp_path / "here.json"
    rows = np.c_[points.pixels, points.places[:, :2]]
    np.savetxt(path, rows, delimiter=",", header="u,v,x,y", comments="")
    given = ("calibrate", "--camera", camera_file[0], "--points", path, "--out", out)
    done = invoke(*given, "--json", "-", "--quiet")
    assert done.exit_code == 0, done.output
    camera = OverheadCamera.load(out)
    assert np.abs(camera.place - [0.1, -0.2, 2.4]).max() < 0.02
    assert json.loads(done.stdout)["place_m"] == camera.place.tolist()
    assert len(camera.report["lens"]["views"]) == 14
    known, first = lens_from_file(out), lens_from_file(camera_file[0])
    assert known.covariance.shape == (8, 8)
    np.testing.assert_array_equal(known.covariance, first.covariance)
    text = camera_file[0].read_text()
    for odd in ('"words"', "[[1, 2], [3]]", "null"):
        content = json.loads(text)
        content["report"]["lens"]["covariance"] = json.loads(odd)
        (tmp_path / "odd.json").write_text(json.dumps(content))
        assert lens_from_file(tmp_path / "odd.json").covariance is None
    assert floor_from_points(known, path, 0.01).camera.scale_std > 0.01


def test_command_makes_a_camera_without_calibration(folder, tmp_path):
    out = tmp_path / "camera.json"
    described = ("--metres-per-pixel", 0.004, "--lens-height", 2.4, "--turn", 180, "--out", out)
    done = invoke("calibrate", folder / "empty.png", *described)
    assert done.exit_code == 0
    assert "100 pixels are 0.4000 m" in done.output
    camera = OverheadCamera.load(out)
    assert camera.lens.image_px == SIZE
    np.testing.assert_allclose(camera.pixels(np.array([0.4, 0, 0])), [219.5, 239.5], atol=1e-9)


def test_neither_a_picture_nor_the_lens_is_overwritten(folder, camera_file, tmp_path):
    own, lens = tmp_path / "own.png", tmp_path / "lens.json"
    shutil.copy(folder / "empty.png", own)
    shutil.copy(camera_file[0], lens)
    described = ("--metres-per-pixel", 0.004, "--lens-height", 2.4)
    done = invoke("calibrate", own, *described, "--out", own)
    assert (done.exit_code, own.read_bytes()) == (2, (folder / "empty.png").read_bytes())
    assert "own.png: exists and was not written by slipid" in done.stderr
    done = invoke("calibrate", "--camera", lens, "--points", tmp_path / "p.csv", "--out", lens)
    assert (done.exit_code, lens.read_bytes()) == (2, camera_file[0].read_bytes())
    assert "also the file of" in done.stderr


def test_a_poor_lens_is_written_with_exit_code_1(folder, tmp_path):
    out = tmp_path / "camera.json"
    pictures = [folder / "lens" / f"view{k:02d}.png" for k in (0, 1, 2, 3, 4, 5, 6, 8)]
    done = invoke("calibrate", *pictures, *WORDS, "--out", out, "--quiet")
    assert done.exit_code == 1
    assert "POOR: 8 views; expected 10" in done.output
    assert np.abs(lens_from_file(out).lens.matrix[0, 0] - TRUE.fx) < 5
    with pytest.raises(DataError, match="without a pose above the floor"):
        OverheadCamera.load(out)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("absent.png", *WORDS), "absent.png: No such file"),
        (("nothing.png", *WORDS), "nothing.png: the file is empty"),
        (("words.png", *WORDS), "words.png: not an image"),
        (("absent*.png", *WORDS), "no file matches this pattern"),
        (("floor.png", "small.png", *WORDS), "small.png: 320 x 240 pixels, but .*floor.png has"),
        (("floor.png", "empty.png", *WORDS), "1 usable views"),
        (("floor.png",), "--board is missing"),
        (("floor.png", *WORDS[:4]), "--marker is missing"),
        (("--camera", "c.json"), "nothing to determine the pose; expected --floor"),
        (("floor.png", "--camera", "c.json"), "either pictures"),
        (("--camera", "c.json", "--floor", "small.png", *WORDS), "320 x 240 .*640 x 480"),
        (("--camera", "c.json", "--floor", "floor.png", "--points", "p.csv"), "one of them"),
        (("--camera", "c.json", "--points", "absent.csv"), "absent.csv: No such file"),
        (("floor.png", "--metres-per-pixel", "0.004"), "--lens-height is missing"),
        (
            ("floor.png", "--metres-per-pixel", "-1", "--lens-height", "2"),
            "'--metres-per-pixel'",
        ),
        (("floor.png", "--turn", "9", *WORDS), "a camera without calibration"),
    ],
)
def test_bad_input_is_one_message(folder, camera_file, monkeypatch, words, message):
    monkeypatch.chdir(folder)
    (folder / "c.json").write_bytes(camera_file[0].read_bytes())
    done = invoke("calibrate", *words, "--quiet", "--out", "unwritten.json")
    assert done.exit_code == 2
    assert re.search(message, done.stderr), done.stderr
    assert not (folder / "unwritten.json").exists()
