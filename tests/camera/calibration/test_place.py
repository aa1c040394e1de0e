"""The place of a camera above the floor: by a board, by measured points, or straight down."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slipid.camera.calibration.board import view_of
from slipid.camera.calibration.calibrate import CalibratedLens, floor_from_board
from slipid.camera.calibration.place import fit_place, fit_place_robustly, uncertainty
from slipid.camera.calibration.points import read_points
from slipid.camera.calibration.report import floor_report, marker_height, mm_per_pixel
from slipid.camera.overhead import Lens, OverheadCamera
from slipid.support.errors import DataError
from tests.helpers import made_boards as made
from tests.helpers.calibrated import (
    ABOVE,
    BOARD,
    CAMERA,
    GRID,
    LENS,
    NUMBERS,
    SIZE,
    TRUE,
    floor_points,
    log_length,
    picture,
)

FAR = np.array([5e5, 5.4e6, 0.0])
"""An easting and a northing of UTM [m]."""


def test_the_lying_board_gives_the_place(calibrated, folder):
    camera = floor_from_board(calibrated, BOARD, folder / "floor.png", 0.0, 0.001).camera
    assert np.abs(camera.place - CAMERA).max() < 0.002
    assert np.abs(camera.rotation - made.from_world(ABOVE)).max() < 0.004
    floor = camera.report["floor"]
    assert np.abs((camera.place - CAMERA) / floor["place_std_m"]).max() < 3
    assert floor["tilt_deg"] == pytest.approx(5.0, abs=0.3)
    # world: x along the columns, y up the rows, origin in the middle of the board
    corner = camera.on_plane(view_of(BOARD, picture(folder / "floor.png")).pixels[:1], 0.0)[0]
    np.testing.assert_allclose(corner, [-2.5 * 0.04, 1.5 * 0.04], atol=3e-4)
    assert camera.scale_std == floor["scale_std"] >= 0.001


def test_a_board_above_the_floor_is_taken_as_such(calibrated, folder):
    low = floor_from_board(calibrated, BOARD, folder / "floor.png", 0.0, 0.001).camera
    high = floor_from_board(calibrated, BOARD, folder / "floor.png", 0.02, 0.001).camera
    assert high.height - low.height == pytest.approx(0.02, abs=1e-6)
    assert mm_per_pixel(high) > 1.02 * mm_per_pixel(low)


def test_uncertainty_of_the_lens_reaches_the_floor(calibrated, folder):
    given = (BOARD, folder / "floor.png", 0.0, 0.001)
    known = CalibratedLens(calibrated.lens, {})
    stds = [
        floor_from_board(lens, *given).camera.report["floor"]["height_std_m"]
        for lens in (known, calibrated)
    ]
    assert stds[1] > 1.1 * stds[0]
    # height goes as the focal length: its own part of the camera's height at the least
    focal = calibrated.report["lens"]["numbers"]["fx"]
    assert stds[1] > 0.6 * focal["std"] / focal["value"] * CAMERA[2]


@pytest.mark.slow
def test_stated_place_is_that_of_repetitions():
    off, lengths, stated = [], [], []
    for seed in range(24):
        points, rotation = floor_points(GRID, seed=seed)
        fit = fit_place("here", LENS, points)
        spread = uncertainty(fit, None)
        off.append((fit.camera.place - [0.1, -0.2, 2.4]) / spread.place_std_m)
        lengths.append(log_length(fit.camera))
        stated.append(spread.scale_std)
        assert np.abs(fit.camera.rotation - rotation).max() < 0.02
    assert 0.75 < np.sqrt(np.mean(np.square(off))) < 1.3
    assert np.std(lengths) == pytest.approx(np.mean(stated), rel=0.35)


def test_a_lens_that_is_off_moves_the_place_as_stated():
    """Exact points through lenses drawn from a covariance give places that scatter as stated."""
    points, _ = floor_points(GRID, noise=0.0)
    covariance = np.diag([3.0, 3.0, 4.0, 4.0, 1e-3, 1e-3, 1e-4, 1e-4]) ** 2
    rng, places, lengths = np.random.default_rng(1), [], []
    for _ in range(60):
        fx, fy, cx, cy, *bend = rng.multivariate_normal(NUMBERS, covariance)
        off = Lens(SIZE, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(bend))
        camera = fit_place("here", off, points).camera
        places.append(camera.place)
        lengths.append(log_length(camera))
    spread = uncertainty(fit_place("here", LENS, points), covariance)
    np.testing.assert_allclose(np.std(places, axis=0), spread.place_std_m, rtol=0.35)
    # the height follows the focal length, so that lengths hardly change
    assert np.std(lengths) == pytest.approx(spread.scale_std, rel=0.3)
    assert spread.scale_std < 0.5 * 3.0 / TRUE.fx


def test_a_bad_point_is_left_out_or_reported():
    points, _ = floor_points(GRID)
    points.pixels[5] += [12.0, -9.0]
    fit = fit_place_robustly("here", LENS, points)
    assert len(fit.left_out) == 1
    assert fit.left_out[0].startswith("point row 7 is off by 1")
    assert fit.left_out[0].endswith("left out")
    assert "row 7" not in fit.points.names
    assert np.abs(fit.camera.place - [0.1, -0.2, 2.4]).max() < 0.02
    assert not fit.disputed
    assert fit_place_robustly("here", LENS, floor_points(GRID)[0]).left_out == ()


@pytest.mark.parametrize(("noise", "is_poor"), [(1.0, False), (2.0, True)])
def test_points_that_are_off_by_two_pixels_are_reported(noise, is_poor):
    points, _ = floor_points(GRID, noise=noise)
    fit = fit_place("here", LENS, points)
    assert noise < fit.rms_px < 1.5 * noise
    sentences = floor_report("here", fit, uncertainty(fit, None), 0.001)["poor"]
    assert any("points on the floor are off by" in one for one in sentences) == is_poor


def test_a_point_that_is_anywhere_is_left_out():
    for index in range(6):
        points, _ = floor_points(GRID[1:3] + GRID[6:8] + GRID[9::2], seed=4)
        points.pixels[index] = [330.0 - 50 * index, 20.0 + 80 * index]
        fit = fit_place_robustly("here", LENS, points)
        assert fit.left_out[0].startswith(f"point row {index + 2} is off")
        assert np.abs(fit.camera.place - [0.1, -0.2, 2.4]).max() < 0.05


@pytest.mark.parametrize(("count", "message"), [(5, "NOT left out"), (4, "not possible to tell")])
def test_with_few_points_a_bad_one_is_reported(count, message):
    places = [(-0.9, -0.7, 0), (1.0, -0.6, 0), (0.9, 0.6, 0), (-0.8, 0.6, 0), (0.1, 0.2, 0)]
    points, _ = floor_points(places[:count])
    points.pixels[2] += [25.0, 14.0]
    fit = fit_place_robustly("here", LENS, points)
    assert message in fit.left_out[0]
    assert fit.disputed
    assert len(fit.points.names) == count


def test_points_at_different_heights_and_far_from_the_origin():
    origin = np.array([30.0, -20.0, 0])
    places = origin + np.array([*GRID, (0.2, 0.3, 0.4), (-0.5, -0.3, 0.2)])
    points, rotation = floor_points(places, camera=(30.1, -20.2, 2.4), noise=0.0)
    fit = fit_place("here", LENS, points)
    np.testing.assert_allclose(fit.camera.place, [30.1, -20.2, 2.4], atol=1e-5)
    np.testing.assert_allclose(fit.camera.rotation, rotation, atol=1e-6)
    np.testing.assert_allclose(fit.off_mm, 0, atol=0.01)


def test_residuals_are_also_given_on_the_floor():
    points, _ = floor_points(GRID, tilt=(0.0, 0.0))
    fit = fit_place("here", LENS, points)
    mm = 2400 / TRUE.fx
    np.testing.assert_allclose(
        np.hypot(*fit.off_mm.T), mm * np.hypot(*fit.residuals.T), rtol=0.35, atol=0.02
    )
    assert mm_per_pixel(fit.camera) == pytest.approx(mm, rel=0.005)


def test_a_camera_that_looks_up_is_refused():
    places = [(x, y, 0.0) for x in (-1.0, 0.0, 1.0) for y in (3.0, 4.0, 6.0)]
    points, rotation = floor_points(places, camera=(0.0, 0.0, 1.0), tilt=(-95.0, 0.0), noise=0.0)
    depths = (points.places - [0.0, 0.0, 1.0]) @ rotation[2]
    assert (depths > 0).all()  # they are in view, although the axis points at the sky
    with pytest.raises(DataError, match="looks down"):
        fit_place("here", LENS, points)


def test_points_of_a_left_handed_world_are_refused():
    points, _ = floor_points(GRID)
    mirrored = replace(points, places=points.places * [1, -1, 1])
    with pytest.raises(DataError, match="right-handed"):
        fit_place("here", LENS, mirrored)


def test_a_place_that_has_a_twin_says_so():
    places = 0.06 * np.array(GRID)
    points, _ = floor_points(places, tilt=(25.0, 0.0), camera=(0.0, 1.1, 2.4), noise=0.3, seed=1)
    fit = fit_place("here", LENS, points)
    assert fit.twin_px is not None
    assert fit.twin_px >= fit.rms_px
    assert fit_place("here", LENS, floor_points(GRID)[0]).twin_px is None


@pytest.mark.parametrize("turn", [0.0, 90.0, 180.0, 200.0])
def test_straight_down_reads_lengths_at_the_marker_height(turn):
    camera = OverheadCamera.straight_down((641, 481), 0.004, 2.4, turn)
    marker = np.array([[0.3, -0.2, 0.25], [-0.4, 0.5, 0.25]])
    pixels = camera.pixels(marker)
    length = np.linalg.norm(marker[0] - marker[1])
    right, wrong = (camera.on_plane(pixels, h) for h in (0.25, 0.0))
    np.testing.assert_allclose(right, marker[:, :2], atol=1e-12)
    longer = np.linalg.norm(wrong[0] - wrong[1]) / length
    assert longer == pytest.approx(2.4 / (2.4 - 0.25))
    assert longer == pytest.approx(1.116, abs=5e-4)
    assert "11.6 % too long" in marker_height(2.4)
    x, y = camera.pixels(np.array([[0.4, 0, 0], [0, 0.4, 0]])) - [320, 240]
    cosine, sine = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    np.testing.assert_allclose(x, [100 * cosine, -100 * sine], atol=1e-9)
    np.testing.assert_allclose(y, [-100 * sine, -100 * cosine], atol=1e-9)


POINTS = "u,v,x,y\n100,100,0,1\n500,100,1,1\n500,400,1,0\n100,400,0,0\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("u,v,x\n1,2,3\n", "no column y.*expected u, v"),
        (POINTS.replace("500,400", "many,400"), "row 4, column 'u': 'many'; expected a number"),
        (POINTS.replace("500,400", "500,1e308"), "row 4, column 'v': '1e308'; expected .* 100000"),
        (POINTS.replace("500,400", "nan,400"), "row 4, column 'u': 'nan'"),
        (POINTS.replace("1,0\n", "1\n"), "row 4, column 'y': nothing"),
        (POINTS.replace("500,400", "900,400"), "row 4: u = 900.*640 x 480"),
        ("u,v,x,y\n1,1,0,0\n2,2,1,0\n3,9,5,5\n", "3 points; expected 4"),
        ("u,v,x,y\n1,1,0,0\n200,20,1,1\n300,30,2,2\n400,400,3,3\n", "one line on the floor"),
        ("u,v,x,y\n1,1,0,0\n200,200,1,0\n300,300,2,2\n400,400,3,4\n", "one line in the image"),
    ],
)
def test_bad_files_of_points_are_refused(tmp_path, text, message):
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        read_points(path, SIZE)
    assert str(caught.value).startswith(str(path))


def test_points_are_read_with_height_and_other_delimiters(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("# by tape\nname; V;U;X;Y;z\na;10;20;1;2;0.5\nb;30;400;2;2;0\n"
                    "c;300;20;1;1;0\n\nd;300;400;2;1;0\n")  # fmt: skip
    points = read_points(path, SIZE)
    np.testing.assert_array_equal(points.pixels[0], [20, 10])
    np.testing.assert_array_equal(points.places[0], [1, 2, 0.5])
    assert points.names == ("row 3", "row 4", "row 5", "row 7")


def test_far_from_the_origin_a_camera_is_placed_as_near_it():
    """Coordinates of UTM have millions of metres."""
    near, _ = floor_points(GRID)
    far = replace(near, places=near.places + FAR)
    fits = [fit_place_robustly("here", LENS, points) for points in (near, far)]
    np.testing.assert_allclose(fits[1].camera.place - FAR, fits[0].camera.place, atol=1e-5)
    stds = [uncertainty(fit, None) for fit in fits]
    assert stds[1].scale_std == pytest.approx(stds[0].scale_std, rel=1e-3)
    np.testing.assert_allclose(stds[1].place_std_m, stds[0].place_std_m, rtol=1e-3)


def test_points_and_cameras_may_have_coordinates_of_utm(tmp_path):
    path = tmp_path / "points.csv"
    points, _ = floor_points(GRID)
    rows = np.c_[points.pixels, (points.places + FAR)[:, :2]]
    np.savetxt(path, rows, "%.6f", ",", header="u,v,x,y", comments="")
    read = read_points(path, SIZE)
    np.testing.assert_allclose(read.places[:, :2], (points.places + FAR)[:, :2], atol=1e-5)
    camera = fit_place("here", LENS, read).camera
    camera.save(tmp_path / "camera.json")
    assert OverheadCamera.load(tmp_path / "camera.json").place.tolist() == camera.place.tolist()
    path.write_text("u,v,x,y\n1,2,3,2e8\n")
    with pytest.raises(DataError, match=r"'2e8'; expected a number from -1e\+08 to 1e\+08 m"):
        read_points(path, SIZE)
