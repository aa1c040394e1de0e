"""The sampler on targets whose moments are known, and its chains after an interrupt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arviz_stats.base import array_stats
from emcee.model import Model

from slipid.infer.posterior.blocks import LogDensity, Plan
from slipid.infer.posterior.diagnosis import autocorrelation_time, diagnose
from slipid.infer.posterior.ensemble import chain as positions
from slipid.infer.posterior.ensemble import extended
from slipid.infer.posterior.proposals import (
    CoordinateWalk,
    DifferentialEvolution,
    Hamiltonian,
    Independence,
    families,
)
from slipid.support.progress import Reporter
from tests.helpers.memory import holding

PLAN = Plan(ensembles=4, walkers=16, block=25, warm_up=(2, 4, 6), most=120, spread=6.0)


def known(terms, group, centre, covariance):
    """Return a target with slopes by central differences."""

    def slope(x):
        step = 1e-5 * np.eye(x.shape[1])
        ends = x + np.stack([step, -step])[:, :, None]  # all at once: calls take longer than sums
        above, below = (
            terms(ends.reshape(-1, x.shape[1])).sum(axis=1).reshape(2, x.shape[1], len(x))
        )
        return (above - below).T / 2e-5

    return LogDensity(terms, slope, group, centre, covariance)


def gaussian():
    """Two groups of three and two shared numbers, strongly correlated; Laplace is a little off."""
    rng = np.random.default_rng(0)
    group = np.array([-1, 0, 0, 0, -1, 1, 1, 1])
    slope = rng.normal(size=(2, 8))
    spread = np.array([1.0, 0.1, 2.0, 5.0, 0.3, 1.0, 0.02, 1.0])
    shared = group < 0
    mixing = np.eye(8)
    for k in np.flatnonzero(~shared):
        mixing[k, shared] = slope[:, k]
    for k in (2, 3, 6, 7):
        mixing[k, k - 1] = 0.9
    root = spread[:, None] * mixing
    mean = rng.normal(size=8)
    covariance = root @ root.T
    precision = np.linalg.inv(covariance)

    def terms(x):
        # the precision has no entries between groups: each group's own rows, and the remainder
        d = x - mean
        out = np.zeros((len(x), 3))
        for g in (0, 1):
            own = group == g
            inner = np.where(np.outer(own, own), precision, 0.0)
            cross = np.where(np.outer(own, shared), precision, 0.0)
            out[:, g] = -0.5 * np.einsum("ni,ij,nj->n", d, inner + 2 * cross, d)
        rest = np.where(np.outer(shared, shared), precision, 0.0)
        out[:, 2] = -0.5 * np.einsum("ni,ij,nj->n", d, rest, d)
        return out

    assert np.abs(precision[np.ix_(group == 0, group == 1)]).max() < 1e-9
    off = mean + 0.7 * np.sqrt(np.diag(covariance))
    return known(terms, group, off, 0.6 * covariance), mean, np.sqrt(np.diag(covariance))


def banana():
    def terms(x):
        bent = -0.5 * x[:, 0] ** 2 - 2.0 * (x[:, 1] - x[:, 0] ** 2) ** 2
        return np.stack([bent, 0 * bent], axis=1)

    target = known(terms, np.zeros(2, int), np.zeros(2), np.diag([1.0, 0.25]))
    return target, np.array([0.0, 1.0]), np.array([1.0, 1.5])


def funnel():
    """Width e^v/2 of three numbers, v shared."""

    def terms(x):
        v = x[:, 0]
        own = -0.5 * (x[:, 1:] ** 2 * np.exp(-v)[:, None] + v[:, None])
        return np.concatenate([own, -0.5 * v[:, None] ** 2], axis=1)

    target = known(terms, np.array([-1, 0, 1, 2]), np.zeros(4), np.eye(4))
    return target, np.zeros(4), np.array([1.0, *[np.exp(0.25)] * 3])


def two_modes():
    """Return modes with weights 0.3 and 0.7 at -4 and 4, with Laplace at the first only."""

    def terms(x):
        d = np.logaddexp(
            np.log(0.3) - 0.5 * (x[:, 0] + 4) ** 2, np.log(0.7) - 0.5 * (x[:, 0] - 4) ** 2
        )
        return np.stack([d - 0.5 * x[:, 1] ** 2, 0 * d], axis=1)

    target = known(terms, np.zeros(2, int), np.array([-4.0, 0.0]), np.eye(2))
    return target, np.array([1.6, 0.0]), np.array([np.sqrt(1 + 16 * 4 * 0.3 * 0.7), 1.0])


def plateau():
    """Return a density of the log of a number that is only known to be small, and of another."""

    def below(x):
        return -0.5 * ((x + 1) / 2) ** 2 - 0.5 * ((np.exp(x) - 1) / 0.4) ** 2

    def terms(x):
        with np.errstate(over="ignore"):
            own = below(x[:, 0]) - 0.5 * ((x[:, 1] - 1 + 3 * np.exp(x[:, 0])) / 0.1) ** 2
        return np.stack([own, np.zeros(len(own))], axis=1)

    grid = np.linspace(-12, 3, 20001)
    weight = np.exp(below(grid))
    weight /= weight.sum()
    about = np.stack([grid, 1 - 3 * np.exp(grid)])
    mean = about @ weight
    var = (about - mean[:, None]) ** 2 @ weight + np.array([0.0, 0.01])
    covariance = np.array([[0.16, -0.48], [-0.48, 1.45]])
    return known(terms, np.zeros(2, int), np.array([0.0, -2.0]), covariance), mean, np.sqrt(var)


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
        assert case is two_modes  # the only one that may be refused
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

    def terms(x):
        d = np.logaddexp(-0.5 * (x[:, 0] + 50) ** 2, -0.5 * (x[:, 0] - 50) ** 2)
        return np.stack([d, 0 * d], axis=1)

    target = known(terms, np.zeros(1, int), np.zeros(1), np.eye(1))
    plan = Plan(ensembles=4, walkers=4, block=25, warm_up=(2,), most=12, spread=30.0)
    _, chain, found = sampled(target, plan)
    assert {-1, 1} == set(np.sign(chain[:, -1, 0, 0]).astype(int)) or not found.converged
    if len(set(np.sign(chain[..., 0]).mean(axis=(1, 2)).round(3))) > 1:
        assert not found.converged


@pytest.mark.slow
def test_an_interrupted_chain_continues_like_an_uninterrupted_one():
    target, _, _ = gaussian()
    plan = Plan(ensembles=2, walkers=8, block=5, warm_up=(1, 2), most=6)
    whole = run(target, plan)
    for stop in range(1, 6):
        again = run(target, plan, whole[:stop])
        for one, other in zip(again, whole, strict=True):
            np.testing.assert_array_equal(one.chain, other.chain)
            np.testing.assert_array_equal(one.log_prob, other.log_prob)


@pytest.mark.slow
def test_the_seed_decides():
    target, _, _ = banana()
    plan = Plan(ensembles=2, walkers=8, block=5, warm_up=(1,), most=3)
    one, same = (np.concatenate([b.chain for b in run(target, plan)]) for _ in range(2))
    other = np.concatenate([b.chain for b in run(target, replace(plan, seed=1))])
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)
    assert not np.array_equal(one[0], one[1])  # ensembles differ


@pytest.fixture(scope="module")
def exact():
    """Return a Gaussian in the coordinates of the Laplace map, and draws of it."""
    target, mean, _ = gaussian()
    target = replace(target, centre=mean, covariance=target.covariance / 0.6)
    u = np.random.RandomState(1).standard_normal((4000, 8))
    return target.in_coordinates(target.laplace()), u


def test_independence_accepts_nearly_everything_where_laplace_is_exact(exact):
    """All moves are accepted but for the tails of the Student t; groups follow shared numbers."""
    target, u = exact
    before, random = target.terms(u), np.random.RandomState(0)
    assert len(families(target)) == 2
    for family in families(target):
        new, factor = Independence(family).proposed(u, u, random)
        gain = target.terms(new) - before
        gain = gain.sum(1)[:, None] if family.groups is None else gain[:, list(family.groups)]
        assert np.minimum(1, np.exp(gain + factor)).mean() > 0.85
        others = np.setdiff1d(np.arange(8), np.concatenate(family.places))
        np.testing.assert_array_equal(new[:, others], u[:, others])


def made_gaussian(map, group):
    """Return a target that is a standard Gaussian in the coordinates of a map."""
    onto = np.eye(3)[np.where(group < 0, 2, group)]

    def terms(u):
        return -0.5 * u**2 @ onto

    centre, covariance = np.zeros(len(group)), np.eye(len(group))
    return LogDensity(terms, np.negative, group, centre, covariance, map=map)


def model_of(target):
    """Model with the attributes that emcee gives to moves."""

    def compute(u):
        out = target.log_prob(u)
        return out[:, 0], out[:, 1:]

    return Model(target.log_prob, compute, map, np.random.RandomState(0))


def state_of(target, u):
    """Return the state of walkers, and the model that emcee gives to moves."""
    from emcee.state import State

    model = model_of(target)
    log_prob, terms = model.compute_log_prob_fn(u)
    return model, State(u, log_prob=log_prob, blobs=terms, copy=True)


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, 1])
def test_a_hamiltonian_move_is_exact_and_independent_for_a_gaussian(exact, which):
    target, u = exact
    model, state = state_of(target, u)
    family = families(target)[which]
    move = Hamiltonian(target, family, 0.5)
    state, _ = move.propose(model, state)
    assert move.accepted[0] > 0.999  # there is no error to reject for
    np.testing.assert_allclose(state.log_prob, target.terms(state.coords).sum(axis=1), rtol=1e-9)
    own = np.concatenate(family.places)
    together = np.mean(u * state.coords, axis=0)
    assert np.abs(together[own]).max() < 0.7  # part of a quarter turn
    others = np.setdiff1d(np.arange(8), own)
    np.testing.assert_array_equal(state.coords[:, others], u[:, others])


def two_widths():
    """Two groups of two numbers: one far from a standard Gaussian, one near it."""
    precision = np.array([1.0, 6.0, 1.2, 1.0, 1.0])
    group = np.array([0, 0, 1, 1, -1])

    def terms(x):
        each = -0.5 * precision * x**2
        return np.stack([each[:, group == g].sum(axis=1) for g in (0, 1, -1)], axis=1)

    target = LogDensity(terms, lambda x: -precision * x, group, np.zeros(5), np.eye(5))
    return target.in_coordinates(target.laplace()), precision


@pytest.mark.slow
def test_each_group_has_its_own_hamiltonian_trajectory():
    """Steps too long for one group are refused for that group only, and both stay exact."""
    target, precision = two_widths()
    u = np.random.RandomState(1).standard_normal((4000, 5)) / np.sqrt(precision)
    model, state = state_of(target, u)
    move, moved = Hamiltonian(target, families(target)[0], 1.0), []
    for _ in range(6):
        before = state.coords.copy()
        state, _ = move.propose(model, state)
        moved.append((state.coords != before).mean(axis=0))
    moved = np.mean(moved, axis=0)
    assert moved[1] < 0.8
    assert moved[2] > 0.95
    np.testing.assert_allclose(state.coords.std(axis=0) * np.sqrt(precision), 1.0, atol=0.05)


def test_a_walker_whose_slope_is_lost_stays_with_all_its_groups():
    target, _ = two_widths()
    lost = replace(target, slope=lambda x: np.where(x[:, :1] > 1, np.nan, target.slope(x)))
    u = np.zeros((200, 5))
    u[:100, 0] = 1.5
    model, state = state_of(target, u)
    state, _ = Hamiltonian(lost, families(target)[0], 0.1).propose(model, state)
    moved = (state.coords != u).any(axis=1)
    assert moved[100:].mean() > 0.7
    assert moved[:100].mean() == 0  # they are refused, wherever the trajectory ended


@pytest.mark.slow
@pytest.mark.parametrize("groups", [(0, 1), None])
def test_walking_along_a_coordinate_keeps_the_distribution(bent, groups):
    """Exact draws of a Gaussian seen through a curved map stay exact."""
    map, _ = bent
    target = made_gaussian(map, np.array([-1, -1, 0, 0, 0, 0, 1, 1, 1]))
    model, u = model_of(target), np.random.RandomState(1).standard_normal((4000, 9))
    _, state = state_of(target, u)
    moved = 0.0
    move = CoordinateWalk(target, groups)
    for _ in range(8):
        state, took = move.propose(model, state)
        moved += took.mean() / 8
    assert moved > 0.15
    np.testing.assert_allclose(state.coords.mean(axis=0), 0.0, atol=0.08)
    np.testing.assert_allclose(state.coords.std(axis=0), 1.0, atol=0.05)
    np.testing.assert_allclose(np.corrcoef(state.coords.T), np.eye(9), atol=0.08)
    np.testing.assert_allclose(state.log_prob, target.terms(state.coords).sum(axis=1), atol=1e-9)


def test_whole_differences_lead_from_mode_to_mode():
    target, _, _ = two_modes()
    (family,) = families(target)
    move, random = DifferentialEvolution(family), np.random.RandomState(0)
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
