"""Maps of photographs of real floors, compared with drawings and measurements by hand."""

import json

import numpy as np
import pytest

from slipid.camera.floor.grid import RobotShape
from slipid.camera.floor.picture import MapOptions, map_of
from slipid.camera.overhead import OverheadCamera
from slipid.data.geojson_map import covered
from slipid.support.progress import Reporter
from tests.helpers.mapped_floors import HEAD, REFERENCE, SITE_POINTS, marked

pytestmark = pytest.mark.slow


def reference(names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface of each pixel of the test site, drawn by hand, and whether it is sure."""
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


def test_the_test_site_agrees_with_the_drawing_by_hand(real_data, tmp_path):
    image = real_data / "robotino2021" / "test_site.jpg"
    config = tmp_path / "site.toml"
    config.write_text(HEAD + marked(SITE_POINTS, "at_px"))
    camera = OverheadCamera.straight_down((1062, 1036), 0.0022, 2.3)
    options = MapOptions(config, robot=RobotShape("4X4_50", 0.26, 0.25))
    result = map_of(image, camera, options, Reporter(quiet=True))
    true, sure = reference(list(result.vector.region.colours))
    labels = result.labels[::-1]
    known = sure & (labels >= 0)
    assert [robot.marker for robot in result.robots] == [0]
    assert known.sum() > 0.95 * sure.sum()
    assert np.mean(labels[known] == true[known]) > 0.98
    for k in range(len(SITE_POINTS)):
        assert np.mean(labels[known & (true == k)] == k) > 0.96
    assert not result.poor


def test_the_edge_of_the_carpet_lies_where_it_was_measured(real_data, tmp_path):
    image = real_data / "robotino2022" / "two_surfaces" / "green_table" / "top_view.jpg"
    region = "[region]\nat_px = [[385, 60], [1440, 130], [1440, 995], [390, 995]]\n"
    points = {"green": [(600, 300), (700, 800)], "table": [(1100, 300), (950, 600)]}
    config = tmp_path / "table.toml"
    config.write_text(HEAD + region + marked(points, "at_px"))
    camera = OverheadCamera.straight_down((1920, 1080), 0.0018, 3.4)
    options = MapOptions(config, robot=RobotShape("4X4_50", 0.22, 0.25))
    result = map_of(image, camera, options, Reporter(quiet=True))
    assert [robot.marker for robot in result.robots] == [0]
    assert [patch.surface for patch in result.vector.patches] == ["table", "green"]
    labels = result.labels[::-1]
    grid = result.floor.grid
    # left edge of the first cell of the table in each row, in pixels
    first = np.argmax(labels == 1, axis=1)
    x = (grid.low_x + first * grid.cell) / 0.0018 + 959.5
    y = 539.5 - (grid.low_y + (np.arange(grid.rows)[::-1] + 0.5) * grid.cell) / 0.0018
    for low, high, measured in ((150, 350, 850.5), (430, 650, 852.3), (760, 900, 851.5)):
        assert np.mean(x[(y > low) & (y < high)]) == pytest.approx(measured, abs=1.0)
