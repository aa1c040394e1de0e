"""The sampler on targets whose moments are known, and its chains after an interrupt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arviz_stats.base import array_stats

from slipid.infer.posterior.blocks import LogDensity, Plan
from slipid.infer.posterior.diagnosis import autocorrelation_time, diagnose
from slipid.infer.posterior.ensemble import _begin, extended, warm_up
from slipid.infer.posterior.ensemble import chain as positions
from slipid.infer.posterior.proposals import DifferentialEvolution, families
from slipid.support.progress import Reporter
from tests.helpers.memory import holding

PLAN = Plan(ensembles=4, walkers=16, block=25, warm_up=(1, 2, 3, 5), most=120, spread=6.0, rows=300)


def known(residuals, group, centre, covariance, prior=None, positive=(), link=None):
    """Return a target from a function of (vectors, group) that returns residuals and remainder.

    `prior` holds the mean and the std of every coordinate, infinite where there is none; `link`
    its matrix and its centre.
    """
    size, groups = len(group), int(group.max()) + 1
    mean, std = prior or (np.zeros(size), np.full(size, np.inf))
    link, middle = link or (np.zeros((0, size)), np.zeros(size))

    def terms(x):
        out = np.zeros((len(x), groups + 1))
        np.add.at(out.T, group, -0.5 * (((x - mean) / std) ** 2).T)
        out[:, -1] -= 0.5 * (((x - middle) @ link.T) ** 2).sum(axis=1)
        for g in range(groups):
            y, c = residuals(x, g)
            out[:, g] += c - 0.5 * (y**2).sum(axis=1)
        return out

    depends = (group == np.arange(groups)[:, None]) | (group < 0)
    of_positive = np.isin(np.arange(size), positive)
    names = tuple(f"x{k}" for k in range(size))
    about = centre, covariance, link, middle
    return LogDensity(names, terms, residuals, depends, group, of_positive, mean, std, *about)


def gaussian():
    """Two groups of three and two shared numbers, strongly correlated; Laplace is a little off."""
    rng = np.random.default_rng(0)
    group = np.array([-1, 0, 0, 0, -1, 1, 1, 1])
    shared, mean = group < 0, rng.normal(size=8)
    spread = np.array([1.0, 0.1, 2.0, 5.0, 0.3, 1.0, 0.02, 1.0])
    slope = rng.normal(size=(8, 2)) * spread[:, None] / spread[shared]
    inner = np.array([[1.0, 0, 0], [0.9, 1, 0], [0, 0.9, 1]])
    root = np.diag(spread)
    for g in (0, 1):
        own = group == g
        root[np.ix_(own, shared)] = slope[own] * spread[shared]
        root[np.ix_(own, own)] = spread[own][:, None] * inner

    def residuals(x, g):
        d, own = x - mean, group == g
        rest = d[:, own] - d[:, shared] @ slope[own].T
        y = np.linalg.solve(spread[own][:, None] * inner, rest.T).T
        return y, np.zeros(len(x))

    covariance = root @ root.T
    # the prior of the second shared number is a link
    prior = np.where(shared, mean, 0.0), np.where(np.arange(8) == 0, spread, np.inf)
    link = np.where(np.arange(8) == 4, 1 / spread, 0.0)[None], mean
    off = mean + 0.7 * np.sqrt(np.diag(covariance))
    target = known(residuals, group, off, 0.6 * covariance, prior, link=link)
    return target, mean, np.sqrt(np.diag(covariance))


def banana():
    def residuals(x, _):
        y = np.stack([x[:, 0], 2 * (x[:, 1] - x[:, 0] ** 2)], axis=1)
        return y, np.zeros(len(x))

    target = known(residuals, np.zeros(2, int), np.zeros(2), np.diag([1.0, 0.25]))
    return target, np.array([0.0, 1.0]), np.array([1.0, 1.5])


def funnel():
    """Width e^v/2 of three numbers, v shared."""

    def residuals(x, g):
        v = x[:, 0]
        return x[:, [g + 1]] * np.exp(-0.5 * v)[:, None], -0.5 * v

    group = np.array([-1, 0, 1, 2])
    prior = np.zeros(4), np.where(group < 0, 1.0, np.inf)
    target = known(residuals, group, np.zeros(4), np.eye(4), prior, positive=[0])
    return target, np.zeros(4), np.array([1.0, *[np.exp(0.25)] * 3])


def mixture(log_density, centre):
    """Return a target whose first number has a given log density, with one more beside it."""

    def residuals(x, _):
        y = np.sqrt(np.maximum(-2 * log_density(x[:, 0]), 0.0))
        return np.stack([y, x[:, 1]], axis=1), np.zeros(len(x))

    return known(residuals, np.zeros(2, int), np.array([centre, 0.0]), np.eye(2))


def two_modes():
    """Return modes with weights 0.3 and 0.7 at -4 and 4, with Laplace at the first only."""

    def log_density(x):
        return np.logaddexp(np.log(0.3) - 0.5 * (x + 4) ** 2, np.log(0.7) - 0.5 * (x - 4) ** 2)

    std = np.array([np.sqrt(1 + 16 * 4 * 0.3 * 0.7), 1.0])
    return mixture(log_density, -4.0), np.array([1.6, 0.0]), std


def plateau():
    """Return a density of the log of a number that is only known to be small, and of another."""

    def residuals(x, _):
        with np.errstate(over="ignore"):
            p = np.exp(x[:, 0])
        y = np.stack([(p - 1) / 0.4, (x[:, 1] - 1 + 3 * p) / 0.1], axis=1)
        return y, np.zeros(len(x))

    grid = np.linspace(-12, 3, 20001)
    weight = np.exp(-0.5 * ((grid + 1) / 2) ** 2 - 0.5 * ((np.exp(grid) - 1) / 0.4) ** 2)
    weight /= weight.sum()
    about = np.stack([grid, 1 - 3 * np.exp(grid)])
    mean = about @ weight
    var = (about - mean[:, None]) ** 2 @ weight + np.array([0.0, 0.01])
    covariance = np.array([[0.16, -0.48], [-0.48, 1.45]])
    prior = np.array([-1.0, 0.0]), np.array([2.0, np.inf])
    centre = np.array([0.0, -2.0])
    target = known(residuals, np.zeros(2, int), centre, covariance, prior, positive=[0])
    return target, mean, np.sqrt(var)


def run(target, plan, done=()):
    """Return the blocks up to the plan's limit."""
    return extended(target, plan, "part", holding("part", done), Reporter(quiet=True))


def sampled(target, plan=PLAN):
    blocks = run(target, plan)
    chain = positions(blocks, plan)
    return blocks, chain, diagnose(chain, plan)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "seed"),
    [
        (gaussian, 0),
        (banana, 0),
        (two_modes, 0),
        *(
            pytest.param(*one, marks=pytest.mark.nightly)
            for one in ((banana, 1), (banana, 3), (funnel, 0), (plateau, 0), (plateau, 1))
        ),
    ],
)
def test_moments_are_within_three_monte_carlo_errors_unless_convergence_is_denied(case, seed):
    target, mean, std = case()
    _, chain, found = sampled(target, replace(PLAN, seed=seed))
    if not found.converged:
        assert case is two_modes, found.reason  # the only one that may be refused
        return
    flat = chain.reshape(-1, len(mean))
    error = flat.std(axis=0) / np.sqrt(found.ess)
    np.testing.assert_array_less(np.abs(flat.mean(axis=0) - mean) / error, 3.5)
    # the std is as sure as the mean of squares, which mix at a pace of their own
    squares = ((chain - mean) ** 2).transpose(0, 2, 1, 3).reshape(-1, *chain.shape[1::2])
    pace = array_stats.ess(squares, chain_axis=0, draw_axis=1, method="mean")
    kurtosis = ((flat - mean) ** 4).mean(axis=0) / std**4
    of_std = std * np.sqrt((kurtosis - 1) / 4 / pace)
    np.testing.assert_array_less(np.abs(flat.std(axis=0) - std) / of_std, 3.5)


@pytest.mark.slow
def test_ensembles_in_different_modes_are_not_reported():
    """No move leads between modes that are so far apart."""

    def log_density(x):
        return np.logaddexp(-0.5 * (x + 50) ** 2, -0.5 * (x - 50) ** 2)

    target = mixture(log_density, 0.0)
    plan = Plan(ensembles=4, walkers=4, block=25, warm_up=(1, 2), most=12, spread=30.0, rows=300)
    _, chain, found = sampled(target, plan)
    assert {-1, 1} == set(np.sign(chain[:, -1, 0, 0]).astype(int)) or not found.converged
    if len(set(np.sign(chain[..., 0]).mean(axis=(1, 2)).round(3))) > 1:
        assert not found.converged


@pytest.mark.slow
def test_an_interrupted_chain_continues_like_an_uninterrupted_one():
    target, _, _ = gaussian()
    plan = Plan(ensembles=2, walkers=8, block=5, warm_up=(1, 2, 3), most=6, rows=200)
    whole = run(target, plan)
    learnt = whole[0].learnt
    assert learnt is not None
    for state, places in zip(_begin(plan, whole[:1], learnt), learnt.places, strict=True):
        np.testing.assert_array_equal(state.coords, places)  # none stays at the end of the block
    for stop in range(1, 6):
        again = run(target, plan, whole[:stop])
        for one, other in zip(again, whole, strict=True):
            np.testing.assert_array_equal(one.chain, other.chain)
            np.testing.assert_array_equal(one.log_prob, other.log_prob)


@pytest.mark.slow
def test_a_slow_chain_begins_again_with_a_new_surrogate(monkeypatch):
    """It does so three times at most, also if it is interrupted or continued beyond a limit."""
    monkeypatch.setattr("slipid.infer.posterior.ensemble.JUDGED", (40, 60))
    target, _, _ = banana()
    plan = Plan(ensembles=2, walkers=8, block=5, warm_up=(1, 2), most=42, rows=200, r_hat=1 + 1e-9)

    def turns(blocks):
        return [b.number + 1 for b in blocks if b.learnt]

    assert turns(run(target, plan)) == [1]  # it is not slow
    monkeypatch.setattr("slipid.infer.posterior.ensemble.SLOW", 0.1)
    whole = run(target, plan)
    assert turns(whole) == [1, 10, 19, 28]  # eight blocks after the warm-up
    assert warm_up(whole, plan) == 29
    assert positions(whole, plan).shape[1] == (42 - 29) * 5
    for stop in (5, 10, 11):
        again = run(target, plan, whole[:stop])
        np.testing.assert_array_equal(positions(again, plan), positions(whole, plan))
    first = run(target, replace(plan, most=10))
    assert len(first) == 12  # a block beyond the warm-up
    again = run(target, plan, first)
    np.testing.assert_array_equal(positions(again, plan), positions(whole, plan))


@pytest.mark.slow
def test_the_seed_decides():
    target, _, _ = banana()
    plan = Plan(ensembles=2, walkers=8, block=5, warm_up=(1,), most=3, rows=200)
    one, same = (np.concatenate([b.chain for b in run(target, plan)]) for _ in range(2))
    other = np.concatenate([b.chain for b in run(target, replace(plan, seed=1))])
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)
    assert not np.array_equal(one[0], one[1])  # ensembles differ


def test_whole_differences_lead_from_mode_to_mode():
    target, _, _ = two_modes()
    (family,) = families(target)
    move, random = DifferentialEvolution(target, family), np.random.RandomState(0)
    still = np.concatenate([np.full((20, 2), -4.0), np.full((20, 2), 4.0)])
    x = np.full((4000, 2), -4.0)
    new, factor = move.proposed(x, still, random)
    assert (factor == 0).all()
    assert 0.01 < (np.abs(new[:, 0] - 4) < 0.5).mean() < 0.1


def test_autocorrelation_time_is_that_of_a_known_process():
    """An autoregression has tau = (1 + a) / (1 - a); a walker at rest raises it."""
    rng = np.random.default_rng(0)
    x = np.zeros((2, 4000, 8, 1))
    for k in range(1, 4000):
        x[:, k] = 0.8 * x[:, k - 1] + rng.normal(size=(2, 8, 1))
    assert autocorrelation_time(x)[0] == pytest.approx(9.0, rel=0.1)
    x[0, :, 0] = x[0, 0, 0] + 3.0
    assert autocorrelation_time(x)[0] > 20
