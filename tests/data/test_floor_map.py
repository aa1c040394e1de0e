"""Floor maps: polygons, pictures, files, and what is wrong with some of them."""

import json

import cv2
import numpy as np
import pytest
from matplotlib.image import imsave

from slipid.data.floor_map import (
    FloorMap,
    four_zones,
    from_polygons,
    patchwork,
    read_map,
    uniform,
    write_map,
)
from slipid.data.geojson_map import MapRegion, Patch, VectorMap, covered
from slipid.support.errors import DataError
from tests.helpers.floors import surface_at

UNIT = (0.0, 0.0, 1.0, 1.0)
SQUARE = [[0.2, 0.2], [0.6, 0.2], [0.6, 0.6], [0.2, 0.6]]
CORNER = [[0.5, 0.5], [1.0, 0.5], [1.0, 1.0], [0.5, 1.0]]
GOOD = """
schema = "slipid.map/1"
base = "table"
extent_m = [0.0, 0.0, 1.0, 1.0]
cell_m = 0.01

[[patch]]
surface = "gray"
polygon = [[0.2, 0.2], [0.6, 0.2], [0.6, 0.6], [0.2, 0.6]]
"""


def test_later_patches_lie_on_earlier_ones():
    floor = from_polygons("table", [("gray", SQUARE), ("green", CORNER)], UNIT, 0.01)
    assert floor.surfaces == ("table", "gray", "green")
    places = {(0.1, 0.1): "table", (0.3, 0.3): "gray", (0.55, 0.55): "green", (0.9, 0.3): "table"}
    for (x, y), name in places.items():
        assert surface_at(floor, x, y) == name
    np.testing.assert_array_equal(floor.at(np.array([[0.3, 0.3], [0.9, 0.9]])), [1, 2])
    assert floor.extent == pytest.approx((0, 0, 1, 1))
    share = np.mean(floor.cells == 1)
    assert share == pytest.approx(0.16 - 0.01, abs=0.005)


def test_beyond_the_edge_the_floor_goes_on():
    floor = from_polygons("table", [("green", CORNER)], UNIT, 0.01)
    assert surface_at(floor, 7.0, 8.0) == "green"
    assert surface_at(floor, -1.0, 8.0) == "table"
    assert surface_at(uniform("sand"), 9.0, -9.0) == "sand"


def test_a_place_has_the_surface_of_the_cell_it_lies_in():
    rng = np.random.default_rng(0)
    cells = rng.integers(0, 3, (5, 7))
    made = FloorMap(("a", "b", "c"), cells, (-0.3, 0.2), 0.1)
    row, column = np.indices(cells.shape)
    for aside in rng.uniform(0.02, 0.98, (10, 2)):
        xy = np.stack([column, row], axis=-1) + aside
        np.testing.assert_array_equal(made.at([-0.3, 0.2] + 0.1 * xy), cells)


def test_a_map_comes_back_from_its_file(tmp_path):
    floor = patchwork(["a", "b", "c"], seed=3, half=0.5)
    write_map(tmp_path / "site.toml", floor, {"a": "#102030", "b": "#405060", "c": "#a0b0c0"})
    again = read_map(tmp_path / "site.toml")
    np.testing.assert_array_equal(again.cells, floor.cells)
    assert again.surfaces == floor.surfaces
    assert again.extent == pytest.approx(floor.extent)


def test_a_picture_tells_surfaces_by_the_nearest_colour(tmp_path):
    picture = np.zeros((4, 6, 3))
    picture[:2, :, 1] = 0.45  # green above
    picture[2:, :, 0] = 0.9  # red below
    picture += np.random.default_rng(0).uniform(-0.05, 0.05, picture.shape)
    imsave(tmp_path / "top.png", np.clip(picture, 0, 1))
    (tmp_path / "site.toml").write_text(
        'schema = "slipid.map/1"\npicture = "top.png"\nmetres_per_pixel = 0.1\n'
        'corner_m = [1.0, 2.0]\n[colours]\nlawn = "#007000"\nbrick = "#e00000"\n'
    )
    floor = read_map(tmp_path / "site.toml")
    assert surface_at(floor, 1.3, 2.35) == "lawn"
    assert surface_at(floor, 1.3, 2.05) == "brick"
    assert floor.cells.tolist() == [[1] * 6] * 2 + [[0] * 6] * 2


def test_a_picture_may_be_grey(tmp_path):
    cv2.imwrite(str(tmp_path / "top.png"), np.array([[0, 255]], np.uint8))
    (tmp_path / "site.toml").write_text(
        'schema = "slipid.map/1"\npicture = "top.png"\nmetres_per_pixel = 0.1\n'
        '[colours]\ndark = "#101010"\nlight = "#f0f0f0"\n'
    )
    assert read_map(tmp_path / "site.toml").cells.tolist() == [[0, 1]]


def test_a_patchwork_has_patches_of_its_size_and_is_the_same_again():
    floor = patchwork(["a", "b"], seed=1, patch=0.2)
    np.testing.assert_array_equal(floor.cells, patchwork(["a", "b"], seed=1, patch=0.2).cells)
    assert (floor.cells != patchwork(["a", "b"], seed=2, patch=0.2).cells).any()
    assert set(np.unique(floor.cells)) == {0, 1}
    # neighbouring patches are alike every second time, so an edge comes every 0.4 m or so
    edges = np.mean(np.diff(floor.cells, axis=1) != 0) / floor.cell
    assert 1.0 < edges < 5.0


def test_the_four_zones_meet_in_the_middle_of_the_rectangle():
    floor = four_zones(["a", "b", "c", "d"])
    around = [
        surface_at(floor, x, y) for x, y in ((0.1, 0.0), (0.8, 0.0), (0.8, -0.4), (0.1, -0.4))
    ]
    assert around == ["a", "b", "c", "d"]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (
            ('schema = "slipid.map/1"', 'schema = "map"'),
            "schema: 'map'; expected one of 'slipid.map/1'",
        ),
        (('base = "table"', ""), "base: missing; expected a value"),
        (("extent_m = [0.0, 0.0, 1.0, 1.0]", ""), "extent_m: missing; expected a value"),
        (("[0.0, 0.0, 1.0, 1.0]", "[1.0, 0.0, 0.0, 1.0]"), "expected lowest x, lowest y"),
        (("cell_m = 0.01", "cell_m = 0"), "cell_m: 0; expected a number from 1e-05 to 1 m"),
        (
            ("cell_m = 0.01", "cells_m = 0.01"),
            "cells_m: no such key, did you mean cell_m.*one of schema",
        ),
        (('surface = "gray"', ""), r"patch\[1\].surface: missing; expected a value"),
        ((", [0.6, 0.6], [0.2, 0.6]]", "]"), r"patch\[1\].polygon: .* at least 3 items"),
        (
            ("[0.2, 0.2], [0.6, 0.2]", '["a", 0.2], [0.6, 0.2]'),
            r"patch\[1\].polygon\[1\]\[1\]: 'a'",
        ),
        (("schema", "= ="), "not valid TOML"),
        (("polygon", "polygn"), r"patch\[1\].polygn: no such key, did you mean polygon"),
        (("cell_m = 0.01", "cell_m = 0.0001"), "100000000 cells; expected at most"),
        (
            ("[0.0, 0.0, 1.0, 1.0]", "[0.0, 0.0, 1e9, 1.0]"),
            r"extent_m\[3\]: 1000000000.0; expected",
        ),
        (("[0.2, 0.2]", "[1e9, 0.2]"), r"patch\[1\].polygon\[1\]\[1\]: 1000000000.0; expected"),
    ],
)
def test_errors_of_a_map_are_named(tmp_path, change, match):
    path = tmp_path / "map.toml"
    path.write_text(GOOD)
    assert read_map(path).surfaces == ("table", "gray")
    path.write_text(GOOD.replace(*change))
    with pytest.raises(DataError, match=match) as error:
        read_map(path)
    assert str(path) in str(error.value)


def test_absent_and_broken_pictures_are_named(tmp_path):
    path = tmp_path / "map.toml"
    with pytest.raises(DataError, match="expected a floor map"):
        read_map(path)
    text = 'schema = "slipid.map/1"\npicture = "top.png"\nmetres_per_pixel = 0.1\n'
    path.write_text(text)
    with pytest.raises(DataError, match="colours: missing"):
        read_map(path)
    path.write_text(text.replace("top.png", "../top.png") + '[colours]\na = "#ff0000"\n')
    with pytest.raises(DataError, match=r"picture: '\.\./top\.png' leaves its folder"):
        read_map(path)
    path.write_text(text + '[colours]\na = "red"\n')
    with pytest.raises(DataError, match=r"colours\.a: 'red'"):
        read_map(path)
    path.write_text(text.replace("0.1", "-0.1") + '[colours]\na = "#ff0000"\n')
    with pytest.raises(DataError, match=r"metres_per_pixel: -0\.1; expected"):
        read_map(path)
    path.write_text('base = "a"\n' + text + '[colours]\na = "#ff0000"\n')
    with pytest.raises(DataError, match="base: no such key"):
        read_map(path)
    path.write_text(text + '[colours]\na = "#ff0000"\n')
    with pytest.raises(DataError, match=r"picture .*top\.png"):
        read_map(path)
    (tmp_path / "top.png").write_bytes(b"no picture")
    with pytest.raises(DataError, match="expected a PNG or JPEG"):
        read_map(path)


def test_a_map_whose_colours_cannot_be_told_apart_is_not_written(tmp_path):
    floor = patchwork(("a", "b"), seed=1, cell=0.05)
    with pytest.raises(ValueError, match="same colour"):
        write_map(tmp_path / "site.toml", floor, {"a": "#102030", "b": "#102030"})
    assert not any(tmp_path.iterdir())


def vector_map(*patches: Patch) -> VectorMap:
    colours = {"table": "#ffffff", "gray": "#808080"}
    region = MapRegion(
        extent_m=UNIT,
        cell_m=0.1,
        base="table",
        colours=colours,
        picture_sha256="",
        unknown_share=0.0,
        notes=["a note"],
    )
    return VectorMap(patches, region)


def ringed(surface: str, *rings: list) -> Patch:
    return Patch(surface, tuple(np.array(ring, float) for ring in rings), 1.0, 2.5)


WHOLE = [[0, 0], [1, 0], [1, 1], [0, 1]]
HOLE = SQUARE[::-1]


def test_polygons_with_holes_come_back_from_geojson(tmp_path):
    path = tmp_path / "map.geojson"
    vector_map(ringed("table", WHOLE, HOLE), ringed("gray", SQUARE)).save(path)
    floor = read_map(path)
    assert floor.surfaces == ("table", "gray")
    assert floor.cells.shape == (10, 10)
    wanted = np.zeros((10, 10), int)
    wanted[2:6, 2:6] = 1
    np.testing.assert_array_equal(floor.cells, wanted)
    assert floor.extent == pytest.approx(UNIT)
    content = json.loads(path.read_text())
    assert content["features"][0]["geometry"]["coordinates"][0] == [*WHOLE, WHOLE[0]]
    assert content["features"][1]["properties"] == {
        "surface": "gray",
        "area_m2": 1.0,
        "colour": "#808080",
        "confidence": 2.5,
    }


def test_what_no_polygon_covers_has_the_nearest_surface(tmp_path):
    path = tmp_path / "map.geojson"
    left = [[0, 0], [0.3, 0], [0.3, 1], [0, 1]]
    right = [[0.7, 0], [1, 0], [1, 1], [0.7, 1]]
    vector_map(ringed("table", left), ringed("gray", right)).save(path)
    np.testing.assert_array_equal(read_map(path).cells[4], [0] * 5 + [1] * 5)


def test_cells_are_covered_by_their_middles():
    ring = np.array([[0.4, 0.6], [2.6, 0.6], [2.6, 2.5], [0.4, 2.5]])
    wanted = np.zeros((4, 4), bool)
    wanted[1, 0:3] = True
    np.testing.assert_array_equal(covered([ring], 4, 4), wanted)
    np.testing.assert_array_equal(covered([ring[::-1]], 4, 4), wanted)
    triangle = np.array([[0.0, 0.0], [8.0, 0.0], [0.0, 8.0]])
    np.testing.assert_array_equal(covered([triangle - 0.01], 8, 8).sum(axis=1), range(7, -1, -1))
    assert covered([np.array([[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]])], 3, 2).all()
    assert not covered([triangle + np.array([9.0, 0.0])], 8, 8).any()


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (('"slipid.map/2"', '"slipid.map/3"'), r"slipid\.schema: 'slipid.map/3'; expected one of"),
        (('"FeatureCollection"', '"Feature"'), "type: 'Feature'; expected one of 'FeatureColl"),
        (('"Polygon"', '"Point"'), r"features\[1\]\.geometry\.type: 'Point'; expected one of"),
        (('"cell_m": 0.1', '"cell_m": 0'), r"slipid\.cell_m: 0; expected a number from 1e-05"),
        (('"cell_m": 0.1', '"cell_m": 0.0001'), "100000000 cells; expected at most"),
        (('"cell_m": 0.1', '"cell": 0.1'), r"slipid\.cell: no such key, did you mean cell_m"),
        (
            ('"surface": "gray"', '"surface": "sand"'),
            "no colour of sand; expected every surface in the key 'colours'",
        ),
        (('"confidence": 2.5', '"confidence": NaN'), "NaN is not a number"),
        (('"cell_m": 0.1', '"cell_m": 1e-19'), r"slipid\.cell_m: 1e-19; expected a number from"),
        (("1.0,\n   1.0\n", "1e19,\n   1.0\n"), r"slipid\.extent_m\[3\]: 1e\+19; expected"),
        (("0.6,\n       0.2\n", "1e19,\n       0.2\n"), r"coordinates\[\d\]\[\d\]\[1\]: 1e\+19"),
        (('"colour": "#808080"', '"colour": "gray"'), r"properties\.colour: 'gray'; expected"),
        (('"type": "Feature"', '"type" "Feature"'), "not valid JSON"),
    ],
)
def test_errors_of_a_geojson_map_are_named(tmp_path, change, match):
    path = tmp_path / "map.geojson"
    vector_map(ringed("table", WHOLE, HOLE), ringed("gray", SQUARE)).save(path)
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(DataError, match=match) as error:
        read_map(path)
    assert str(path) in str(error.value)


def test_geojson_without_a_map_is_refused(tmp_path):
    path = tmp_path / "map.geojson"
    with pytest.raises(DataError, match=r"expected a floor map \(slipid\.map/2\) that"):
        read_map(path)
    vector_map().save(path)
    with pytest.raises(DataError, match=r"features: .* at least 1 item"):
        read_map(path)
    vector_map(ringed("table", (np.array(WHOLE) + 30).tolist())).save(path)
    with pytest.raises(DataError, match="no polygon lies within extent_m; expected coord"):
        read_map(path)
    low = vector_map(ringed("table", WHOLE)).to_json()
    low["features"][0]["geometry"]["coordinates"][0].append([0.5, 0.5])
    path.write_text(json.dumps(low))
    with pytest.raises(DataError, match=r"features\[1\]: a ring that is not closed"):
        read_map(path)
    low["slipid"]["extent_m"] = [1.0, 0.0, 0.0, 1.0]
    path.write_text(json.dumps(low))
    with pytest.raises(DataError, match="expected lowest x, lowest y, highest x, highest y"):
        read_map(path)
