"""Thinned draws of chains, draws of variances beside them, and convergence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from slipid.fitting.hierarchy import axis_effects, effect_information
from slipid.fitting.noise import POOLED
from slipid.fitting.problem import Problem
from slipid.infer.posterior.blocks import ChainBlock
from slipid.infer.posterior.coordinates import Fitted, effects_at
from slipid.infer.posterior.sample import drawn_variances, thinned
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


def by_definition(problem, log_v):
    """Return the information of log variances, 1/2 tr(V^-1 dV V^-1 dV), and of their prior."""
    precision, h = np.eye(len(log_v)) / 9, 1e-4
    for k in ("motion", "current"):
        inverse = np.linalg.inv(np.asarray(problem.covariance(k, log_v)))
        grown = [
            inverse
            @ np.asarray(
                problem.covariance(k, log_v + h * e) - problem.covariance(k, log_v - h * e)
            )
            / (2 * h)
            for e in np.eye(len(log_v))
        ]
        precision += 0.5 * np.array([[np.einsum("nij,nji", a, b) for b in grown] for a in grown])
    return precision


@pytest.mark.slow
def test_variances_are_drawn_from_the_gaussian_of_their_information(problem):
    """Information of segments is that of the definition, that of effects the one of the fit."""
    end = fitted(problem)
    log_v, names = end.log_variance, problem.noise.names
    draws = drawn_variances(problem, end, SHAPE, 0).reshape(-1, len(names))
    single = np.array([n.startswith(("camera", "process", "current")) for n in names])
    residual, jacobian = problem.linear(end.z, problem.electric(end.z, log_v))
    effect = effects_at(problem, residual, log_v)
    weight = problem.weighed(residual, log_v, np.ones(24), effect).whitening.weight["motion"]
    motion = residual["motion"], jacobian["motion"]
    axes = axis_effects(problem.objective, motion, weight, end.covariance, log_v)
    of_effects = effect_information(axes, log_v)
    of_effects += np.eye(len(log_v)) / 9
    precision = np.where(single[:, None] & single, by_definition(problem, log_v), 0.0)
    precision += np.where(~single[:, None] & ~single, of_effects, 0.0)
    drawn = np.array([n != POOLED for n in names])
    expected = np.linalg.inv(precision)[np.ix_(drawn, drawn)]
    std, count = np.sqrt(np.diag(expected)), len(draws)
    away = (draws.mean(axis=0) - log_v)[drawn] / std
    np.testing.assert_allclose(away, 0.0, atol=4 / np.sqrt(count))
    found = np.cov(draws[:, drawn].T) / std / std[:, None]
    np.testing.assert_allclose(found, expected / std / std[:, None], atol=6 / np.sqrt(count))
    # data determine some of them well, others hardly beside the prior's 3
    assert std.min() < 0.3
    assert std.max() > 2


@pytest.mark.slow
def test_runs_with_a_common_error_are_no_outliers_to_variances(problem, monkeypatch):
    """A wrong creep changes neighbouring runs in the same way, like a shared effect."""
    weights = []

    def spied(target, motion, weight, *rest):
        weights.append(np.asarray(weight))
        return axis_effects(target, motion, weight, *rest)

    monkeypatch.setattr("slipid.infer.posterior.sample.axis_effects", spied)
    z, log_v = problem.space.start + 0.3, 2 * np.log(problem.noise.typical)
    every = np.ones(len(problem.windows))
    drawn_variances(problem, Fitted(z, log_v, problem.laplace(z, log_v, every)), (1, 2), 0)
    residual, _ = problem.linear(z, problem.electric(z, log_v))
    whole = np.asarray(problem.whitening(residual, log_v, every).weight["motion"])
    assert weights[0].mean() > whole.mean() + 0.03


@pytest.mark.slow
def test_the_std_of_load_biases_is_drawn_from_its_likelihood(problem):
    """Load biases with known likelihoods have a half-normal prior of their common std."""
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
