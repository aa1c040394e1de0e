"""Maps of made floors: correct surfaces, unknown cells and warnings."""

import json
import tomllib

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from slipid.camera.floor.outline import signed_area
from slipid.data.floor_map import read_map
from slipid.data.geojson_map import covered
from tests.helpers.made_floors import COLOURS, POINTS, Flaws, made_floor
from tests.helpers.mapped_floors import HEAD, REGION, border_error, mapped, marked, truth_of

pytestmark = pytest.mark.slow


def test_points_on_surfaces_are_enough_under_uneven_light(made, by_points):
    true = truth_of(by_points, made)
    known = (true >= 0) & (by_points.labels >= 0)
    assert set(by_points.vector.region.colours) == set(COLOURS)
    assert np.mean(by_points.labels[known] == true[known]) > 0.985
    assert known.mean() > 0.93
    assert not by_points.poor
    for name in COLOURS:
        k = list(by_points.vector.region.colours).index(name)
        assert np.mean(by_points.labels[known & (true == k)] == k) > 0.95


def test_one_point_on_each_surface_is_enough_as_the_light_is_learnt(tmp_path):
    floor = made_floor(flaws=Flaws(shade=0.6, glare=0.25))
    points = {name: places[1:] for name, places in POINTS.items()}
    result = mapped(floor, tmp_path, REGION + marked(points), cell=0.01)
    true = truth_of(result, floor)
    known = (true >= 0) & (result.labels >= 0)
    assert known.mean() > 0.93
    assert np.mean(result.labels[known] == true[known]) > 0.985


def test_edges_lie_within_a_cell_of_the_true_ones(made, by_points):
    off = border_error(by_points, truth_of(by_points, made))
    assert len(off) > 300
    assert np.median(off) <= 0.008
    assert np.quantile(off, 0.95) <= 0.016


def test_the_robot_is_masked_with_its_side_and_little_else(made, by_points):
    (robot,) = by_points.robots
    assert robot.marker == 7
    assert np.hypot(robot.x - made.robot.x, robot.y - made.robot.y) < 0.01
    hidden = made.hides(by_points.floor.grid.centres()) & by_points.floor.in_view
    assert (by_points.labels[hidden] == -1).all()
    unknown = by_points.labels[1:-1, 1:-1] == -1
    assert unknown.sum() < 1.35 * hidden.sum()
    # the lens is at y = -0.45: the robot hides more of the floor behind it than before it
    y = by_points.floor.grid.centres()[..., 1][1:-1, 1:-1][unknown]
    assert y.max() - made.robot.y > made.robot.y - y.min() + 0.03


def test_hidden_floor_has_the_nearest_surface_and_a_note_gives_its_share(by_points, tmp_path):
    by_points.vector.save(tmp_path / "map.geojson")
    floor = read_map(tmp_path / "map.geojson")
    hidden = by_points.labels == -1
    assert floor.surfaces[int(np.bincount(floor.cells[hidden]).argmax())] == "wood"
    assert by_points.vector.region.unknown_share == pytest.approx(hidden.mean())
    assert f"{100 * hidden.mean():.1f} % of the map's rectangle is unknown" in " ".join(
        by_points.vector.region.notes
    )


def test_the_map_comes_back_from_its_file_within_a_cell_along_edges(by_points, tmp_path):
    path = tmp_path / "map.geojson"
    by_points.vector.save(path)
    floor = read_map(path)
    labels = by_points.labels
    assert floor.surfaces == tuple(by_points.vector.region.colours)
    assert floor.cells.shape == labels.shape
    grid = by_points.floor.grid
    assert floor.extent == pytest.approx(
        (grid.low_x, grid.low_y, grid.extent.high_x, grid.extent.high_y), abs=1e-4
    )
    wrong = (floor.cells != labels) & (labels >= 0)
    assert wrong.mean() < 0.005
    for k in range(len(floor.surfaces)):
        # a cell read as a surface is at most one cell from where it is
        assert distance_transform_edt(labels != k)[wrong & (floor.cells == k)].max(initial=0) < 1.5
    # strict JSON, in metres, outer rings anticlockwise and holes clockwise
    content = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert content["type"] == "FeatureCollection"
    for feature in content["features"]:
        rings = [np.array(ring) for ring in feature["geometry"]["coordinates"]]
        assert all((ring[0] == ring[-1]).all() for ring in rings)
        turns = [signed_area(ring[:-1]) for ring in rings]
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


def test_colours_alone_are_enough_where_light_is_not_too_uneven(tmp_path):
    palette = "[palette]\n" + "".join(f'{name} = "{code}"\n' for name, code in COLOURS.items())
    floor = made_floor(flaws=Flaws(shade=0.2, glare=0.05))
    result = mapped(floor, tmp_path, palette + REGION)
    true = truth_of(result, floor)
    known = (true >= 0) & (result.labels >= 0)
    assert np.mean(result.labels[known] == true[known]) > 0.98
    assert result.vector.region.colours == COLOURS


def test_surfaces_are_proposed_and_their_config_finds_them_again(made, tmp_path):
    result = mapped(made, tmp_path, REGION)
    names = list(result.vector.region.colours)
    assert names[0] == "surface_1"
    assert 5 <= len(names) <= 7
    centres = result.floor.grid.centres()
    true = np.where(made.hides(centres), -1, made.truth.at(centres))
    known = (true >= 0) & (result.labels >= 0)
    likely = np.array(
        [np.bincount(true[known & (result.labels == k)]).argmax() for k in range(len(names))]
    )
    assert np.mean(likely[result.labels[known]] == true[known]) > 0.98
    assert set(likely) == set(range(5))
    config = tomllib.loads(result.proposal)
    assert [one["surface"] for one in config["points"]] == names
    (tmp_path / "again").mkdir()
    again = mapped(made, tmp_path / "again", result.proposal.replace(HEAD, ""))
    assert again.proposal is None
    both = (again.labels >= 0) & (result.labels >= 0)
    assert np.mean(again.labels[both] == result.labels[both]) > 0.99


def test_as_many_surfaces_are_proposed_as_are_requested(made, tmp_path):
    assert len(mapped(made, tmp_path, REGION, surfaces=3).vector.region.colours) == 3


def test_two_names_of_one_surface_make_the_map_poor(made, tmp_path):
    points = POINTS | {"wood": [(0.3, 0.0)], "oak": [(0.3, 0.1)]}
    result = mapped(made, tmp_path, REGION + marked(points))
    assert any("wood and oak cannot be distinguished" in sentence for sentence in result.poor)


def test_a_map_of_mostly_unknown_is_poor(made, tmp_path):
    mask = "[[mask]]\nat_m = [[-1.1, -0.9], [1.1, -0.9], [1.1, 0.05], [-1.1, 0.05]]\n"
    points = {name: [POINTS[name][k]] for name, k in (("wood", 1), ("blue", 0), ("gray", 1))}
    result = mapped(made, tmp_path, REGION + mask + marked(points))
    assert any("% of the requested floor is unknown" in sentence for sentence in result.poor)
    assert (result.labels[: result.labels.shape[0] // 3] == -1).all()


def test_confidence_is_lower_where_surfaces_look_alike(by_points, tmp_path):
    patches = [("green", [[-1.2, -1.0], [0.0, -1.0], [0.0, 0.3], [-1.2, 0.3]])]
    floor = made_floor(patches=patches, colours={"wood": "#b08a5a", "green": "#b08f5a"})
    points = {"wood": [(0.6, 0.0), (0.5, 0.8)], "green": [(-0.8, -0.5), (-0.3, 0.0)]}
    result = mapped(floor, tmp_path, REGION + marked(points))
    sure = min(p.confidence for p in by_points.vector.patches)
    assert max(p.confidence for p in result.vector.patches) < sure
    assert any("wood and green can" in sentence for sentence in (*result.poor, *result.warnings))


def test_cells_that_look_like_no_surface_are_unknown(made, tmp_path):
    points = {name: POINTS[name] for name in ("wood", "green", "blue", "gray")}
    result = mapped(made, tmp_path, REGION + marked(points))
    grid = result.floor.grid
    column, row = np.rint(grid.steps(np.array(POINTS["red"][0]))).astype(int)
    assert result.labels[row, column] == -1
