"""Surrogates are right where they can be, and moves that follow wrong ones are refused."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from emcee.model import Model
from emcee.state import State

from slipid.infer.posterior.blocks import ChainBlock, Learnt, Plan, packed, unpacked
from slipid.infer.posterior.learning import STRETCHED, Learner
from slipid.infer.posterior.proposals import (
    CoordinateWalk,
    DifferentialEvolution,
    Hamiltonian,
    families,
)
from slipid.infer.posterior.surrogate import (
    ResidualRows,
    _pairs,
    gaussian_root,
    group_surrogate,
    term_count,
)
from tests.infer.posterior.test_ensemble import gaussian, plateau

pytestmark = pytest.mark.slow
PLAN = Plan(ensembles=4, walkers=16, rows=300, spread=1.0)  # shapes of test_ensemble.py
COPIES = 4000


@pytest.fixture(scope="module")
def exact():
    """Return a Gaussian, what was learnt of it, and draws of it."""
    target, mean, _ = gaussian()
    root = gaussian_root(target.covariance / 0.6, target.group)
    x = mean + np.random.RandomState(1).standard_normal((COPIES, 8)) @ root.T
    return target, Learner(target, PLAN).first, x, (mean, root)


def state_of(target, x):
    """Return the model that emcee gives to moves, and the state of walkers."""

    def compute(x):
        out = target.log_prob(x)
        return out[:, 0], out[:, 1:]

    model = Model(target.log_prob, compute, map, np.random.RandomState(0))
    log_prob, terms = compute(x)
    return model, State(x, log_prob=log_prob, blobs=terms, copy=True)


def test_a_surrogate_of_linear_residuals_is_exact(exact):
    target, learnt, x, (mean, _) = exact
    near = mean + 0.5 * (x[:16] - mean)  # inside the range of plausible rows
    found = np.asarray(learnt.surrogate.with_slope(jnp.asarray(near)).value)
    off = found - target.terms(near)
    np.testing.assert_allclose(off - off[0], 0.0, atol=2e-3)


def test_a_surrogate_of_quadratic_residuals_is_exact():
    rng, size = np.random.default_rng(0), 3
    slope, bent = rng.standard_normal((size, 4)), rng.standard_normal((4, size, size))

    def rows(x):
        found = x @ slope + np.einsum("ra,kab,rb->rk", x, bent, x)
        return ResidualRows(x, found[:, :3], 0.1 * found[:, 3])

    of, positive = np.array([np.arange(size), np.full(size, -1)]), np.zeros(size, bool)
    found = group_surrogate(rows(rng.standard_normal((400, size))), of, positive, size)
    new = rows(rng.standard_normal((50, size)))
    value = found.with_slope(jnp.asarray(new.x), 0.0).value
    np.testing.assert_allclose(value, new.log_likelihood, rtol=1e-4, atol=1e-2)


def test_a_root_has_the_covariance_of_groups_that_are_independent_given_what_they_share(exact):
    target, *_, (_, root) = exact
    np.testing.assert_allclose(root @ root.T, target.covariance / 0.6, rtol=1e-9, atol=1e-12)
    one, other = target.group == 0, target.group == 1
    assert (root[np.ix_(one, other)] == 0).all()
    assert (root[np.ix_(target.group < 0, ~(target.group < 0))] == 0).all()


def test_slopes_are_those_of_the_values():
    target, _, _ = plateau()
    surrogate = Learner(target, PLAN).first.surrogate
    x = target.centre + 0.3 * np.random.default_rng(0).standard_normal((16, 2))
    x[0] += 30.0  # outside the range of plausible rows

    def value(x):
        return np.asarray(surrogate.with_slope(jnp.asarray(x), 1.0).value).sum(axis=1)

    step = 1e-2 * np.eye(2)
    numeric = np.stack([(value(x + s) - value(x - s)) / 2e-2 for s in step], axis=1)
    slope = np.asarray(surrogate.with_slope(jnp.asarray(x), 1.0).slope)
    np.testing.assert_allclose(slope, numeric, rtol=0.02, atol=0.3)
    assert value(x)[0] < value(x)[1:].min() - 1e4


@pytest.mark.parametrize("which", [0, 1])
def test_a_hamiltonian_move_is_accepted_where_the_surrogate_is_exact(exact, which):
    target, learnt, x, _ = exact
    family = families(target)[which]
    model, state = state_of(target, x[:16])
    move = Hamiltonian(target, family, learnt.surrogate, float(learnt.step[which]))
    state, accepted = move.propose(model, state)
    assert accepted.mean() > 0.99
    np.testing.assert_allclose(state.log_prob, target.terms(state.coords).sum(axis=1), rtol=1e-9)
    same = (state.coords == x[:16]).all(axis=0)
    np.testing.assert_array_equal(same, family.block < 0)


@pytest.mark.parametrize("kind", [Hamiltonian, CoordinateWalk, DifferentialEvolution])
@pytest.mark.parametrize("which", [0, 1])
def test_moves_keep_the_distribution_though_the_surrogate_is_wrong(exact, kind, which):
    """Draws of a Gaussian stay draws of it, though the surrogate's centre and width are off."""
    target, learnt, x, (mean, root) = exact
    wrong = learnt.surrogate._replace(
        prior_mean=learnt.surrogate.prior_mean + 0.5,
        groups=tuple(
            g._replace(constant=g.constant + 0.4, linear=1.2 * g.linear)
            for g in learnt.surrogate.groups
        ),
    )
    more = {
        Hamiltonian: (wrong, float(learnt.step[which])),
        CoordinateWalk: (wrong,),
        DifferentialEvolution: (),
    }[kind]
    family = families(target)[which]
    model, state = state_of(target, x)
    move = kind(target, family, *more)
    taken = []
    for _ in range(6):
        before = state.coords.copy()
        state, _ = move.propose(model, state)
        moved = (state.coords != before).any(axis=0) & (family.block >= 0)
        taken.append((state.coords != before)[:, moved].mean())
    assert 0.01 < np.mean(taken) < 0.97
    standard = np.linalg.solve(root, (state.coords - mean).T).T
    np.testing.assert_allclose(standard.mean(axis=0), 0.0, atol=4 / np.sqrt(COPIES))
    np.testing.assert_allclose(standard.std(axis=0), 1.0, atol=3 / np.sqrt(COPIES))
    assert (state.coords != x).any(axis=0)[family.block >= 0].all()


def test_each_group_is_accepted_by_its_own_term(exact):
    target, learnt, x, _ = exact
    groups = learnt.surrogate.groups
    wrong = learnt.surrogate._replace(
        groups=(groups[0], groups[1]._replace(constant=groups[1].constant + 3.0))
    )
    model, state = state_of(target, x)
    move = Hamiltonian(target, families(target)[1], wrong, 0.3)
    moved = move.propose(model, state)[0].coords != x
    assert moved[:, target.group == 0].mean() > 0.97
    assert moved[:, target.group == 1].mean() < 0.6


def test_blocks_are_stored_with_what_was_learnt(exact):
    _, learnt, x, _ = exact
    random = np.zeros((4, 624), np.uint32), np.zeros((4, 3))
    plain = ChainBlock(3, x[:64].reshape(4, 1, 16, 8), np.zeros((4, 1, 16)), random, x[0, :4], None)
    assert unpacked(packed(plain)).learnt is None
    again = unpacked(packed(replace(plain, learnt=learnt))).learnt
    assert isinstance(again, Learnt)
    values = (of.surrogate.with_slope(jnp.asarray(x[:16])).value for of in (again, learnt))
    np.testing.assert_array_equal(*values)
    np.testing.assert_array_equal(again.places, learnt.places)


def test_a_group_of_zero_density_is_refused_alone():
    terms = np.array([[-np.inf, -1.0, 0.0], [-1.0, -2.0, 0.0]])
    target, _, _ = gaussian()
    np.testing.assert_array_equal(families(target)[1].summed(terms), terms[:, :2])


def test_groups_without_coordinates_of_their_own_do_not_move():
    target, _, _ = gaussian()
    depends = np.ones((4, 8), bool)
    more = replace(target, group=np.where(target.group == 1, 2, target.group), depends=depends)
    of_groups = families(more)[1]
    assert of_groups.blocks == 2
    np.testing.assert_array_equal(of_groups.of_term, [0, -1, 1, -1, -1])
    np.testing.assert_array_equal(of_groups.block, target.group)


def test_a_laplace_approximation_far_too_wide_still_gives_a_surrogate():
    target, mean, _ = gaussian()
    wide = replace(target, centre=mean, covariance=1e4 * target.covariance)
    found = Learner(wide, PLAN).first.surrogate.with_slope(
        jnp.asarray(mean[None] + np.zeros((16, 1)))
    )
    assert np.isfinite(found.value).all()
    assert np.isfinite(found.slope).all()


def test_a_quotient_that_alone_matters_is_an_input():
    """Residuals that depend on p s / (q + s) depend on p / q alone where both are large."""
    random, slip = np.random.default_rng(0), np.linspace(0.05, 1.0, 12)
    x = np.stack([random.normal(2.0, 2.0, 900), random.normal(2.0, 2.0, 900)], axis=1)
    x[:, 0] = 0.5 * x[:, 1] + random.normal(0.0, 0.3, 900)  # along the ridge

    def rows(x):
        p, q = np.exp(x).T
        y = 3.0 * np.log1p(p[:, None] * slip / (q[:, None] + slip))
        return ResidualRows(x, y, np.zeros(len(x)))

    def error(of):
        found = group_surrogate(rows(x[:600]), np.array(of).T, np.ones(2, bool), 2)
        new = rows(x[600:])
        value = np.asarray(found.with_slope(jnp.asarray(new.x), 0.0).value)
        return np.std(value - new.log_likelihood)

    assert error([(0, -1), (1, -1), (0, 1)]) < 0.5 * error([(0, -1), (1, -1)])


def test_terms_are_counted_as_they_are_fitted():
    random, size = np.random.default_rng(0), 11
    x = random.standard_normal((400, size))
    of, positive = np.array([np.arange(size), np.full(size, -1)]), np.arange(size) != 4
    for some in (slice(None), slice(4, 8)):
        found = group_surrogate(ResidualRows(x, x, np.zeros(400)), of[:, some], positive, size)
        assert term_count(of[:, some], positive) == 1 + len(of[0, some]) + len(
            _pairs(found.inputs)[0]
        )


def test_walkers_do_not_start_where_the_surrogate_claims_too_much(exact):
    target, learnt, x, _ = exact
    places, false = x[:64], x[:64, 0] > np.quantile(x[:64, 0], 0.8)

    def lower(x):
        return target.terms(x) - 300.0 * (x[:, :1] > places[~false, 0].max())

    learner = Learner(replace(target, terms=lower), PLAN)
    new = learner._plausible(places, learnt.surrogate, np.random.default_rng(0))
    stays = (new == places).all(axis=1)
    assert not stays[false].any()
    assert stays[~false].mean() > 0.9
    assert (new[:, 0] <= places[~false, 0].max()).all()
    nowhere = Learner(replace(target, terms=lambda x: np.full((len(x), 3), -np.inf)), PLAN)
    kept = nowhere._plausible(places, learnt.surrogate, np.random.default_rng(0))
    np.testing.assert_array_equal(kept, places)


def test_some_rows_are_moved_along_weak_coordinates():
    target, _, _ = plateau()
    learner = Learner(target, PLAN)
    surrogate = learner.first.surrogate
    rows = np.zeros((1000, 2))
    learner._stretch(rows, surrogate, np.random.default_rng(0))
    moved = rows[: int(1000 * STRETCHED)]
    assert not rows[len(moved) :].any()
    covariance = surrogate.root @ surrogate.root.T
    std = np.sqrt(covariance[0, 0])  # of the positive coordinate
    assert 2.8 < np.abs(moved[:, 0]).max() / std <= 3.0
    np.testing.assert_allclose(moved[:, 1], moved[:, 0] * covariance[0, 1] / std**2)
