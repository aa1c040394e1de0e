"""Floor under each wheel, and distance of its border."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from slipid.data.floor_map import FloorMap, from_polygons, uniform, write_map
from slipid.deploy.floors import FloorLookup
from tests.helpers.shared import invoke

WHEELS = jnp.array([[0.1, 0.0], [0.0, 0.1], [-0.1, 0.0]])
CELL = 0.005


@pytest.fixture(scope="module")
def halves() -> FloorLookup:
    """Carpet where x is above 0.2 m, table elsewhere."""
    carpet = [(0.2, -1.0), (1.0, -1.0), (1.0, 1.0), (0.2, 1.0)]
    patches = [("carpet", carpet)]
    return FloorLookup.of(from_polygons("table", patches, (-1.0, -1.0, 1.0, 1.0), CELL))


def test_floor_and_border_of_every_wheel(halves):
    found = halves.under(jnp.array([0.15, 0.3, 0.0]), WHEELS)
    assert [halves.surfaces[k] for k in found.surface] == ["carpet", "table", "table"]
    np.testing.assert_allclose(found.border, [0.05, 0.05, 0.15], atol=0.5 * CELL + 1e-6)
    turned = halves.under(jnp.array([0.15, 0.3, np.pi / 2]), WHEELS)
    assert [halves.surfaces[k] for k in turned.surface] == ["table", "table", "table"]
    np.testing.assert_allclose(turned.border, [0.05, 0.15, 0.05], atol=0.5 * CELL + 1e-6)


def test_many_poses_at_once_have_the_shape_of_the_poses(halves):
    poses = jnp.asarray(np.random.default_rng(0).uniform(-1.2, 1.2, (4, 50, 3)))
    found = halves.under(poses, WHEELS)
    assert found.surface.shape == found.border.shape == (4, 50, 3)
    for i, j in ((0, 0), (2, 31), (3, 49)):
        alone = halves.under(poses[i, j], WHEELS)
        np.testing.assert_array_equal(alone.surface, found.surface[i, j])
        np.testing.assert_array_equal(alone.border, found.border[i, j])


def test_the_border_of_a_slanted_edge_is_its_distance():
    corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0)]  # below the diagonal
    lookup = FloorLookup.of(from_polygons("a", [("b", corners)], (-1.0, -1.0, 1.0, 1.0), CELL))
    rng = np.random.default_rng(1)
    place = rng.uniform(-0.5, 0.5, (200, 2))
    poses = jnp.asarray(np.column_stack([place, np.zeros(200)]))
    found = lookup.under(poses, jnp.zeros((1, 2)))
    distance = (place[:, 0] - place[:, 1]) / np.sqrt(2)
    clear = np.abs(distance) > CELL
    below = np.array([name == "b" for name in lookup.surfaces])[np.asarray(found.surface[:, 0])]
    np.testing.assert_array_equal(below[clear], distance[clear] > 0)
    np.testing.assert_allclose(found.border[:, 0], np.abs(distance), atol=1.2 * CELL)


def test_one_surface_has_no_border():
    found = FloorLookup.of(uniform("table")).under(jnp.zeros(3), WHEELS)
    assert np.isinf(np.asarray(found.border)).all()
    assert not np.asarray(found.surface).any()


def test_beyond_the_edge_it_is_the_nearest_cell():
    cells = np.array([[0, 1], [0, 1]])
    lookup = FloorLookup.of(FloorMap(("a", "b"), cells, (0.0, 0.0), 0.1))
    found = lookup.under(jnp.array([[9.0, 0.0, 0.0], [-9.0, 0.0, 0.0]]), jnp.zeros((1, 2)))
    assert [lookup.surfaces[k] for k in found.surface[:, 0]] == ["b", "a"]
    assert not np.asarray(found.inside).any()
    edges = jnp.array([[0.01, 0.01, 0.0], [0.19, 0.19, 0.0], [0.21, 0.1, 0.0], [0.1, -0.01, 0.0]])
    within = lookup.under(edges, jnp.zeros((1, 2))).inside
    assert np.asarray(within[:, 0]).tolist() == [True, True, False, False]


def test_the_command_refuses_what_is_no_fit_and_no_map(tmp_path):
    write_map(tmp_path / "map.toml", uniform("table"), {"table": "#ffffff"})
    words = ("floors", tmp_path, "--map", tmp_path / "map.toml", "--data", tmp_path, "--out", "o")
    result = invoke(*map(str, words))
    assert result.exit_code == 2
    assert "fit.json" in result.stderr
