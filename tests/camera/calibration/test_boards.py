"""Boards without markers, printed white on black or mirrored, and refusals with a picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from slipid.camera import search
from slipid.camera.calibration.board import Board, Chessboard, Picture, view_of
from slipid.camera.calibration.calibrate import lens_from_file
from slipid.camera.calibration.quality import Coverage
from slipid.camera.calibration.views import usable
from slipid.camera.overhead import OverheadCamera
from slipid.support.errors import DataError
from tests.helpers import made_boards as made
from tests.helpers.calibrated import BOARD, TRUE, WORDS
from tests.helpers.shared import invoke

PLAIN = ("--chessboard", "6x4", "--square", "0.04")


def chessboard() -> np.ndarray:
    """Return the printed board of `made_boards` without its markers."""
    down, across = np.indices((made.ROWS, made.COLUMNS))
    squares = 20 + 215 * ((down + across) % 2).astype(np.uint8)
    board = np.kron(squares, np.ones((made.DOTS, made.DOTS), np.uint8))
    return cv2.copyMakeBorder(board, *[made.DOTS] * 4, cv2.BORDER_CONSTANT, value=235)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """Return a folder with pictures of a plain chessboard."""
    folder = tmp_path_factory.mktemp("plain")
    for k, place in enumerate(made.places()):
        made.write(made.photo(TRUE, place, k, print_=chessboard()), folder / f"view{k:02d}.png")
    return folder


def test_a_plain_chessboard_gives_the_lens(plain, tmp_path):
    out = tmp_path / "camera.json"
    done = invoke("calibrate", plain, *PLAIN, "--out", out, "--quiet")
    assert done.exit_code in (0, 1), done.output
    matrix = lens_from_file(out).lens.matrix
    off = matrix[[0, 1, 0, 1], [0, 1, 2, 2]] - [TRUE.fx, TRUE.fy, TRUE.cx, TRUE.cy]
    assert np.abs(off).max() < 1.5
    assert "a chessboard with 6x4 inner corners" in done.output


def test_corners_of_a_large_chessboard_picture_are_exact():
    lens = made.TrueLens(1600, 1200, 1300.0, 1307.0, 815.0, 582.0)
    place = made.held(20, 15, 10, (0.0, 0.0, 0.5))
    image = made.photo(lens, place, 0, print_=chessboard())
    view = view_of(Chessboard(7, 5, 0.04), Picture(Path("a.png"), image))
    solid = np.c_[view.board_m, np.zeros(24)]
    true = lens.project(solid @ place.rotation.T + place.shift)
    turned = lens.project((np.r_["-1", [0.28, 0.2] - view.board_m, np.zeros((24, 1))])
                          @ place.rotation.T + place.shift)  # fmt: skip
    off = min(np.abs(view.pixels - one).max() for one in (true, turned))
    assert off < 0.15


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--chessboard", "6by4", "--square", "0.04"), "6by4; expected the numbers of inner"),
        (("--chessboard", "6x4"), "--square is missing"),
        (("--chessboard", "1x4", "--square", "0.04"), "2x5 squares; expected 3x3 or more"),
        ((*PLAIN, "--marker", "0.03"), "--chessboard is given with --board or --marker"),
        ((*PLAIN, "--floor", "view00.png"), "looks the same after half a turn"),
        (WORDS, "found a chessboard without markers: use --chessboard 6x4"),
        (("--chessboard", "7x5", "--square", "0.04"), "numbers of its inner corners"),
    ],
)
def test_wrong_words_for_a_chessboard_are_named(plain, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(plain)
    out = tmp_path / "no.json"
    done = invoke("calibrate", "view04.png", *words, "--out", out, "--quiet")
    assert done.exit_code == 2
    assert message in done.stderr
    assert not out.exists()


def test_a_grid_of_irregular_steps_is_no_chessboard(plain, monkeypatch):
    picture = Picture(plain / "view04.png", cv2.imread(str(plain / "view04.png")))
    board, usual = Chessboard(7, 5, 0.04), cv2.findChessboardCornersSB
    assert len(view_of(board, picture).pixels) == 24

    def with_one_moved(*args, **named):
        found, corners = usual(*args, **named)
        return found, corners + 25 * (np.arange(corners.size) == 16).reshape(corners.shape)

    monkeypatch.setattr(cv2, "findChessboardCornersSB", with_one_moved)
    assert not len(view_of(board, picture).pixels)


def test_a_board_with_markers_is_no_plain_chessboard(folder):
    picture = Picture(folder / "lens" / "view04.png", cv2.imread(str(folder / "lens/view04.png")))
    with pytest.raises(DataError, match=r"found 17 markers of 4X4_50: a board with markers needs"):
        usable(Chessboard(12, 9, 0.04), [picture])


def test_a_board_printed_white_on_black_is_read(folder, tmp_path):
    for path in sorted((folder / "lens").iterdir()):
        made.write(255 - cv2.imread(str(path)), tmp_path / "dark" / path.name)
    out = tmp_path / "camera.json"
    done = invoke("calibrate", tmp_path / "dark", *WORDS, "--out", out, "--quiet")
    assert done.exit_code == 0, done.output
    assert "the board is printed white on black" in done.output
    assert abs(lens_from_file(out).lens.matrix[0, 0] - TRUE.fx) < 1.5


def test_a_mirrored_board_is_named(folder):
    image = cv2.imread(str(folder / "lens" / "view04.png"))[:, ::-1]
    for board in (BOARD, Board(7, 5, 0.04, 0.03, "6X6_250")):
        with pytest.raises(
            DataError, match="17 markers of 4X4_50, which can be read only mirrored"
        ):
            usable(board, [Picture(folder / "view04.png", image)])


def test_each_dictionary_is_searched_on_a_small_sheet(folder, monkeypatch):
    sizes = []
    usual = search._sheet

    def noted(picture):
        sheet = usual(picture)
        sizes.append(sheet.size)
        return sheet

    monkeypatch.setattr(search, "_sheet", noted)
    image = cv2.imread(str(folder / "lens" / "view04.png"))
    large = cv2.resize(image, (4000, 3000), interpolation=cv2.INTER_CUBIC)
    steps = []
    visible = search.visible_markers([large], lambda done, total: steps.append((done, total)))
    assert (visible.dictionary, visible.mirrored) == ("4X4_50", False)
    assert visible.numbers == tuple(range(17))
    assert max(sizes) < 0.05 * large.size
    assert steps[0][0] == 0
    assert steps[-1][0] == steps[-1][1] >= 9


@pytest.mark.parametrize("name", ["APRILTAG_36h11", "5X5_1000", "ARUCO_ORIGINAL"])
def test_a_single_marker_is_found_whatever_its_dictionary(name, folder):
    drawn = cv2.aruco.generateImageMarker(search.marker_dictionary(name), 100, 60)
    image = cv2.imread(str(folder / "empty.png"), 0)
    image[100:180, 200:280] = cv2.copyMakeBorder(drawn, *[10] * 4, cv2.BORDER_CONSTANT, value=255)
    visible = search.visible_markers([image])
    assert visible.numbers == (100,)
    assert visible.dictionary.startswith(name.partition("_")[0])


def test_a_refusal_for_coverage_names_the_cells_and_draws_them(tmp_path):
    spots = [made.held(30 * np.cos(k), 30 * np.sin(k), 17.0 * k, (0, 0, 0.9)) for k in range(10)]
    for k, place in enumerate(spots):
        made.write(made.photo(TRUE, place, k), tmp_path / "lens" / f"view{k:02d}.png")
    out = tmp_path / "camera.json"
    done = invoke("calibrate", tmp_path / "lens", *WORDS, "--out", out, "--quiet")
    assert done.exit_code == 2
    assert "row 1: 1-8; " in done.stderr
    assert "camera_coverage.png shows them" in done.stderr
    assert len(done.stderr) < 500 + len(str(tmp_path))
    assert cv2.imread(str(tmp_path / "camera_coverage.png")).std() > 5
    assert not out.exists()


def test_empty_cells_as_text():
    visited = np.ones((3, 4), bool)
    visited[0, [0, 1, 3]] = visited[2, 2] = False
    assert Coverage(visited, 0.0).empty_cells() == "row 1: 1-2, 4; row 3: 3"


def test_orientation_flags_change_no_lens_and_are_reported(folder, tmp_path):
    paths = sorted((folder / "lens").iterdir())
    for k, path in enumerate(paths):
        data = cv2.imencode(".jpg", cv2.imread(str(path)), [cv2.IMWRITE_JPEG_QUALITY, 100])[1]
        made.write_flagged(data.tobytes(), 1 + k % 8, tmp_path / "flagged" / f"{path.stem}.jpg")
        made.write_flagged(data.tobytes(), 1, tmp_path / "plain" / f"{path.stem}.jpg")
    lenses, texts = [], []
    for name in ("plain", "flagged"):
        out = tmp_path / f"{name}.json"
        done = invoke("calibrate", tmp_path / name, *WORDS, "--out", out, "--quiet")
        assert done.exit_code == 0, done.output
        lenses.append(lens_from_file(out).lens)
        texts.append(" ".join(done.output.split()))
    np.testing.assert_allclose(lenses[0].matrix, lenses[1].matrix, rtol=1e-9)
    assert "orientation flag" not in texts[0]
    assert "its orientation flag (EXIF 2) is not applied" in texts[1]
    described = ("--metres-per-pixel", 0.004, "--lens-height", 2.4, "--out", tmp_path / "s.json")
    invoke("calibrate", tmp_path / "flagged" / "view05.jpg", *described)
    straight = OverheadCamera.load(tmp_path / "s.json")
    assert straight.lens.image_px == (640, 480)
    assert "EXIF 6" in straight.report["notes"][0]
