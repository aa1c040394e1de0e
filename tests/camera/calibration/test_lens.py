"""The lens of a camera from pictures of a board, and its quality."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from slipid.camera.calibration.lens import fit_lens, fit_robustly, parameters_of
from slipid.camera.calibration.quality import check_usable, coverage, held_out_px, quality_of
from slipid.support.errors import DataError
from tests.helpers import made_boards as made
from tests.helpers.calibrated import (
    LENS,
    NOISE,
    NUMBERS,
    SIZE,
    TRUE,
    directions,
    projected_views,
    quality_of_views,
)


def test_lens_is_within_its_stated_std(calibrated):
    off = parameters_of(calibrated.lens) - NUMBERS
    std = np.sqrt(np.diag(calibrated.covariance))
    assert (np.abs(off) < 3 * std).all()
    assert (np.abs(off[:4] / NUMBERS[:4]) < 0.004).all()
    assert (std[:4] < 1.0).all()  # a wide std would make the first line trivial
    assert set(calibrated.report["lens"]["numbers"]) == {
        "fx",
        "fy",
        "cx",
        "cy",
        "k1",
        "k2",
        "p1",
        "p2",
    }


def test_distortion_is_right_all_over_the_picture(calibrated):
    u, v = np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 479, 7))
    pixels = np.stack([u, v], -1)
    here, there = (directions(lens, pixels) for lens in (calibrated.lens, LENS))
    # a lens is known up to how the camera is turned, which any pose makes up for
    left, _, right = np.linalg.svd(here.reshape(-1, 3).T @ there.reshape(-1, 3))
    assert np.abs(TRUE.project(here @ left @ right) - pixels).max() < 0.5


def test_held_out_error_is_that_of_a_corner(calibrated):
    report = calibrated.report["lens"]
    assert report["rms_px"] < report["held_out_rms_px"] < 1.3 * report["rms_px"] < 0.1
    views = projected_views(made.places(30))
    held, fitted = held_out_px(views, SIZE, False), fit_lens(views, SIZE, False).rms_px
    assert held == pytest.approx(NOISE * np.sqrt(2), rel=0.06)
    assert fitted < NOISE * np.sqrt(2) < held * 1.06
    few = [v.only(np.arange(0, len(v.pixels), 3)) for v in projected_views(made.places(7), seed=3)]
    assert held_out_px(few, SIZE, True) > 1.4 * fit_lens(few, SIZE, True).rms_px


def test_stated_covariance_is_that_of_repetitions():
    off = []
    for seed in range(16):
        fit = fit_lens(projected_views(made.places(10), seed=seed), SIZE, False)
        off.append((fit.parameters - NUMBERS) / fit.std)
    assert 0.75 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_stated_std_is_that_of_opencv():
    views = projected_views(made.places(10))
    fit = fit_lens(views, SIZE, True)
    points = [np.c_[v.board_m, np.zeros(len(v.board_m))].astype(np.float32) for v in views]
    pixels = [v.pixels.astype(np.float32)[:, None] for v in views]
    there = cv2.calibrateCameraExtended(points, pixels, SIZE, None, None)
    np.testing.assert_allclose(fit.std, there[5].ravel()[:9], rtol=0.01)
    np.testing.assert_allclose(fit.parameters[4:], there[2].ravel()[:5], rtol=0.02)
    assert len(fit_lens(views, SIZE, False).parameters) == 8


def test_a_view_that_does_not_fit_is_named_and_left_out():
    views = projected_views(made.places(12))
    clean = fit_lens([*views[:4], *views[5:]], SIZE, False)
    bent = views[4].pixels + 6.0 * np.sin(40 * views[4].board_m)
    views[4] = replace(views[4], pixels=bent)
    fit = fit_robustly(views, SIZE, False)
    assert len(fit.left_out) == 1
    assert fit.left_out[0].startswith("view view4 left out")
    np.testing.assert_allclose(fit.parameters, clean.parameters, rtol=1e-3, atol=1e-3)


def test_a_corner_that_does_not_fit_is_left_out_alone():
    views = projected_views(made.places(12))
    views[4].pixels[3] += [7.0, -5.0]
    fit = fit_robustly(views, SIZE, False)
    assert len(fit.left_out) == 1
    assert fit.left_out[0].startswith("view view4: one of")
    assert [len(v.pixels) for v in fit.views][4] == len(views[4].pixels) - 1
    assert fit_robustly(projected_views(made.places(12)), SIZE, False).left_out == ()


def test_many_bad_views_are_refused():
    views = projected_views(made.places(12))
    for k, sign in ((2, 1), (5, -1), (8, 1.5), (10, -2)):
        shift = sign * (6 + k) * np.sin(40 * views[k].board_m + k)
        views[k] = replace(views[k], pixels=views[k].pixels + shift)
    with pytest.raises(DataError, match="4 of 12 views are inconsistent with the others"):
        fit_robustly(views, SIZE, False)


FLAT = [
    replace(p, rotation=made.held(0, 0, 7.0 * k, (0, 0, 1)).rotation)
    for k, p in enumerate(made.places(12))
]


@pytest.mark.parametrize(
    ("views", "message"),
    [
        (projected_views(made.places(5)), "5 usable views .* expected 6"),
        (projected_views([p for p in made.places(3) for _ in "abc"]), "only 3 of 9 views differ"),
        (projected_views([made.held(0.4 * k, -0.3 * k, 9.0 * k, (0.05 * (k % 5 - 2), 0, 0.5))
                     for k in range(12)]), "tilted|focal length"),
        (projected_views(FLAT), "tilted|focal length"),
        (projected_views([made.held(30 * np.cos(k), 30 * np.sin(k), 17.0 * k, (0.0, 0.0, 0.9))
                     for k in range(12)], 0.02), "corners in .* % of the image's 8 x 6 cells"),
    ],
    ids=["few", "same", "parallel", "parallel everywhere", "in the middle alone"],
)  # fmt: skip
def test_views_that_determine_no_lens_are_refused(views, message):
    with pytest.raises(DataError, match=message):
        quality_of_views(views)


def test_each_reason_to_refuse_a_lens_is_one():
    fit = fit_lens(projected_views(made.places(12)), SIZE, False)
    whole = coverage(np.concatenate([v.pixels for v in fit.views]), SIZE)
    tilts = np.full(12, 20.0)
    check_usable(fit, whole, tilts)
    with pytest.raises(DataError, match="2 of 12 views are tilted by more than 12 degrees"):
        check_usable(fit, whole, np.where(np.arange(12) < 2, 20.0, 5.0))
    spread_out = np.diag([(0.025 * fit.parameters[0]) ** 2, *np.diag(fit.covariance)[1:]])
    vague = replace(fit, covariance=spread_out)
    with pytest.raises(DataError, match=r"the focal length is known only to 2\.5 %"):
        check_usable(vague, whole, tilts)
    with pytest.raises(DataError, match=r"corners in 2 % of the image's 8 x 6 cells"):
        check_usable(fit, coverage(np.full((9, 2), 200.0), SIZE), tilts)


@pytest.mark.slow
def test_a_poor_lens_says_why():
    poor = " ".join(quality_of_views(projected_views(made.places(7), noise=0.4)).poor)
    assert "7 views; expected 10" in poor
    assert "focal length known to 1." in poor
    poor = quality_of_views(projected_views(made.places(40), noise=0.8)).poor
    assert poor[-1].startswith("error of 1.")
    assert quality_of_views(projected_views(made.places(20))).poor == []


def test_tilts_and_coverage_are_those_of_the_views():
    places = [made.held(20.0, 0, 0, (0.0, 0.0, 0.5)), *made.places(11)]
    fit = fit_lens(projected_views(places), SIZE, False)
    assert quality_of(fit, False).tilts_deg[0] == pytest.approx(20, abs=0.5)
    covered = coverage(np.array([[1.0, 1.0], [639.0, 1.0], [1.0, 479.0], [400.0, 470.0]]), SIZE)
    assert covered.visited.sum() == 4
    assert covered.visited[0, 0]
    assert covered.visited[0, 7]
    assert covered.visited[5, 0]
    assert covered.visited[5, 5]
    assert covered.reach == pytest.approx((400 - 319.5) / 320)
