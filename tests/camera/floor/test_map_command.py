"""`slipid map`: its files, its exit codes, and one message for each bad input."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from slipid.camera.floor.grid import RobotShape
from slipid.camera.floor.picture import MapOptions, check_all_present, map_of
from slipid.camera.floor.region import SCHEMA, FloorPicture, Palette
from slipid.camera.overhead import OverheadCamera
from slipid.cli.main import app
from slipid.data.floor_map import read_map
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from tests.helpers.made_floors import COLOURS, POINTS, MadeFloor, aslant
from tests.helpers.mapped_floors import HEAD, IMAGE, REGION, mapped, marked

POINT = '[[points]]\nsurface = "wood"\n'


@pytest.mark.parametrize(
    ("config", "match"),
    [
        (
            '[palette]\na = "#B08a5a"\nb = "#b08a5A"\n',
            "palette.b: '#b08a5A' is also the colour of a; ",
        ),
        ('[palette]\na = "brown"\n', "palette.a: 'brown'; expected"),
        ('[palette]\na = "#ff00ff"\n', "palette.a: '#ff00ff' is nowhere in the image"),
        (POINT, r"points\[1\]: both or neither of at_px and at_m are given"),
        (POINT + "at_px = [[1, 1]]\nat_m = [[0, 0]]\n", "expected exactly one of them"),
        (POINT + "at_px = []\n", r"points\[1\].at_px: \[\]; expected"),
        (POINT + "at_px = [[480, 10]]\n", r"\[480, 10\] is outside the image of 480 x 400"),
        (POINT + "at_m = [[5.0, 0.0]]\n", r"points\[1\]: \[5, 0\] is not visible, outside the reg"),
        (POINT + "at_m = [[-0.75, 0.55]]\n", "on a mask or on a robot; expected a point on"),
        (POINT + "at_px = [[1, 399]]\n" + REGION, "not visible, outside the region"),
        ("[region]\nat_m = [[0, 0], [1, 1]]\n", "region: 2 corners; expected a polygon of 3"),
        ("[region]\nat_m = [[9, 9], [9, 8], [8, 8]]\n", "region: the camera sees no floor in it"),
        ("[region]\nat_px = [[9, 9], [9, 8], [8, 8]]\n", "expected 400 or more"),
        (
            "[region]\nat_m = [[0, 0], [1, 1], [0.5, 0.5]]\n",
            r"camera sees \d+ cells of 8 mm; expected",
        ),
        (
            "[[mask]]\nat_m = [[-9, -9], [9, -9], [9, 9], [-9, 9]]\n",
            "leave 0 cells of visible floor",
        ),
        ("[regions]\n", "regions: no such key, did you mean region"),
        ("[region\n", "not valid TOML"),
    ],
)
def test_errors_in_a_palette_are_reported(made, tmp_path, config, match):
    with pytest.raises(DataError, match=match) as error:
        mapped(made, tmp_path, config)
    assert "palette.toml" in str(error.value) or "floor.png" in str(error.value)


def test_a_surface_that_no_cell_has_is_refused(made):
    source = FloorPicture(IMAGE, made.picture, made.camera, Path("p.toml"), Palette(schema=SCHEMA))
    labels = np.array([[0, 2], [-1, 2]])
    with pytest.raises(
        DataError, match=r"p\.toml: no part of the image is closest in colour to b; "
    ):
        check_all_present(source, ("a", "b", "c"), labels)
    check_all_present(source, ("a",), labels)


def test_pictures_and_cameras_that_do_not_fit_are_refused(made, tmp_path):
    image = tmp_path / "floor.png"
    with pytest.raises(DataError, match=r"floor\.png: No such file.*expected an image"):
        map_of(image, made.camera, MapOptions(), Reporter(quiet=True))
    image.write_bytes(b"")
    with pytest.raises(DataError, match=r"floor\.png: the file is empty"):
        map_of(image, made.camera, MapOptions(), Reporter(quiet=True))
    image.write_bytes(b"no picture at all")
    with pytest.raises(DataError, match="not an image that OpenCV reads"):
        map_of(image, made.camera, MapOptions(), Reporter(quiet=True))
    with pytest.raises(DataError, match="480 x 400 pixels, but the camera was calibrated at 640"):
        mapped(MadeFloor(made.picture, aslant(640), made.truth, None), tmp_path, None)
    with pytest.raises(DataError, match="no marker dictionary '4X4_51', did you mean 4X4_50"):
        mapped(made, tmp_path, REGION, robot=RobotShape("4X4_51"))
    with pytest.raises(DataError, match="expected at most 4000000 in all: a larger --cell"):
        mapped(made, tmp_path, REGION, cell=0.0005)
    with pytest.raises(DataError, match="expected 400 or more: a smaller --cell"):
        mapped(made, tmp_path, REGION, cell=0.9)
    with pytest.raises(DataError, match="already has 5 surfaces; omit --surfaces"):
        mapped(made, tmp_path, REGION + marked(POINTS), surfaces=5)
    with pytest.raises(DataError, match="too few for 30 surfaces; expected an image of a floor"):
        mapped(made, tmp_path, REGION, surfaces=30)


def invoked(*words: object) -> tuple[int, str]:
    """Return exit code and output of a command."""
    done = CliRunner().invoke(app, [str(word) for word in words])
    return done.exit_code, done.output


@pytest.mark.slow
def test_the_command_writes_a_map_that_others_read(made, tmp_path):
    image, camera, out = tmp_path / "floor.png", tmp_path / "camera.json", tmp_path / "out"
    cv2.imwrite(str(image), made.picture)
    made.camera.save(camera)
    (tmp_path / "p.toml").write_text(HEAD + REGION + marked(POINTS))
    common = ("map", image, "--camera", camera, "--robot-radius", 0.17, "--marker-height", 0.2)
    common = (*common, "--cell", 0.01, "--quiet")
    code, text = invoked(
        *common, "--config", tmp_path / "p.toml", "--out", out, "--json", out / "j"
    )
    assert code == 0, text
    assert "robot with marker 7 masked at x -0.75 m, y 0.55 m" in text
    assert cv2.imread(str(out / "map.png")).shape[1] == 1430
    assert not (out / "palette.toml").exists()
    shown = json.loads((out / "j").read_text())
    assert {one["surface"] for one in shown["surfaces"]} == set(COLOURS)
    region = json.loads((out / "map.geojson").read_text())["slipid"]
    assert region["base"] == "wood"
    assert len(region["picture_sha256"]) == 64
    assert sum(one["area_m2"] for one in shown["surfaces"]) == pytest.approx(2.2 * 1.8, rel=0.06)
    floor = read_map(out / "map.geojson")
    for name, places in POINTS.items():
        assert {floor.surfaces[int(k)] for k in floor.at(np.array(places))} == {name}


@pytest.mark.slow
def test_the_command_without_a_config_writes_one_and_keeps_an_edited_one(tmp_path):
    image, out = tmp_path / "floor.png", tmp_path / "out"
    picture = np.full((120, 160, 3), (60, 120, 60), np.uint8)
    picture[:, 80:] = (60, 60, 160)
    cv2.imwrite(str(image), picture)
    OverheadCamera.straight_down((160, 120), 0.01, 2.0).save(tmp_path / "camera.json")
    common = ("map", image, "--camera", tmp_path / "camera.json", "--out", out, "--quiet")
    code, text = invoked(*common)
    assert code == 0, text
    assert "no robot's marker was detected" in text
    assert f"--config {out / 'palette.toml'}" in text
    code, text = invoked(*common)
    assert code == 2
    assert "exists already, and proposing surfaces would overwrite it" in text
    config = (out / "palette.toml").read_text()
    (out / "palette.toml").write_text(config.replace("surface_1", "lawn"))
    code, text = invoked(*common, "--config", out / "palette.toml")
    assert code == 0, text
    assert "lawn" in read_map(out / "map.geojson").surfaces


@pytest.mark.slow
def test_a_poor_map_is_written_and_ends_with_1(tmp_path):
    image, camera, out = tmp_path / "floor.png", tmp_path / "camera.json", tmp_path / "out"
    noise = np.random.default_rng(0).normal(0.0, 6.0, (120, 160, 3))
    cv2.imwrite(str(image), np.clip(np.array([60, 120, 60]) + noise, 0, 255).astype(np.uint8))
    OverheadCamera.straight_down((160, 120), 0.01, 2.0).save(camera)
    both = {"lawn": [(30, 30), (30, 90)], "moss": [(120, 30), (120, 90)]}
    (tmp_path / "p.toml").write_text(HEAD + marked(both, "at_px"))
    words = ("--camera", camera, "--config", tmp_path / "p.toml", "--out", out, "--quiet")
    code, text = invoked("map", image, *words)
    assert code == 1, text
    assert "cannot be distinguished" in text
    assert (out / "map.geojson").is_file()


def test_a_mirrored_picture_is_refused_as_such(made, tmp_path):
    mirrored = replace(made, picture=np.ascontiguousarray(made.picture[:, ::-1]))
    with pytest.raises(DataError, match=r"floor\.png: a robot's marker can be read only mirrored"):
        mapped(mirrored, tmp_path, REGION)


def test_the_command_needs_a_camera_of_these_pictures(tmp_path):
    image, camera = tmp_path / "floor.png", tmp_path / "camera.json"
    cv2.imwrite(str(image), np.arange(3 * 160 * 120).reshape(120, 160, 3) % 251)
    code, text = invoked("map", image, "--out", tmp_path / "out")
    assert (code, "--camera" in text) == (2, True)
    OverheadCamera.straight_down((320, 240), 0.01, 2.0).save(camera)
    code, text = invoked("map", image, "--out", tmp_path / "out", "--camera", camera)
    assert (code, "calibrated at 320 x 240" in text) == (2, True)
    assert not (tmp_path / "out").exists()
