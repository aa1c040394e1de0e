"""The camera's file, and conversions between pixels and places at a height."""

from __future__ import annotations

import json

import numpy as np
import pytest

from slipid.camera.calibration.calibrate import lens_from_file
from slipid.camera.opencv import marker_dictionary
from slipid.camera.overhead import OverheadCamera, read_camera
from slipid.camera.picture_file import read_picture
from slipid.support.errors import DataError
from tests.helpers.made_videos import Stage, lens_of

STAGE = Stage(lens_of(640, bend=-0.2), tilt=(12.0, -8.0, 70.0))


def test_pixels_are_those_of_the_lens_written_out():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.7, 0.7, (50, 2)), rng.uniform(0, 0.5, 50)])
    away = (points - STAGE.place) @ STAGE.rotation.T
    np.testing.assert_allclose(STAGE.camera.pixels(points), STAGE.lens.project(away), atol=1e-6)


@pytest.mark.parametrize("height", [0.0, 0.25, -0.1])
def test_places_on_a_plane_come_back(height):
    flat = np.random.default_rng(1).uniform(-0.7, 0.7, (6, 5, 2))
    points = np.concatenate([flat, np.full((6, 5, 1), height)], axis=-1)
    back = STAGE.camera.on_plane(STAGE.camera.pixels(points), height)
    np.testing.assert_allclose(back, flat, atol=1e-6)
    assert STAGE.camera.on_plane(np.zeros((0, 2)), height).shape == (0, 2)
    assert STAGE.camera.pixels(np.zeros((0, 3))).shape == (0, 2)


def test_a_plane_above_the_lens_is_not_seen():
    assert np.isnan(STAGE.camera.on_plane(np.array([[300.0, 200.0]]), 2.3)).all()


def test_a_camera_that_looks_straight_down():
    camera = OverheadCamera.straight_down((101, 51), 0.01, 2.0)
    np.testing.assert_allclose(camera.pixels(np.array([[0.1, 0.2, 0.0]])), [[60.0, 5.0]])
    np.testing.assert_allclose(camera.pixels(np.array([[0.1, 0.2, 1.0]])), [[70.0, -15.0]])
    turned = OverheadCamera.straight_down((101, 51), 0.01, 2.0, turn_deg=180.0)
    np.testing.assert_allclose(turned.pixels(np.array([[0.1, 0.2, 0.0]])), [[40.0, 45.0]])
    left = OverheadCamera.straight_down((101, 51), 0.01, 2.0, turn_deg=90.0)
    np.testing.assert_allclose(left.pixels(np.array([[0.1, 0.0, 0.0]])), [[50.0, 15.0]])
    for one in (camera, turned, left):
        assert np.linalg.det(one.rotation) == pytest.approx(1.0)


def test_a_file_keeps_all_of_a_camera(tmp_path):
    STAGE.camera.save(tmp_path / "camera.json")
    again = OverheadCamera.load(tmp_path / "camera.json")
    assert again.to_json() == STAGE.camera.to_json()
    assert again.height == 2.2
    again.lens.check_size((640, 360), "v.avi")
    with pytest.raises(DataError, match=r"1280 x 720 pixels, but the camera was calibrated at 640"):
        again.lens.check_size((1280, 720), "v.avi")


def test_a_lens_without_a_floor_is_no_overhead_camera(tmp_path):
    path = tmp_path / "lens.json"
    path.write_text(json.dumps(changed(rotation_from_world=None)), encoding="utf-8")
    assert read_camera(path).rotation_from_world is None
    with pytest.raises(DataError, match="a lens without a pose above"):
        OverheadCamera.load(path)


def changed(**values):
    return {k: v for k, v in (STAGE.camera.to_json() | values).items() if v is not None}


WRONG = {
    "another schema": ({"schema": "slipid.map/1"}, "schema"),
    "no size": ({"image_px": [0, 360]}, "image_px"),
    "no focal length": ({"matrix": [[0, 0, 1], [0, 1, 1], [0, 0, 1]]}, "expected .*f, 0, x"),
    "short matrix": ({"matrix": [[1, 0, 1], [0, 1, 1]]}, "matrix"),
    "three of distortion": ({"distortion": [0.1, 0.1, 0.1]}, "3 distortion coefficients"),
    "a mirror": ({"rotation_from_world": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "not a rotation"),
    "stretched": ({"rotation_from_world": [[2, 0, 0], [0, -1, 0], [0, 0, -1]]}, "not a rotation"),
    "looks up": ({"rotation_from_world": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "looks up"),
    "under the floor": ({"place_m": [0, 0, -1]}, r"place_m\[3\]: -1; expected .* from 0 to"),
    "a word": ({"place_m": [0, 0, "high"]}, "place_m"),
    "infinite focal length": (
        {"matrix": [[1e308, 0, 1], [0, 1e308, 1], [0, 0, 1]]},
        r"matrix\[1\]\[1\]: 1e\+308; expected a number from -1e\+06 to 1e\+06",
    ),
    "no lens": ({"matrix": [[1e-9, 0, 1], [0, 1e-9, 1], [0, 0, 1]]}, "f above 1"),
    "middle elsewhere": ({"matrix": [[500, 0, 1281], [0, 500, 1], [0, 0, 1]]}, "near it"),
    "skew": ({"matrix": [[500, 3, 320], [0, 500, 180], [0, 0, 1]]}, "f, 0, x"),
    "distortion": ({"distortion": [0, 0, 1e308, 0]}, r"distortion\[3\]: 1e\+308; expected"),
    "far away": ({"place_m": [-1e308, 0, 2]}, r"place_m\[1\]: -1e\+308; expected"),
    "in space": ({"place_m": [0, 0, 2e4]}, r"place_m\[3\]: 20000.0; expected .* to 10000 m"),
    "vague": ({"scale_std": 1.5}, "scale_std: 1.5; expected"),
    "backwards": ({"frame_s": -0.1}, "frame_s: -0.1; expected"),
    "spare": ({"colour": "red"}, "colour"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files_are_refused(name, tmp_path):
    values, words = WRONG[name]
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(changed(**values)), encoding="utf-8")
    with pytest.raises(DataError, match=words) as refused:
        OverheadCamera.load(path)
    assert str(path) in str(refused.value)


def test_a_report_of_other_programs_does_no_harm(tmp_path):
    path = tmp_path / "camera.json"
    report = {"lens": {"poor": 3}, "poor": 1, "notes": 2}
    path.write_text(json.dumps(changed(report=report)), encoding="utf-8")
    assert lens_from_file(path).report == {"lens": {"poor": 3}, "poor": [], "notes": []}


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '"camera"', "\x00"])
def test_files_that_are_no_camera_are_refused(text, tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=r"camera\.json"):
        OverheadCamera.load(path)
    with pytest.raises(DataError, match="No such file"):
        OverheadCamera.load(tmp_path / "absent.json")


def test_dictionaries_and_pictures_that_are_not_there(tmp_path):
    assert marker_dictionary("dict_4x4_50").markerSize == 4
    with pytest.raises(DataError, match=r"no marker dictionary '4X4_51'.*4X4_50"):
        marker_dictionary("4X4_51")
    for data, words in ((b"", "the file is empty"), (b"no picture", "not an image")):
        (tmp_path / "a.png").write_bytes(data)
        with pytest.raises(DataError, match=words):
            read_picture(tmp_path / "a.png")
