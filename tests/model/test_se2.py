"""Motions in the plane against the exponential of their matrices, at small turns, too."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from slipid.model.se2 import advance, compose


def moved(xi, dt):
    """Pose after a twist, by the exponential of its matrix."""
    x, y, w = xi
    out = expm(np.array([[0.0, -w, x], [w, 0.0, y], [0.0, 0.0, 0.0]]) * dt)
    return np.array([out[0, 2], out[1, 2], w * dt])


@pytest.mark.parametrize("turn", [2.0, -0.3, 1e-3, 3e-6, 5e-7, -5e-7, 1e-9, 0.0])
def test_a_constant_twist_moves_by_its_exponential(turn):
    """However small the turn is: what it bends the way is right to a part of itself."""
    xi = np.array([0.3, -0.2, 2 * turn])
    found, exact = np.asarray(advance(jnp.asarray(xi), 0.5)), moved(xi, 0.5)
    straight = np.array([*xi[:2], 0.0]) * 0.5
    # near 1e-6 the cosine has lost all but four digits of the bend
    bend = np.abs(exact - straight).max()
    np.testing.assert_allclose(found, exact, rtol=0, atol=2e-4 * bend + 1e-15)


def test_a_robot_that_goes_straight_knows_where_a_turn_would_take_it():
    slope = jax.jacfwd(lambda xi: advance(xi, 0.5))(jnp.array([0.3, -0.2, 0.0]))
    np.testing.assert_allclose(slope[:, 2], [0.2 * 0.125, 0.3 * 0.125, 0.5], atol=1e-15)


def test_increments_go_on_from_where_they_begin():
    rng = np.random.default_rng(0)
    for a, b in rng.normal(size=(10, 2, 3)):
        one, other = (moved(x, 1.0) for x in (a, b))
        c, s = np.cos(one[2]), np.sin(one[2])
        place = one[:2] + np.array([[c, -s], [s, c]]) @ other[:2]
        found = compose(jnp.asarray(one), jnp.asarray(other))
        np.testing.assert_allclose(found, [*place, one[2] + other[2]], atol=1e-14)
