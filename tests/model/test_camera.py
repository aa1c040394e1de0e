"""The camera's map of positions and headings, against OpenCV's lens and differences."""

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model.geometry import omni
from slipid.model.robot import build

POSES = np.random.default_rng(5).uniform([-1.5, -1.0, -3.0], [1.5, 1.0, 3.0], (20, 3))


def camera(**numbers):
    made = build(
        omni([60.0, 180.0, 300.0], 0.125, 0.04), ["sand"], ["as_built"], centre=(0.2, -0.1)
    ).camera
    return eqx.tree_at(
        lambda c: [getattr(c, k) for k in numbers],
        made,
        [jnp.asarray(v, float) for v in numbers.values()],
    )


def test_an_ideal_camera_only_moves_the_origin():
    for pose in POSES:
        np.testing.assert_allclose(
            camera().corrected(jnp.asarray(pose)), pose - [0.2, -0.1, 0.0], atol=1e-14
        )


def test_the_lens_is_that_of_opencv():
    lens = camera(radial=-0.02, tangential=[0.01, -0.004])
    rays = np.concatenate([POSES[:, :2] - [0.2, -0.1], np.ones((20, 1))], axis=1)
    coefficients = np.array([-0.02, 0.0, -0.004, 0.01])  # k1, k2, p1, p2
    seen, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), coefficients)
    ours = [lens.corrected(jnp.asarray(pose))[:2] for pose in POSES]
    np.testing.assert_allclose(ours, seen[:, 0], atol=1e-12)


def test_tilt_is_a_perspective_map():
    """Cross-ratios of four points on a line survive, and lines stay lines."""
    tilted = camera(tilt=[0.03, -0.05], scale=1.1)
    t = np.array([0.0, 0.3, 0.7, 1.0])
    line = np.stack([-1.0 + 2.1 * t, 0.4 - 1.3 * t, 0 * t], axis=1)
    a, b, c, d = (np.asarray(tilted.corrected(jnp.asarray(p)))[:2] for p in line)
    for p in (b, c):
        assert abs(np.cross(np.append(p - a, 0), np.append(d - a, 0))[2]) < 1e-12
    far = np.linalg.norm
    ratio = far(c - a) * far(d - b) / (far(c - b) * far(d - a))
    assert ratio == pytest.approx(0.7 * 0.7 / (0.4 * 1.0), rel=1e-12)


def test_headings_turn_as_small_marks_do():
    bent = camera(tilt=[0.03, -0.05], radial=-0.02, tangential=[0.01, -0.004], scale=1.1)
    h = 1e-6
    for pose in POSES:
        ahead = h * np.array([np.cos(pose[2]), np.sin(pose[2]), 0.0])
        tip, tail = (np.asarray(bent.corrected(jnp.asarray(pose + s * ahead))) for s in (1, -1))
        mark = (tip - tail)[:2]
        turned = float(bent.corrected(jnp.asarray(pose))[2])
        assert np.cos(turned - np.arctan2(mark[1], mark[0])) == pytest.approx(1.0, abs=1e-12)
        assert abs(turned - pose[2]) < 0.2  # no jump by a full turn
