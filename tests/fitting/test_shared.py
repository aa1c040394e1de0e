"""Shared effects, against covariances of all runs together, written out."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from slipid.fitting import hierarchy
from slipid.fitting.noise import SHARED, effects
from slipid.fitting.optimise import optimise
from slipid.fitting.problem import FitState, Problem, effects_given, without_effects
from slipid.fitting.shared_effects import (
    DIRECTION_LENGTH,
    MIRROR_CORRELATION,
    OTHER_LOAD_CORRELATION,
    SPEED_LENGTH,
    FittedEffects,
    SpeedAndLoad,
    TravelConditions,
    forecast_effects,
    marginal_residuals,
)
from slipid.fitting.variances import fitted_covariance
from slipid.predict.predictive import force_balance_of
from slipid.predict.slip_model import setups
from slipid.search_space import Choice
from tests.helpers.dense import of_shared
from tests.helpers.made_windows import made, robot

STD = {
    "camera.place": 0.0005,
    "camera.heading": 0.003,
    **{f"process.{axis}": 0.004 for axis in ("along", "across", "yaw")},
    **{f"run.{axis}": 0.01 for axis in ("along", "across", "yaw")},
}
CHOICES = (
    Choice("*", free=False),
    Choice("surface.*.creep", free=True),
    Choice("robot.load_share@as_built", free=True),
    Choice("surface.*.load_bias", free=True),
)
RUNS = 48


@pytest.fixture(scope="module")
def problem():
    """Two floors, two load set-ups, two sessions and two speeds."""
    w = replace(made(robot(), runs=RUNS, std=STD), has_current=False, has_voltage=False)
    return Problem(w, robot(), CHOICES)


def log_variance(problem):
    """Effects that runs share as large as their own, or what is shared would hardly show."""
    std = dict(zip(problem.noise.names, problem.noise.typical, strict=True))
    for name in std:
        kind, _, rest = name.partition(".")
        std[name] = std[f"run.{rest}"] if kind in ("neighbours", "session") else std[name]
    return 2 * np.log(list(std.values()))


def motion(problem, log_v, z=None):
    z = problem.space.start if z is None else z
    blocks, jacobian = problem.linear(z, problem.electric(z, log_v))
    return blocks, jacobian


# the kernel -------------------------------------------------------------------------------------


@pytest.mark.parametrize("mirror", [None, 0.0, np.pi / 2])
def test_neighbours_are_correlated_as_the_periodic_kernel_says(mirror):
    turn = np.radians([0.0, 3.0, 10.0, 25.0, 180.0, 350.0])
    slow, fast, moved = SpeedAndLoad(-2.25, "a"), SpeedAndLoad(-1.5, "a"), SpeedAndLoad(-2.25, "b")
    pace = (slow, fast, moved)
    rows = [TravelConditions(turn, (p,) * len(turn), mirror).basis(pace) for p in pace]

    def near(apart):
        return np.exp(-2 * (np.sin(apart / 2) / DIRECTION_LENGTH) ** 2)

    between = {
        (0, 0): 1.0,
        (0, 1): np.exp(-0.5 * (0.75 / SPEED_LENGTH) ** 2),
        (0, 2): OTHER_LOAD_CORRELATION,
    }
    for (i, j), share in between.items():
        # along alike to either side of the axis, across and in yaw the other way round
        for k, sign in enumerate((1, -1, -1)):
            expected = near(turn[:, None] - turn)
            if mirror is not None:
                expected += sign * MIRROR_CORRELATION * near(turn[:, None] + turn - 2 * mirror)
            np.testing.assert_allclose(rows[i][k] @ rows[j][k].T, share * expected, atol=0.02)


def test_a_run_on_the_spot_has_no_neighbours_and_a_new_speed_is_less_known():
    pace = (SpeedAndLoad(-2.0, "a"),)
    still = TravelConditions(np.array([np.nan]), pace, 0.0).basis(pace)
    assert not still.any()
    other = TravelConditions(np.zeros(1), (SpeedAndLoad(-1.0, "a"),), None).basis(pace)
    squares = (other**2).sum(axis=-1)
    np.testing.assert_allclose(squares, np.exp(-((1 / SPEED_LENGTH) ** 2)), atol=0.01)


@pytest.mark.parametrize("mirror", [None, 0.0])
def test_new_paces_keep_the_variance_of_the_process(mirror):
    """What neighbours cannot tell is left, so that far from them all of it is."""
    seen, other = SpeedAndLoad(-2.0, "a"), SpeedAndLoad(-1.4, "b")
    turn, count = np.array([0.0, 0.05, 1.0, np.nan]), 3 * 31
    of = FittedEffects(
        speeds_and_loads=(seen,),
        std=np.array([0.1, 0.2, 0.3]),
        coefs=np.zeros((3, 31)),
        by_number=np.zeros((3, 31, 1)),
        covariance=np.eye(count).reshape(3, 31, 3, 31),  # nothing was learnt
    )
    near = np.exp(-2 * (np.sin(turn) / DIRECTION_LENGTH) ** 2)
    for pace in (seen, other):
        told = of.forecast(TravelConditions(turn, (pace,) * 4, mirror))
        for k, sign in enumerate((1, -1, -1)):
            whole = 1.0 if mirror is None else 1 + sign * MIRROR_CORRELATION * near
            expected = of.std[k] ** 2 * np.where(np.isfinite(turn), whole, 1.0)
            np.testing.assert_allclose(told.covariance[:, k, k], expected, rtol=0.03)


# marginalised -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_loss_is_the_marginal_likelihood_of_all_runs(problem):
    """With weights and roots held, against one Gaussian of all residuals."""
    keep, none = np.ones(RUNS), np.zeros((RUNS, 3))
    log_v = log_variance(problem)
    blocks, _ = motion(problem, log_v)
    found = []
    for step in (np.zeros(len(log_v)), np.linspace(-0.5, 0.7, len(log_v))):
        seen = problem.weighed(blocks, log_v + step, keep, none)
        root = np.asarray(seen.whitening.root["motion"])
        own = np.linalg.inv(np.swapaxes(root, 1, 2) @ root)
        whole = block_diag(*own) + of_shared(problem, log_v + step)
        flat = np.asarray(blocks["motion"]).ravel()
        white = jnp.einsum("nij,nj->ni", root, blocks["motion"])
        square = float(jnp.sum(marginal_residuals(seen.effects, white) ** 2))
        assert square == pytest.approx(flat @ np.linalg.solve(whole, flat), rel=1e-9)
        factors = sum(float(jnp.log(jnp.diagonal(t.factor)).sum()) for t in seen.effects)
        exact = 0.5 * (np.linalg.slogdet(whole)[1] - np.linalg.slogdet(block_diag(*own))[1])
        assert factors == pytest.approx(exact, rel=1e-9)
        found.append(square)
    assert found[0] != pytest.approx(found[1], rel=0.01)


@pytest.mark.slow
def test_effects_found_are_their_conditional_mean(problem):
    log_v, keep = log_variance(problem), np.ones(RUNS)
    blocks, _ = motion(problem, log_v)
    seen = problem.weighed(blocks, log_v, keep, np.zeros((RUNS, 3)))
    root = np.asarray(seen.whitening.root["motion"])
    own = block_diag(*np.linalg.inv(np.swapaxes(root, 1, 2) @ root))
    flat, whole = np.asarray(blocks["motion"]).ravel(), of_shared(problem, log_v)
    expected = whole @ np.linalg.solve(own + whole, flat)
    effect = effects_given(seen.effects, seen.whitening.root["motion"], blocks["motion"])
    left = without_effects(problem.objective, blocks, effect)["motion"]
    np.testing.assert_allclose(flat - np.asarray(left).ravel(), expected, atol=1e-12)


@pytest.mark.slow
def test_the_spread_of_residuals_is_that_of_numbers_and_effects_together(problem):
    """Posterior covariance of J z + E e, with the whole information of both written out."""
    log_v, keep = log_variance(problem), np.ones(RUNS)
    _, jacobian = motion(problem, log_v)
    told = np.asarray(
        fitted_covariance(problem.objective, jacobian, jnp.asarray(log_v), jnp.asarray(keep))[
            "motion"
        ]
    )
    j = np.asarray(jacobian["motion"])
    n, m, free = j.shape
    factor = (8.0 + m) / (8.0 + m + 2.0)
    own = block_diag(*(np.asarray(problem.covariance("motion", log_v)) / factor))
    # residuals less effects: J z - E e, with prior covariances of both
    prior = np.asarray(problem.objective.prior_std(log_v)) ** 2
    flat = j.reshape(n * m, free)
    signal = (flat * prior) @ flat.T + of_shared(problem, log_v)
    posterior = signal - signal @ np.linalg.solve(own + signal, signal)
    each = posterior.reshape(n, m, n, m)[np.arange(n), :, np.arange(n)]
    np.testing.assert_allclose(told, each, rtol=1e-6, atol=1e-12)


# predictions of other runs ----------------------------------------------------------------------


@pytest.mark.slow
def test_what_neighbours_tell_is_that_of_the_dense_gaussian(problem):
    """Mean and covariance of a new run's effect given the fitted ones, numbers held."""
    keep = np.ones(RUNS)
    keep[5::6] = 0.0
    end, log_v, w = (
        optimise(problem, keep=keep, most_rounds=4),
        log_variance(problem),
        problem.windows,
    )
    state = replace(end.state, log_variance=log_v)
    model = force_balance_of(problem, state, end.covariance, keep)
    blocks, _ = motion(problem, log_v, state.z)
    seen = problem.weighed(blocks, log_v, keep, state.effect)
    root = np.asarray(seen.whitening.root["motion"])
    whole = of_shared(problem, log_v)
    flat = np.asarray(blocks["motion"]).ravel()
    used = np.repeat(keep > 0, root.shape[1])
    own = block_diag(*[np.linalg.inv(r.T @ r) for r in root[keep > 0]])
    inverse = np.linalg.inv(own + whole[np.ix_(used, used)])
    names = problem.noise.names
    silent = [-80.0 if n.startswith("session.") else v for n, v in zip(names, log_v, strict=True)]
    near = of_shared(problem, np.asarray(silent))  # of a session that was not seen
    expected = (near[:, used] @ inverse @ flat[used]).reshape(RUNS, -1)
    told = forecast_effects(model.shared, w, problem.robot, problem.space.size)
    moved = np.einsum("nma,na->nm", effects(w, problem.robot), told.mean)
    out = keep == 0
    assert np.abs(expected[out]).max() > 1e-4
    np.testing.assert_allclose(moved[out], expected[out], rtol=1e-6, atol=1e-9)
    # the covariance takes the information that is expected, as Laplace's does
    factor = (8.0 + root.shape[1]) / (8.0 + root.shape[1] + 2.0)
    plain = np.asarray(problem.covariance("motion", log_v))[keep > 0] / factor
    inverse = np.linalg.inv(block_diag(*plain) + whole[np.ix_(used, used)])
    known = near - near[:, used] @ inverse @ near[used]
    for k in np.flatnonzero(out):
        e = np.asarray(effects(w, problem.robot))[k]
        at = slice(k * len(e), (k + 1) * len(e))
        np.testing.assert_allclose(
            e @ told.covariance[k] @ e.T, known[at, at], rtol=0.02, atol=1e-10
        )


# variances --------------------------------------------------------------------------------------


def axis_of(rng, runs=60):
    """Effects with known variances: own, shared by neighbours and by three sessions."""
    place = rng.uniform(0, 2 * np.pi, runs)
    near = np.exp(-2 * (np.sin((place[:, None] - place) / 2) / 0.3) ** 2)
    member = (np.arange(runs)[:, None] % 3 == np.arange(3)).astype(float)
    bases = [np.eye(runs), near, member @ member.T]
    fixed = 0.2 * np.eye(runs)
    true = np.array([1.0, 2.0, 0.5])
    whole = fixed + sum(v * b for v, b in zip(true, bases, strict=True))
    left = np.linalg.cholesky(whole + 1e-9 * np.eye(runs)) @ rng.normal(size=runs)
    noise = np.full(runs, 0.2)
    return hierarchy.AxisEffects(
        0, np.arange(runs), left, fixed, noise, [0, 1, 2], bases, np.zeros(3)
    )


@pytest.mark.parametrize("seed", range(3))
def test_scoring_ends_at_the_summit_of_the_likelihood(seed):
    axis = axis_of(np.random.default_rng(seed))

    def loss(log_v):
        whole = axis.fixed + sum(v * b for v, b in zip(np.exp(log_v), axis.bases, strict=True))
        own = multivariate_normal(np.zeros(len(whole)), whole).logpdf(axis.left)
        return -own + 0.5 * float(np.sum((log_v / 3.0) ** 2))

    found = hierarchy._scoring_steps(axis, np.array([1.0, -1.0, 2.0]))
    step = 1e-4 * np.eye(3)
    slope = [(loss(found + e) - loss(found - e)) / 2e-4 for e in step]
    np.testing.assert_allclose(slope, 0.0, atol=1e-2)
    assert all(loss(found + 0.3 * s * e / 1e-4) > loss(found) for e in step for s in (-1, 1))


def test_sectors_left_out_are_predicted_as_the_dense_gaussian_of_the_others_does():
    rng, log_v = np.random.default_rng(0), np.zeros(3)
    axis = axis_of(rng)
    way = np.linspace(0.1, 2 * np.pi - 0.1, 60)
    found = hierarchy._held_out_effects([axis], log_v, way)
    whole = hierarchy._covariance(axis, np.ones(3))
    for out in (np.arange(60) // 10 == k for k in range(6)):
        to = whole[np.ix_(out, ~out)] @ np.linalg.inv(whole[np.ix_(~out, ~out)])
        spread = np.diag(whole[np.ix_(out, out)] - to @ whole[np.ix_(~out, out)])
        np.testing.assert_allclose(found.gap[out, 0], axis.left[out] - to @ axis.left[~out])
        np.testing.assert_allclose(found.spread[out, 0], spread)
    np.testing.assert_allclose(found.own[:, 0], 1.2)  # its own effect and noise
    assert np.isnan(found.gap[:, 1:]).all()


def left_out(size, runs=4000):
    """Gaps whose shared part is so many times as wide as it is said to be."""
    rng = np.random.default_rng(3)
    own, share = np.array([0.3, 0.2, 0.4]), np.array([1.0, 0.7, 2.0])
    normal, other = rng.standard_normal((2, runs, 3))
    gap = np.sqrt(own) * normal + size * np.sqrt(share) * other
    gap *= np.sqrt(8.0 / rng.chisquare(8.0, (runs, 1)))  # of one run together, as ends are
    spread = np.broadcast_to(own + share, gap.shape)
    return hierarchy._HeldOutEffects(gap, spread, np.broadcast_to(own, gap.shape))


@pytest.mark.parametrize(("size", "growth"), [(1.0, 1.0), (0.5, 1.0), (1.5, 2.25), (9.0, 10.0)])
def test_variances_grow_until_nine_ends_in_ten_lie_in_their_regions(size, growth):
    far, every = np.full(4000, 0.6), np.ones(4000, bool)
    assert hierarchy._variance_growth(left_out(size), far, every) == pytest.approx(growth, rel=0.08)


def test_few_runs_or_sectors_say_nothing_of_the_tail():
    few = np.arange(4000) < hierarchy.LEAST_RUNS - 1
    assert hierarchy._variance_growth(left_out(1.5), np.full(4000, 0.6), few) == 1.0
    axis = axis_of(np.random.default_rng(0))
    found = hierarchy._held_out_effects([axis], np.zeros(3), np.linspace(0.0, 1.5, 60))
    assert np.isnan(found.gap).all()


@pytest.mark.slow
def test_every_axis_has_the_covariance_of_its_own_effects(problem):
    """Scoring of the variances sees what the fit marginalises, along, across and in yaw."""
    log_v = log_variance(problem)
    blocks, jacobian = motion(problem, log_v)
    moved = blocks["motion"], jacobian["motion"]
    covariance = np.diag(problem.space.prior_std**2)
    axes = list(hierarchy.axis_effects(problem.objective, moved, jnp.ones(RUNS), covariance, log_v))
    assert len(axes) == 3 * len(problem.objective.shared)
    for k, axis in enumerate(axes):
        root = problem.objective.shared[k // 3].root(jnp.asarray(log_v))[axis.number]
        v = np.exp(log_v)[axis.numbers]
        found = sum(v[j] * axis.bases[j] for j in range(1, len(v)))  # but what each has alone
        np.testing.assert_allclose(found, root @ root.T, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_forecasts_grow_but_for_what_each_run_has_alone(problem):
    """Ends and increments; the own part is that of a model which knows all else for sure."""
    log_v, w = log_variance(problem), problem.windows
    covariance = np.diag((0.1 * problem.space.prior_std) ** 2)
    state = FitState(problem.space.start, log_v, 0, 0.0, 0.0, "joint", np.zeros((RUNS, 3)))
    plain = replace(force_balance_of(problem, state, covariance, np.ones(RUNS)), extrapolation={})
    grown = replace(plain, extrapolation=dict.fromkeys(setups(w), 4.0))
    kept = {n: v for n, v in plain.variance.items() if n.split(".")[0] not in SHARED}
    sure = {name: replace(x, covariance=0 * x.covariance) for name, x in plain.shared.items()}
    alone = replace(plain, shared=sure, variance=kept, covariance=0 * covariance)
    told = plain.effect_covariance(w)
    np.testing.assert_allclose(grown.effect_covariance(w), 4 * told, rtol=1e-12)
    one, four, own = (m.ends(w)[1] for m in (plain, grown, alone))
    assert np.trace(own, axis1=1, axis2=2).min() > 0
    # the covariance of the ends is linear in what grows
    np.testing.assert_allclose(four - own, 4 * (one - own), rtol=1e-4, atol=1e-11)
    noise = np.asarray(problem.covariance("motion", log_v))
    before, after = (m.scale(problem)[1] - noise for m in (plain, grown))
    assert np.abs(before).max() > 1e-6
    np.testing.assert_allclose(after, 4 * before, rtol=1e-8, atol=1e-12)


def test_sectors_are_cut_where_no_runs_are_parted():
    """Headings every five degrees, driven three times and seen with noise."""
    rng = np.random.default_rng(1)
    heading = np.repeat(np.radians(np.arange(0, 360, 5)), 3)
    found = hierarchy._sectors(heading + np.radians(0.4) * rng.uniform(-1, 1, len(heading)))
    assert sorted(np.concatenate(found)) == list(range(len(heading)))
    assert [len(mine) for mine in found] == [36] * 6
    for mine in found:
        assert {k // 3 for k in mine} == {k // 3 for k in mine if k % 3 == 0}


def test_what_floors_differ_by_has_the_pooled_std_a_priori(problem):
    log_v = log_variance(problem)
    log_v[problem.objective.pooled] = 2 * np.log(0.03)
    std = np.asarray(problem.objective.prior_std(log_v))
    pooled = problem.space.pooled
    assert 0 < pooled.sum() < len(std)
    np.testing.assert_allclose(std[pooled], 0.03, rtol=1e-12)
    np.testing.assert_array_equal(std[~pooled], problem.space.prior_std[~pooled])


def test_the_pooled_variance_weighs_every_std_by_its_evidence(problem):
    """One floor's two coordinates of a Gaussian with known information, by brute force."""
    log_v = log_variance(problem)
    free = problem.space.size
    rng = np.random.default_rng(3)
    root = rng.normal(size=(free, free)) * 5
    at = np.flatnonzero(problem.space.pooled)
    told = root @ root.T + np.eye(free)
    precision = told.copy()
    precision[at, at] += np.exp(-log_v[problem.objective.pooled])
    best = np.linalg.solve(precision, told @ rng.normal(size=free) * 0.05)
    best[np.setdiff1d(np.arange(free), at)] = 0.0
    found = hierarchy.pooled(precision, best, problem.objective, log_v)
    # the likelihood that has this posterior: information told, and where it is highest
    centre = precision @ np.where(problem.space.pooled, best, 0.0)
    typical = np.exp(0.5 * float(problem.objective.typical[problem.objective.pooled]))
    std = np.linspace(0.1, 4.0, 4000) * typical
    log = np.empty(len(std))
    for k, s in enumerate(std):
        whole = told.copy()
        whole[at, at] += 1 / s**2
        half = np.linalg.slogdet(whole)[1] + 2 * len(at) * np.log(s)
        log[k] = (
            0.5 * centre @ np.linalg.solve(whole, centre) - 0.5 * half - 0.5 * (s / typical) ** 2
        )
    weight = np.exp(log - log.max())
    assert np.exp(found) == pytest.approx(np.sum(weight * std**2) / weight.sum(), rel=0.02)
