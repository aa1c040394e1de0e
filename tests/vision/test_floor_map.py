"""Maps of floors from pictures: made ones whose truth is known, real ones, and what is refused."""

import json
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt
from typer.testing import CliRunner

from slipid.cli.main import app
from slipid.data.floor_map import read_map
from slipid.data.geojson_map import covered, read_vector_map
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from slipid.vision.camera import OverheadCamera
from slipid.vision.floor.asked import Source
from slipid.vision.floor.found import FoundMap
from slipid.vision.floor.grid import Extent, grid_over, rectified, view_of
from slipid.vision.floor.outline import area, outlined
from slipid.vision.floor.picture import Wish, all_found, map_of
from slipid.vision.floor.robot_mask import Robot
from slipid.vision.floor.segmentation.colour import as_light, as_shown, code_of_light, light_of_code
from slipid.vision.floor.segmentation.segment import settled, tidy
from slipid.vision.floor.segmentation.shading import Light, Lit, Samples, lit, shapes
from tests.helpers.made_floors import COLOURS, POINTS, Flaws, MadeFloor, aslant, made_floor

REGION = "[region]\nat_m = [[-1.1, -0.9], [1.1, -0.9], [1.1, 0.9], [-1.1, 0.9]]\n"
HEAD = 'schema = "slipid.palette/1"\n'
IMAGE = Path("floor.png")
ROBOT = Robot("4X4_50", 0.17, 0.2)
REFERENCE = Path(__file__).with_name("test_site_reference.json")
SITE_POINTS = {
    "tan": [(100, 60), (100, 300)],
    "navy": [(250, 130), (480, 450), (700, 930)],
    "green": [(300, 40), (900, 250), (700, 290)],
    "pale_green": [(600, 60), (960, 500), (300, 900)],
    "red": [(480, 140), (815, 460), (100, 600)],
    "pink": [(590, 200)],
    "dark_gray": [(370, 200), (600, 420)],
    "light_gray": [(500, 700), (70, 970), (960, 130)],
    "brown": [(250, 400), (700, 780), (930, 650)],
}
"""By eye, in pixels of the picture of the test site."""


def marked(points: dict, key: str = "at_m") -> str:
    """Points as a config has them."""
    return "".join(
        f'[[points]]\nsurface = "{name}"\n{key} = {[list(p) for p in places]}\n'
        for name, places in points.items()
    )


def mapped(
    floor: MadeFloor, folder: Path, config: str | None, cell: float = 0.008, **wish
) -> FoundMap:
    """The map of a made picture."""
    image, path = folder / "floor.png", None
    cv2.imwrite(str(image), floor.picture)
    if config is not None:
        path = folder / "palette.toml"
        path.write_text(HEAD + config)
    wish.setdefault("robot", ROBOT)
    return map_of(image, floor.camera, Wish(path, cell=cell, **wish), Reporter(quiet=True))


def truth_of(found: FoundMap, floor: MadeFloor) -> np.ndarray:
    """True surface of each cell, by number of the found map; -1 where the robot hides it."""
    names = list(found.vector.colours)
    centres = found.floor.grid.centres()
    number = np.array([names.index(name) for name in floor.truth.surfaces])
    return np.where(floor.hides(centres), -1, number[floor.truth.at(centres)])


def border_error(found: FoundMap, true: np.ndarray) -> np.ndarray:
    """How far each found edge between two surfaces is from the nearest true one [m]."""
    known = (found.labels >= 0) & (true >= 0)
    far = distance_transform_edt(~_edges(true, known)) * found.floor.grid.cell
    return far[_edges(found.labels, known)]


def _edges(labels: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Cells whose right or upper neighbour is another surface."""
    out = np.zeros(labels.shape, bool)
    out[:, :-1] |= (labels[:, 1:] != labels[:, :-1]) & known[:, 1:] & known[:, :-1]
    out[:-1] |= (labels[1:] != labels[:-1]) & known[1:] & known[:-1]
    return out


@pytest.fixture(scope="module")
def made() -> MadeFloor:
    return made_floor()


@pytest.fixture(scope="module")
def by_points(made, tmp_path_factory) -> FoundMap:
    return mapped(made, tmp_path_factory.mktemp("points"), REGION + marked(POINTS))


def test_points_on_surfaces_are_enough_under_uneven_light(made, by_points):
    true = truth_of(by_points, made)
    known = (true >= 0) & (by_points.labels >= 0)
    assert set(by_points.vector.colours) == set(COLOURS)
    assert np.mean(by_points.labels[known] == true[known]) > 0.985
    assert known.mean() > 0.93
    assert not by_points.poor
    for name in COLOURS:
        k = list(by_points.vector.colours).index(name)
        assert np.mean(by_points.labels[known & (true == k)] == k) > 0.95


@pytest.mark.slow
def test_one_point_on_each_surface_is_enough_as_the_light_is_learnt(tmp_path):
    floor = made_floor(flaws=Flaws(shade=0.6, glare=0.25))
    points = {name: places[1:] for name, places in POINTS.items()}
    found = mapped(floor, tmp_path, REGION + marked(points), cell=0.01)
    true = truth_of(found, floor)
    known = (true >= 0) & (found.labels >= 0)
    assert known.mean() > 0.93
    assert np.mean(found.labels[known] == true[known]) > 0.985


def test_edges_lie_within_a_cell_of_the_true_ones(made, by_points):
    off = border_error(by_points, truth_of(by_points, made))
    assert len(off) > 300
    assert np.median(off) <= 0.008
    assert np.quantile(off, 0.95) <= 0.016


def test_the_robot_is_masked_with_its_side_and_little_else(made, by_points):
    (robot,) = by_points.robots
    assert robot.marker == 7
    assert np.hypot(robot.x - made.robot.x, robot.y - made.robot.y) < 0.01
    hidden = made.hides(by_points.floor.grid.centres()) & by_points.floor.seen
    assert (by_points.labels[hidden] == -1).all()
    unknown = by_points.labels[1:-1, 1:-1] == -1
    assert unknown.sum() < 1.35 * hidden.sum()
    # the lens is at y = -0.45: the robot hides more of the floor behind it than before it
    y = by_points.floor.grid.centres()[..., 1][1:-1, 1:-1][unknown]
    assert y.max() - made.robot.y > made.robot.y - y.min() + 0.03


def test_what_is_hidden_has_the_nearest_surface_and_a_note_says_how_much(by_points, tmp_path):
    by_points.vector.save(tmp_path / "map.geojson")
    floor = read_map(tmp_path / "map.geojson")
    hidden = by_points.labels == -1
    assert floor.surfaces[int(np.bincount(floor.cells[hidden]).argmax())] == "wood"
    assert by_points.vector.unknown == pytest.approx(hidden.mean())
    assert f"{100 * hidden.mean():.1f} % of the map's rectangle is unknown" in " ".join(
        by_points.vector.notes
    )


def test_the_map_comes_back_from_its_file_within_a_cell_along_edges(by_points, tmp_path):
    path = tmp_path / "map.geojson"
    by_points.vector.save(path)
    floor = read_map(path)
    labels = by_points.labels
    assert floor.surfaces == tuple(by_points.vector.colours)
    assert floor.cells.shape == labels.shape
    grid = by_points.floor.grid
    assert floor.extent == pytest.approx(
        (grid.low_x, grid.low_y, grid.extent.high_x, grid.extent.high_y), abs=1e-4
    )
    wrong = (floor.cells != labels) & (labels >= 0)
    assert wrong.mean() < 0.005
    for k in range(len(floor.surfaces)):
        # what is read as a surface is at most a cell from where it was found
        assert distance_transform_edt(labels != k)[wrong & (floor.cells == k)].max(initial=0) < 1.5
    # strict JSON, in metres, outer rings anticlockwise and holes clockwise
    content = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert content["type"] == "FeatureCollection"
    for feature in content["features"]:
        rings = [np.array(ring) for ring in feature["geometry"]["coordinates"]]
        assert all((ring[0] == ring[-1]).all() for ring in rings)
        turns = [area(ring[:-1]) for ring in rings]
        assert turns[0] > 0 > max(turns[1:], default=-1)
        assert feature["properties"]["area_m2"] == pytest.approx(sum(turns), rel=1e-3, abs=1e-5)


def test_neighbouring_patches_leave_no_gap_and_do_not_overlap(by_points):
    grid = by_points.floor.grid
    fine = 3
    count = np.zeros((fine * grid.rows, fine * grid.columns), int)
    for patch in by_points.vector.patches:
        rings = [fine * (grid.steps(ring) + 0.5) for ring in patch.rings]
        count += covered(rings, *count.shape)
    inner = np.repeat(np.repeat(by_points.labels >= 0, fine, 0), fine, 1)
    inner = distance_transform_edt(np.pad(inner, 1))[1:-1, 1:-1] > 2 * fine
    assert (count[inner] == 1).mean() > 0.9999
    assert count.max() <= 2
    assert (count > 1).sum() < 20


@pytest.mark.slow
def test_colours_alone_are_enough_where_light_is_not_too_uneven(tmp_path):
    palette = "[palette]\n" + "".join(f'{name} = "{code}"\n' for name, code in COLOURS.items())
    floor = made_floor(flaws=Flaws(shade=0.2, glare=0.05))
    found = mapped(floor, tmp_path, palette + REGION)
    true = truth_of(found, floor)
    known = (true >= 0) & (found.labels >= 0)
    assert np.mean(found.labels[known] == true[known]) > 0.98
    assert found.vector.colours == COLOURS


@pytest.mark.slow
def test_surfaces_are_proposed_and_their_config_finds_them_again(made, tmp_path):
    found = mapped(made, tmp_path, REGION)
    names = list(found.vector.colours)
    assert names[0] == "surface_1"
    assert 5 <= len(names) <= 7
    centres = found.floor.grid.centres()
    true = np.where(made.hides(centres), -1, made.truth.at(centres))
    known = (true >= 0) & (found.labels >= 0)
    likely = np.array(
        [np.bincount(true[known & (found.labels == k)]).argmax() for k in range(len(names))]
    )
    assert np.mean(likely[found.labels[known]] == true[known]) > 0.98
    assert set(likely) == set(range(5))
    config = tomllib.loads(found.proposal)
    assert [one["surface"] for one in config["points"]] == names
    (tmp_path / "again").mkdir()
    again = mapped(made, tmp_path / "again", found.proposal.replace(HEAD, ""))
    assert again.proposal is None
    both = (again.labels >= 0) & (found.labels >= 0)
    assert np.mean(again.labels[both] == found.labels[both]) > 0.99


def test_so_many_surfaces_are_proposed_as_are_asked_for(made, tmp_path):
    assert len(mapped(made, tmp_path, REGION, surfaces=3).vector.colours) == 3


def test_names_of_one_surface_are_not_told_apart_and_make_the_map_poor(made, tmp_path):
    points = POINTS | {"wood": [(0.3, 0.0)], "oak": [(0.3, 0.1)]}
    found = mapped(made, tmp_path, REGION + marked(points))
    assert any("wood and oak are not told apart" in said for said in found.poor)


def test_a_map_of_mostly_unknown_is_poor(made, tmp_path):
    mask = "[[mask]]\nat_m = [[-1.1, -0.9], [1.1, -0.9], [1.1, 0.05], [-1.1, 0.05]]\n"
    points = {name: [POINTS[name][k]] for name, k in (("wood", 1), ("blue", 0), ("gray", 1))}
    found = mapped(made, tmp_path, REGION + mask + marked(points))
    assert any("% of the floor that was asked for is unknown" in said for said in found.poor)
    assert (found.labels[: found.labels.shape[0] // 3] == -1).all()


def test_confidence_is_lower_where_surfaces_look_alike(by_points, tmp_path):
    patches = [("green", [[-1.2, -1.0], [0.0, -1.0], [0.0, 0.3], [-1.2, 0.3]])]
    floor = made_floor(patches=patches, colours={"wood": "#b08a5a", "green": "#b08f5a"})
    points = {"wood": [(0.6, 0.0), (0.5, 0.8)], "green": [(-0.8, -0.5), (-0.3, 0.0)]}
    found = mapped(floor, tmp_path, REGION + marked(points))
    sure = min(p.confidence for p in by_points.vector.patches)
    assert max(p.confidence for p in found.vector.patches) < sure
    assert any("wood and green are" in said for said in (*found.poor, *found.warnings))


def test_what_looks_like_no_surface_is_unknown(made, tmp_path):
    points = {name: POINTS[name] for name in ("wood", "green", "blue", "gray")}
    found = mapped(made, tmp_path, REGION + marked(points))
    grid = found.floor.grid
    column, row = np.rint(grid.steps(np.array(POINTS["red"][0]))).astype(int)
    assert found.labels[row, column] == -1


def test_a_camera_that_sees_the_horizon_maps_the_floor_below_it():
    camera = aslant(160, 120, pitch=1.25)
    view = view_of(camera)
    assert view.high_y < camera.place[1] + 3.01 * camera.height
    grid = grid_over(view, 0.05, IMAGE)
    picture = np.full((120, 160, 3), 200, np.uint8)
    floor = rectified(picture, camera, grid)
    assert 0.1 < floor.seen.mean() < 1
    behind = floor.grid.centres()[..., 1] < camera.place[1] - 2 * camera.height
    assert not floor.seen[behind].any()
    assert (floor.colour[floor.seen] == 200).all()
    assert (floor.colour[~floor.seen] == 0).all()


def test_what_lies_beside_the_view_of_a_bent_lens_is_not_seen():
    camera = aslant(160, 120)
    camera = OverheadCamera(
        type(camera.lens)((160, 120), camera.lens.matrix, np.array([-0.15, 0.0, 0.0, 0.0])),
        camera.rotation,
        camera.place,
    )
    grid = grid_over(Extent(-5.0, -5.0, 5.0, 5.0), 0.1, IMAGE)
    floor = rectified(np.full((120, 160, 3), 200, np.uint8), camera, grid)
    view = view_of(camera)
    x, y = np.moveaxis(grid.centres()[floor.seen], -1, 0)
    assert view.low_x - 0.2 < x.min() < x.max() < view.high_x + 0.2
    assert view.low_y - 0.2 < y.min() < y.max() < view.high_y + 0.2


def test_a_straight_view_is_laid_onto_the_floor_pixel_by_pixel():
    picture = np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)
    camera = OverheadCamera.straight_down((40, 30), 0.01, 1.0)
    view = view_of(camera)
    floor = rectified(picture, camera, grid_over(view, 0.01, IMAGE))
    assert floor.seen.all()
    np.testing.assert_array_equal(floor.colour[::-1], picture)


def test_gain_and_veil_are_found_with_the_colours():
    rng = np.random.default_rng(0)
    colours = np.array([light_of_code(code) for code in COLOURS.values()])
    at = rng.uniform(-1, 1, (3000, 2))
    basis = shapes(at).shape[1]
    true = Light(0.1 * rng.normal(size=basis) / 3, 0.02 * rng.normal(size=(basis, 3)) / 3)
    own = rng.integers(0, len(colours), len(at))
    seen = true.seen(colours, at)[own, np.arange(len(at))]
    seen *= rng.normal(1, 0.02, seen.shape)
    seen[:150] = 0.9  # what is no surface
    found = lit(Samples(at, seen, own, np.ones(len(at))), Lit(Light.even(), colours * 0.8))
    fitted = found.light.seen(found.colours, at)[own, np.arange(len(at))]
    plain = true.seen(colours, at)[own, np.arange(len(at))]
    assert np.abs(fitted / plain - 1)[150:].mean() < 0.02
    back = found.light.undone(fitted, at)
    np.testing.assert_allclose(back, found.colours[own], atol=0.02)


def test_single_cells_follow_their_neighbours_and_strong_ones_do_not():
    costs = np.zeros((2, 21, 30), np.float32)
    costs[0, :, 15:], costs[1, :, :15] = 9.0, 9.0
    costs[:, 5, 5] = [3.0, 0.0]  # noise
    costs[:, 10:15, 5:10] = np.array([25.0, 0.0])[:, None, None]
    known = np.ones((21, 30), bool)
    known[:, -2:] = False
    labels = settled(costs, known)
    assert labels[5, 5] == 0
    assert (labels[11:14, 6:9] == 1).all()
    assert (labels[:8, :15] == 0).all()
    assert (labels[:, 15:28] == 1).all()
    assert (labels[:, 28:] == -1).all()


def test_narrow_lines_and_small_islands_become_what_is_around_them():
    labels = np.zeros((60, 80), int)
    labels[:, 40:] = 1
    labels[:, 38:41] = 2  # the mixed colour of an edge
    labels[10:18, 20:28] = 2  # an island of 64 cells
    labels[30:50, 60:80] = 2  # a patch
    labels[:, :4] = 2  # the rest of a patch at the edge of the picture
    known = np.ones(labels.shape, bool)
    known[55:] = False
    clean = tidy(labels, known, 7)
    assert set(np.unique(clean[:28, 4:])) == {0, 1}
    assert abs(int((clean[20, 4:] == 0).sum()) - 35) <= 1
    assert (clean[32:48, 62:] == 2).all()
    assert (clean[55:] == -1).all()


def test_outlines_share_their_borders_and_keep_holes():
    labels = np.zeros((40, 50), int)
    labels[10:30, 15:35] = 1
    labels[18:22, 22:26] = 0
    labels[:8, 40:] = 2
    labels[35:, :5] = -1
    patches = outlined(labels, 0.6)
    assert [one.label for one in patches] == [0, 1, 2, 0]
    assert [len(one.rings) for one in patches] == [2, 2, 1, 1]
    for one in patches:
        size = sum(
            area(r) if k == 0 and area(r) > 0 else -abs(area(r)) if k else abs(area(r))
            for k, r in enumerate(one.rings)
        )
        assert size == pytest.approx(one.cells.sum(), abs=1e-9)
    square = patches[1].rings[0]
    assert square.min(axis=0) == pytest.approx([15, 10], abs=0.6)
    assert square.max(axis=0) == pytest.approx([35, 30], abs=0.6)
    # the edge of the hole in one is the edge of the other
    hole = {tuple(corner) for corner in patches[0].rings[1]}
    assert hole == {tuple(corner) for corner in square}


def test_cells_that_touch_at_a_corner_are_outlined():
    labels = np.full((6, 6), -1)
    labels[1:3, 1:3] = 0
    labels[3:5, 3:5] = 0
    (one,) = outlined(labels, 0.1)
    assert one.cells.sum() == 8
    assert len(one.rings) == 1
    assert [one.rings[0].min(), one.rings[0].max()] == [1.0, 5.0]


def test_slanted_borders_become_lines():
    y, x = np.mgrid[:100, :120]
    labels = (x > 30 + 0.37 * y).astype(int)
    found = {one.label: one.rings[0] for one in outlined(labels, 0.6)}
    assert len(found[0]) < 20
    lowest, highest = found[0][found[0][:, 1] == 0], found[0][found[0][:, 1] == 100]
    assert lowest[:, 0].max() == pytest.approx(31, abs=1.0)
    assert highest[:, 0].max() == pytest.approx(31 + 37, abs=1.0)


def test_light_and_what_is_shown_are_inverse():
    shown = np.linspace(0, 1, 50)[:, None] * [1.0, 0.5, 0.1]
    np.testing.assert_allclose(as_shown(as_light(shown)), shown, atol=1e-6)
    assert code_of_light(light_of_code("#3e7a4c")) == "#3e7a4c"
    assert light_of_code("#ffffff") == pytest.approx([1, 1, 1])
    assert light_of_code("#808080")[0] == pytest.approx(0.2158, abs=1e-3)


POINT = '[[points]]\nsurface = "wood"\n'


@pytest.mark.parametrize(
    ("config", "match"),
    [
        ('[palette]\na = "#B08a5a"\nb = "#b08a5A"\n', "palette.b: '#b08a5A', the colour of a; exp"),
        ('[palette]\na = "brown"\n', "palette.a: 'brown'; expected"),
        ('[palette]\na = "#ff00ff"\n', "palette.a: '#ff00ff' is nowhere in the picture"),
        (POINT, r"points\[1\]: expected either at_px or at_m"),
        (POINT + "at_px = [[1, 1]]\nat_m = [[0, 0]]\n", "either at_px or at_m"),
        (POINT + "at_px = []\n", r"points\[1\].at_px: \[\]; expected"),
        (POINT + "at_px = [[480, 10]]\n", r"\[480, 10\] is outside the picture of 480 x 400"),
        (POINT + "at_m = [[5.0, 0.0]]\n", r"points\[1\]: \[5, 0\] is not seen, outside the reg"),
        (POINT + "at_m = [[-0.75, 0.55]]\n", "on a mask or on a robot; expected a point on"),
        (POINT + "at_px = [[1, 399]]\n" + REGION, "not seen, outside the region"),
        ("[region]\nat_m = [[0, 0], [1, 1]]\n", "region: 2 corners; expected a polygon of 3"),
        ("[region]\nat_m = [[9, 9], [9, 8], [8, 8]]\n", "region: no floor that the camera sees"),
        ("[region]\nat_px = [[9, 9], [9, 8], [8, 8]]\n", "expected 400 or more"),
        ("[region]\nat_m = [[0, 0], [1, 1], [0.5, 0.5]]\n", r"region: \d+ cells of 8 mm that"),
        ("[[mask]]\nat_m = [[-9, -9], [9, -9], [9, 9], [-9, 9]]\n", "hide all but 0 cells"),
        ("[regions]\n", "regions: no such key, did you mean region"),
        ("[region\n", "no valid TOML"),
    ],
)
def test_what_is_wrong_with_a_palette_is_said(made, tmp_path, config, match):
    with pytest.raises(DataError, match=match) as error:
        mapped(made, tmp_path, config)
    assert "palette.toml" in str(error.value) or "floor.png" in str(error.value)


def test_a_surface_that_no_cell_has_is_refused(made):
    source = Source(IMAGE, Path("p.toml"), made.picture, made.camera)
    labels = np.array([[0, 2], [-1, 2]])
    with pytest.raises(DataError, match=r"p\.toml: nothing in the picture looks most like b; exp"):
        all_found(source, ("a", "b", "c"), labels)
    all_found(source, ("a",), labels)


def test_pictures_and_cameras_that_do_not_fit_are_refused(made, tmp_path):
    image = tmp_path / "floor.png"
    with pytest.raises(DataError, match=r"floor\.png: No such file.*expected a picture"):
        map_of(image, made.camera, Wish(), Reporter(quiet=True))
    image.write_bytes(b"")
    with pytest.raises(DataError, match=r"floor\.png: the file is empty"):
        map_of(image, made.camera, Wish(), Reporter(quiet=True))
    image.write_bytes(b"no picture at all")
    with pytest.raises(DataError, match="no picture that OpenCV reads"):
        map_of(image, made.camera, Wish(), Reporter(quiet=True))
    with pytest.raises(DataError, match="480 x 400 pixels, but the camera was calibrated at 640"):
        mapped(MadeFloor(made.picture, aslant(640), made.truth, None), tmp_path, None)
    with pytest.raises(DataError, match="no marker dictionary '4X4_51', did you mean 4X4_50"):
        mapped(made, tmp_path, REGION, robot=Robot("4X4_51"))
    with pytest.raises(DataError, match="expected at most 4000000 in all: a larger --cell"):
        mapped(made, tmp_path, REGION, cell=0.0005)
    with pytest.raises(DataError, match="expected 400 or more: a smaller --cell"):
        mapped(made, tmp_path, REGION, cell=0.9)
    with pytest.raises(DataError, match="it names 5 surfaces; expected no --surfaces with it"):
        mapped(made, tmp_path, REGION + marked(POINTS), surfaces=5)
    with pytest.raises(DataError, match="too few for 30 surfaces; expected a picture of a floor"):
        mapped(made, tmp_path, REGION, surfaces=30)


def said(*words: object) -> tuple[int, str]:
    """Exit code and output of a command."""
    done = CliRunner().invoke(app, [str(word) for word in words])
    return done.exit_code, done.output


@pytest.mark.slow
def test_the_command_writes_a_map_that_others_read(made, tmp_path):
    image, camera, out = tmp_path / "floor.png", tmp_path / "camera.json", tmp_path / "out"
    cv2.imwrite(str(image), made.picture)
    made.camera.save(camera)
    (tmp_path / "p.toml").write_text(HEAD + REGION + marked(POINTS))
    common = ("map", image, "--camera", camera, "--robot-radius", 0.17, "--robot-height", 0.2)
    common = (*common, "--cell", 0.01, "--quiet")
    code, text = said(*common, "--config", tmp_path / "p.toml", "--out", out, "--json", out / "j")
    assert code == 0, text
    assert "robot with marker 7 masked at x -0.75 m, y 0.55 m" in text
    assert cv2.imread(str(out / "map.png")).shape[1] == 1430
    assert not (out / "palette.toml").exists()
    shown = json.loads((out / "j").read_text())
    assert {one["surface"] for one in shown["surfaces"]} == set(COLOURS)
    vector = read_vector_map(out / "map.geojson")
    assert vector.base == "wood"
    assert len(vector.picture_sha256) == 64
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
    common = ("map", image, "--metres-per-pixel", 0.01, "--out", out, "--quiet")
    code, text = said(*common)
    assert code == 0, text
    assert "no marker of a robot was found" in text
    assert f"--config {out / 'palette.toml'}" in text
    code, text = said(*common)
    assert code == 2
    assert "it is there already and may have been edited" in text
    config = (out / "palette.toml").read_text()
    (out / "palette.toml").write_text(config.replace("surface_1", "lawn"))
    code, text = said(*common, "--config", out / "palette.toml")
    assert code == 0, text
    assert "lawn" in read_map(out / "map.geojson").surfaces


def test_the_command_needs_one_scale_and_tells_a_poor_map_by_its_exit_code(tmp_path):
    image = tmp_path / "floor.png"
    picture = np.full((120, 160, 3), (60, 120, 60), np.uint8)
    cv2.imwrite(str(image), picture)
    assert said("map", image, "--out", tmp_path)[0] == 2
    assert (
        "expected either --camera FILE or --metres-per-pixel M"
        in said("map", image, "--out", tmp_path)[1]
    )
    camera = tmp_path / "camera.json"
    OverheadCamera.straight_down((160, 120), 0.01, 2.0).save(camera)
    code, text = said(
        "map", image, "--out", tmp_path, "--camera", camera, "--metres-per-pixel", 0.01
    )
    assert (code, "expected one of them" in text) == (2, True)
    code, text = said("map", image, "--out", tmp_path, "--camera", camera, "--camera-height", 2)
    assert (code, "expected no --camera-height" in text) == (2, True)
    (tmp_path / "p.toml").write_text(
        HEAD + marked({"a": [(30, 30), (30, 90)], "b": [(120, 30), (120, 90)]}, "at_px")
    )
    code, text = said(
        *("map", image, "--out", tmp_path, "--camera", camera, "--config", tmp_path / "p.toml")
    )
    assert code in (1, 2), text
    assert "a" in text


def reference(names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Surface of each pixel of the test site as drawn by hand, and whether it is sure."""
    drawn = json.loads(REFERENCE.read_text())
    width, height = drawn["image_px"]
    true = np.full((height, width), -1)
    for patch in drawn["patches"]:
        true[covered([np.array(patch["polygon"]) + 0.5], height, width)] = names.index(
            patch["surface"]
        )
    for outline in (drawn["robot"], *drawn["unsure"]):
        true[covered([np.array(outline) + 0.5], height, width)] = -1
    return true, true >= 0


@pytest.mark.slow
@pytest.mark.skipif(not REFERENCE.is_file(), reason="no reference of the test site")
def test_the_test_site_agrees_with_what_was_drawn_by_hand(real_data, tmp_path):
    image = real_data / "robotino2021" / "test_site.jpg"
    config = tmp_path / "site.toml"
    config.write_text(HEAD + marked(SITE_POINTS, "at_px"))
    camera = OverheadCamera.straight_down((1062, 1036), 0.0022, 2.3)
    wish = Wish(config, robot=Robot("4X4_50", 0.26, 0.25))
    found = map_of(image, camera, wish, Reporter(quiet=True))
    true, sure = reference(list(found.vector.colours))
    labels = found.labels[::-1]
    known = sure & (labels >= 0)
    assert [robot.marker for robot in found.robots] == [0]
    assert known.sum() > 0.95 * sure.sum()
    assert np.mean(labels[known] == true[known]) > 0.98
    for k in range(len(SITE_POINTS)):
        assert np.mean(labels[known & (true == k)] == k) > 0.96
    assert not found.poor


@pytest.mark.slow
def test_the_edge_of_the_carpet_lies_where_it_was_measured(real_data, tmp_path):
    image = real_data / "robotino2022" / "two_surfaces" / "green_table" / "top_view.jpg"
    region = "[region]\nat_px = [[385, 60], [1440, 130], [1440, 995], [390, 995]]\n"
    points = {"green": [(600, 300), (700, 800)], "table": [(1100, 300), (950, 600)]}
    config = tmp_path / "table.toml"
    config.write_text(HEAD + region + marked(points, "at_px"))
    camera = OverheadCamera.straight_down((1920, 1080), 0.0018, 3.4)
    wish = Wish(config, robot=Robot("4X4_50", 0.22, 0.25))
    found = map_of(image, camera, wish, Reporter(quiet=True))
    assert [robot.marker for robot in found.robots] == [0]
    assert [patch.surface for patch in found.vector.patches] == ["table", "green"]
    labels = found.labels[::-1]
    grid = found.floor.grid
    # left edge of the first cell of the table in each row, in pixels
    first = np.argmax(labels == 1, axis=1)
    x = (grid.low_x + first * grid.cell) / 0.0018 + 959.5
    y = 539.5 - (grid.low_y + (np.arange(grid.rows)[::-1] + 0.5) * grid.cell) / 0.0018
    for low, high, measured in ((150, 350, 850.5), (430, 650, 852.3), (760, 900, 851.5)):
        assert np.mean(x[(y > low) & (y < high)]) == pytest.approx(measured, abs=1.0)
