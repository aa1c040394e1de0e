"""The parts of a map: views, light, neighbours, outlines."""

import numpy as np
import pytest

from slipid.camera.floor.grid import Extent, grid_over, rectified, view_of
from slipid.camera.floor.light import (
    ColourSamples,
    Illumination,
    LitColours,
    basis_at,
    code_of_linear,
    fit_illumination,
    linear_of_code,
    to_linear,
    to_srgb,
)
from slipid.camera.floor.outline import outlines_of, signed_area
from slipid.camera.floor.surfaces import Surfaces, smoothed, without_small_patches
from slipid.camera.overhead import OverheadCamera
from tests.helpers.made_floors import COLOURS, aslant
from tests.helpers.mapped_floors import IMAGE


def test_a_camera_that_sees_the_horizon_maps_the_floor_below_it():
    camera = aslant(160, 120, pitch=1.25)
    view = view_of(camera)
    assert view.high_y < camera.place[1] + 3.01 * camera.height
    grid = grid_over(view, 0.05, IMAGE)
    picture = np.full((120, 160, 3), 200, np.uint8)
    floor = rectified(picture, camera, grid)
    assert 0.1 < floor.in_view.mean() < 1
    behind = floor.grid.centres()[..., 1] < camera.place[1] - 2 * camera.height
    assert not floor.in_view[behind].any()
    assert (floor.colour[floor.in_view] == 200).all()
    assert (floor.colour[~floor.in_view] == 0).all()


def test_places_beside_the_view_of_a_bent_lens_are_not_in_view():
    camera = aslant(160, 120)
    camera = OverheadCamera(
        type(camera.lens)((160, 120), camera.lens.matrix, np.array([-0.15, 0.0, 0.0, 0.0])),
        camera.rotation,
        camera.place,
    )
    grid = grid_over(Extent(-5.0, -5.0, 5.0, 5.0), 0.1, IMAGE)
    floor = rectified(np.full((120, 160, 3), 200, np.uint8), camera, grid)
    view = view_of(camera)
    x, y = np.moveaxis(grid.centres()[floor.in_view], -1, 0)
    assert view.low_x - 0.2 < x.min() < x.max() < view.high_x + 0.2
    assert view.low_y - 0.2 < y.min() < y.max() < view.high_y + 0.2


def test_a_straight_view_is_laid_onto_the_floor_pixel_by_pixel():
    picture = np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)
    camera = OverheadCamera.straight_down((40, 30), 0.01, 1.0)
    view = view_of(camera)
    floor = rectified(picture, camera, grid_over(view, 0.01, IMAGE))
    assert floor.in_view.all()
    np.testing.assert_array_equal(floor.colour[::-1], picture)


def test_gain_and_veil_are_fitted_with_the_colours():
    rng = np.random.default_rng(0)
    colours = np.array([linear_of_code(code) for code in COLOURS.values()])
    at = rng.uniform(-1, 1, (3000, 2))
    basis = basis_at(at).shape[1]
    true = Illumination(0.1 * rng.normal(size=basis) / 3, 0.02 * rng.normal(size=(basis, 3)) / 3)
    own = rng.integers(0, len(colours), len(at))
    rgb = true.rgb_of(colours, at)[own, np.arange(len(at))]
    rgb *= rng.normal(1, 0.02, rgb.shape)
    rgb[:150] = 0.9  # samples of no surface
    start = LitColours(Illumination.uniform(), colours * 0.8)
    fit = fit_illumination(ColourSamples(at, rgb, own, np.ones(len(at))), start)
    fitted = fit.illumination.rgb_of(fit.colours, at)[own, np.arange(len(at))]
    plain = true.rgb_of(colours, at)[own, np.arange(len(at))]
    assert np.abs(fitted / plain - 1)[150:].mean() < 0.02
    back = fit.illumination.true_colours(fitted, at)
    np.testing.assert_allclose(back, fit.colours[own], atol=0.02)


def test_single_cells_follow_their_neighbours_and_strong_ones_do_not():
    costs = np.zeros((2, 21, 30), np.float32)
    costs[0, :, 15:], costs[1, :, :15] = 9.0, 9.0
    costs[:, 5, 5] = [3.0, 0.0]  # noise
    costs[:, 10:15, 5:10] = np.array([25.0, 0.0])[:, None, None]
    known = np.ones((21, 30), bool)
    known[:, -2:] = False
    labels = smoothed(costs, known)
    assert labels[5, 5] == 0
    assert (labels[11:14, 6:9] == 1).all()
    assert (labels[:8, :15] == 0).all()
    assert (labels[:, 15:28] == 1).all()
    assert (labels[:, 28:] == -1).all()


def test_narrow_lines_and_small_islands_are_merged_with_their_surroundings():
    labels = np.zeros((60, 80), int)
    labels[:, 40:] = 1
    labels[:, 38:41] = 2  # the mixed colour of an edge
    labels[10:18, 20:28] = 2  # an island of 64 cells
    labels[30:50, 60:80] = 2  # a patch
    labels[:, :4] = 2  # the rest of a patch at the edge of the picture
    known = np.ones(labels.shape, bool)
    known[55:] = False
    clean = without_small_patches(labels, known, 7)
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
    patches = outlines_of(labels, 0.6)
    assert [one.label for one in patches] == [0, 1, 2, 0]
    assert [len(one.rings) for one in patches] == [2, 2, 1, 1]
    for one in patches:
        size = sum(
            signed_area(r)
            if k == 0 and signed_area(r) > 0
            else -abs(signed_area(r))
            if k
            else abs(signed_area(r))
            for k, r in enumerate(one.rings)
        )
        assert size == pytest.approx(one.cells.sum(), abs=1e-9)
    square = patches[1].rings[0]
    assert square.min(axis=0) == pytest.approx([15, 10], abs=0.6)
    assert square.max(axis=0) == pytest.approx([35, 30], abs=0.6)
    # the edge of the hole in one is the edge of the other
    hole = {tuple(corner) for corner in patches[0].rings[1]}
    assert hole == {tuple(corner) for corner in square}


def test_a_map_of_small_patches_alone_keeps_them():
    labels = np.indices((8, 9)).sum(axis=0) % 2
    found = without_small_patches(labels, np.full(labels.shape, True), 3)
    np.testing.assert_array_equal(found, labels)


def test_corners_of_the_map_stay_where_they_are():
    """Also if lines may be off by more than the map is wide."""
    labels = np.zeros((20, 30), int)
    (one,) = outlines_of(labels, 25.0)
    assert {tuple(corner) for corner in one.rings[0]} == {(0, 0), (30, 0), (30, 20), (0, 20)}


def test_a_surface_costs_as_much_where_it_is_smoother_as_where_it_is_rougher():
    lit = LitColours(Illumination.uniform(), np.array([[0.2, 0.3, 0.4]]))
    surfaces = Surfaces(lit, np.array([0.5]), np.ones((1, 4)))
    usual = surfaces.appearances((3, 4))[0].astype(float)
    step = np.array([0.0, 0.0, 0.0, 0.4])
    own, rougher, smoother = (surfaces.costs(usual + k * step) for k in (0, 1, -1))
    np.testing.assert_allclose(rougher, own + 0.4**2, rtol=1e-3)
    np.testing.assert_allclose(smoother, rougher, rtol=1e-3)


def test_cells_that_touch_at_a_corner_are_outlined():
    labels = np.full((6, 6), -1)
    labels[1:3, 1:3] = 0
    labels[3:5, 3:5] = 0
    (one,) = outlines_of(labels, 0.1)
    assert one.cells.sum() == 8
    assert len(one.rings) == 1
    assert [one.rings[0].min(), one.rings[0].max()] == [1.0, 5.0]


def test_slanted_borders_become_lines():
    y, x = np.mgrid[:100, :120]
    labels = (x > 30 + 0.37 * y).astype(int)
    found = {one.label: one.rings[0] for one in outlines_of(labels, 0.6)}
    assert len(found[0]) < 20
    lowest, highest = found[0][found[0][:, 1] == 0], found[0][found[0][:, 1] == 100]
    assert lowest[:, 0].max() == pytest.approx(31, abs=1.0)
    assert highest[:, 0].max() == pytest.approx(31 + 37, abs=1.0)


def test_linear_and_srgb_are_inverse():
    shown = np.linspace(0, 1, 50)[:, None] * [1.0, 0.5, 0.1]
    np.testing.assert_allclose(to_srgb(to_linear(shown)), shown, atol=1e-6)
    assert code_of_linear(linear_of_code("#3e7a4c")) == "#3e7a4c"
    assert linear_of_code("#ffffff") == pytest.approx([1, 1, 1])
    assert linear_of_code("#808080")[0] == pytest.approx(0.2158, abs=1e-3)
