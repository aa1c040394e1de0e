"""Thinned draws of chains, draws of variances beside them, and convergence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from slipid.fitting.problem import Problem
from slipid.infer.posterior.blocks import ChainBlock
from slipid.infer.posterior.coordinates import Fitted
from slipid.infer.posterior.sample import thinned
from slipid.infer.posterior.variance_draws import drawn_variances
from slipid.search_space import Choice
from tests.helpers.made_windows import made, robot

STD = {"camera.place": 0.0005, "process.along": 0.003, "run.along": 0.01, "current.window": 0.05}
FREE = [
    Choice("*", free=False),
    Choice("surface.*.creep", free=True),
    Choice("surface.*.load_bias", free=True),
]
SHAPE = (2, 20_000)


@pytest.fixture(scope="module")
def problem():
    truth = robot()
    return Problem(replace(made(truth, std=STD), has_voltage=False), truth, FREE)


def fitted(problem):
    z, log_v = problem.space.start, 2 * np.log(problem.noise.typical)
    return Fitted(z, log_v, problem.laplace(z, log_v, np.ones(len(problem.windows))))


@pytest.mark.slow
def test_the_std_of_load_biases_is_drawn_from_its_likelihood(problem, monkeypatch):
    """Load biases with known likelihoods have a half-normal prior of their common std."""
    monkeypatch.setattr("slipid.infer.posterior.variance_draws._SWEEPS", (10, 10))
    end, at = fitted(problem), problem.space.pooled
    now, typical = np.exp(0.5 * end.log_variance[problem.objective.pooled]), 0.05
    sure = 0.02**-2  # precision of the data alone
    measured = np.array([0.06, -0.09, 0.12, -0.05])
    covariance = np.diag(np.where(at, 1 / (sure + now**-2), 0.01))
    z = end.z.copy()
    z[at] = measured * sure / (sure + now**-2)
    draws = drawn_variances(problem, Fitted(z, end.log_variance, covariance), SHAPE, 0)
    std = np.exp(0.5 * draws[..., problem.objective.pooled]).ravel()

    def density(s, power=0):
        spread = np.sqrt(s**2 + 1 / sure)
        return s**power * norm.pdf(s / typical) * np.prod(norm.pdf(measured / spread) / spread)

    whole, first, second = (quad(density, 0, 1, (k,))[0] for k in range(3))
    mean, square = first / whole, second / whole
    # the grid's steps are 6 %
    assert std.mean() == pytest.approx(mean, rel=0.01)
    assert std.std() == pytest.approx(np.sqrt(square - mean**2), rel=0.03)
    others = drawn_variances(problem, end, (1, 2000), 0)[..., problem.objective.pooled]
    assert np.exp(0.5 * others).mean() < 0.6 * mean  # biases of zero mean that floors are similar


def test_thinned_draws_are_spread_over_steps_and_walkers_and_keep_their_log_density():
    chain = np.arange(2 * 60 * 8, dtype=float).reshape(2, 60, 8, 1)
    random = np.zeros((2, 624), np.uint32), np.zeros((2, 3))
    blocks = [
        ChainBlock(k, part, 0.5 * part[..., 0], random, np.zeros(2), None)
        for k, part in enumerate(np.split(chain, 3, axis=1))
    ]
    x, log_prob = thinned(chain, blocks, 40)
    assert x.shape == (2, 40, 1)
    np.testing.assert_array_equal(log_prob, 0.5 * x[..., 0])
    step, walker = np.divmod(x[0, :, 0].astype(int), 8)
    assert (np.diff(step) > 0).all()
    assert step[0] < 2
    assert step[-1] >= 58
    assert np.bincount(walker, minlength=8).tolist() == [5] * 8
    many, _ = thinned(chain[:, :10], blocks[:1], 100)
    assert len(np.unique(many[0])) <= 80  # some repeat where there are too few
