"""Electric numbers drawn given the motion follow their density, and so do variances."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import norm

from slipid.fitting.problem import Problem
from slipid.infer.posterior.coordinates import ELECTRIC, MOTION, Fitted
from slipid.infer.posterior.density import Density, electric_given_motion
from slipid.search_space import Choice
from tests.helpers.density_slopes import slope
from tests.helpers.made_windows import made, robot

pytestmark = pytest.mark.slow  # compiles densities

STD = {
    "process.along": 0.002,
    "run.along": 0.005,
    "current.window": 0.003,
    "current.run": 0.003,
    "voltage.window": 0.05,
}
COPIES = 6000
FREE = [
    Choice("*", free=False),
    Choice("surface.*.creep", free=True),
    Choice("surface.*.roller_drag", free=True),
    Choice("surface.*.friction", free=True),
    Choice("motor.resistance", free=True),
    Choice("motor.back_emf", free=True),
]


def parts(choices, **std):
    """Return densities of motion and electric numbers at the fit, with noise of these stds."""
    truth = robot()
    w = made(truth, std=STD)
    problem = Problem(replace(w, current_var=np.full_like(w.current_var, 1e-6)), truth, choices)
    log_v = 2 * np.log(
        [(STD | std).get(f"{c.kind}.{c.what}", c.typical) for c in problem.noise.components]
    )
    z = problem.space.vector(truth)
    covariance = problem.laplace(z, log_v, np.ones(24))
    fitted = Fitted(z, log_v, covariance)
    return (*(Density(problem, fitted, part) for part in (MOTION, ELECTRIC)), covariance)


@pytest.fixture(scope="module")
def usual():
    """Return the densities of all numbers, compiled once."""
    return parts(FREE)


def drawn(first, second, covariance, motion, seed=0):
    """Return draws for very many copies of one draw of the motion."""
    many = np.broadcast_to(motion, (2, COPIES // 2, len(motion)))
    return electric_given_motion(first, second, covariance, many, seed)


def repeated(held, count):
    return jax.tree.map(lambda h: np.repeat(h, count, axis=0), held)


def log_prob(second, held, x):
    """Return the log density at many vectors, all given one draw of the motion."""
    many = repeated(held, len(x))
    return np.asarray(second.mapped(Density.log_prob, x, many))


def gaussian(second, held):
    """Return the mode and the covariance there, by scipy and by finite differences."""

    def loss(x):
        return -log_prob(second, held, x[None])[0], -slope(second, x[None], held)[0]

    mode = minimize(loss, second.centre, jac=True, method="BFGS").x
    h = 1e-3 * np.eye(second.size)
    many = repeated(held, second.size)
    bend = -(slope(second, mode + h, many) - slope(second, mode - h, many)) / 2e-3
    return mode, np.linalg.inv(0.5 * (bend + bend.T))


def test_draws_are_the_gaussian_given_the_motion_where_data_are_informative(usual):
    first, second, covariance = usual
    motion = first.centre + 0.02
    mode, spread = gaussian(second, first.hold(motion[None]))
    x, moved = drawn(first, second, covariance, motion)
    assert x.shape == (2, COPIES // 2, second.size)
    flat, std = x.reshape(COPIES, -1), np.sqrt(np.diag(spread))
    assert moved.mean() > 0.6
    assert moved.any(axis=1).all()
    np.testing.assert_allclose((flat.mean(axis=0) - mode) / std, 0.0, atol=4 / np.sqrt(COPIES))
    np.testing.assert_allclose(
        np.cov(flat.T) / std / std[:, None], spread / std / std[:, None], atol=6 / np.sqrt(COPIES)
    )


def test_draws_follow_the_motion(usual):
    """For motion far from the fit the mode differs from the start, and is found."""
    first, second, covariance = usual
    motion = first.centre + np.where(["drag" in name for name in first.names], 0.5, 0.0)
    mode, spread = gaussian(second, first.hold(motion[None]))
    x, _ = drawn(first, second, covariance, motion)
    std = np.sqrt(np.diag(spread))
    assert (np.abs(mode - second.centre) / std).max() > 5
    away = (x.reshape(COPIES, -1).mean(axis=0) - mode) / std
    np.testing.assert_allclose(away, 0.0, atol=4 / np.sqrt(COPIES))


def test_steps_towards_the_mode_are_damped():
    """Undamped steps overshoot along logarithms of small friction: 3 % were accepted."""
    small = ("viscous_friction", "coulomb_friction", "rolling_drag")
    first, second, covariance = parts([*FREE, *(Choice(f"motor.{n}", free=True) for n in small)])
    motion = np.broadcast_to(first.centre + 0.6, (1, 8, first.size))
    _, moved = electric_given_motion(first, second, covariance, motion, 0)
    assert moved.mean() > 0.15


def test_a_skewed_density_is_drawn_from_exactly():
    """Draws follow a density on a grid that is far from the Gaussian of the proposals."""
    first, second, covariance = parts(
        [*FREE[:3], Choice("motor.resistance", free=True)], **{"voltage.window": 3.0}
    )
    assert second.names == ("motor.resistance",)
    motion = first.centre + 0.02
    held = first.hold(motion[None])
    x = np.sort(drawn(first, second, covariance, motion)[0].ravel())
    grid = np.linspace(second.centre[0] - 8, second.centre[0] + 4, 4001)
    density = log_prob(second, held, grid[:, None])
    weight = np.exp(density - density.max())
    below = (np.cumsum(weight) - 0.5 * weight) / weight.sum()

    def apart(x):
        """Return the distance of the empirical distribution of sorted draws from the grid's."""
        return np.abs(np.interp(x, grid, below) - (np.arange(len(x)) + 0.5) / len(x)).max()

    mode, spread = gaussian(second, held)
    proposed = mode + 1.15 * np.sqrt(spread[0]) * norm.ppf((np.arange(COPIES) + 0.5) / COPIES)
    assert apart(x) < 1.63 / np.sqrt(COPIES)  # Kolmogorov and Smirnov's, one in a hundred
    assert apart(proposed) > 4 * 1.63 / np.sqrt(COPIES)
