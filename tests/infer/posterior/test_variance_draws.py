"""Draws of variances against densities in closed form, and their likelihood written out densely."""

import threading
from concurrent.futures import CancelledError
from dataclasses import replace
from itertools import islice

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_t, norm

from slipid.fitting.hierarchy import POOLED_RANGE
from slipid.fitting.noise import Components
from slipid.fitting.problem import Problem, log_jacobian
from slipid.fitting.shared_effects import SharedEffects
from slipid.fitting.variances import DEGREES, VARIANCE_SPREAD
from slipid.infer.posterior.coordinates import Fitted, effects_at
from slipid.infer.posterior.variance_draws import (
    added_covariance,
    drawn_variances,
    floor_information,
    floor_runs,
    sweeps,
    weights_at,
)
from slipid.infer.posterior.variance_likelihood import (
    LinearPart,
    PooledPrior,
    Residuals,
    SegmentNoise,
    linear_parts,
    target,
)
from slipid.search_space import Choice
from tests.helpers import dense
from tests.helpers.made_windows import made, robot

STD = {"camera.place": 0.0005, "process.along": 0.003, "run.along": 0.01, "current.window": 0.05}
FREE = [
    Choice("*", free=False),
    Choice("surface.*.creep", free=True),
    Choice("surface.*.load_bias", free=True),
    Choice("motor.resistance", free=True),
]
PROBABILITIES = np.array([0.05, 0.25, 0.5, 0.75, 0.95])


@pytest.fixture(scope="module")
def problem():
    truth = robot()
    windows = made(truth, std=STD)
    return Problem(replace(windows, current_var=np.full((24, 2, 3), 1e-3)), truth, FREE)


@pytest.fixture(scope="module")
def fitted(problem):
    """Return fitted values, with load biases that are not those of their prior."""
    log_v = 2 * np.log(problem.noise.typical)
    z = problem.space.start + np.where(problem.space.pooled, 0.1, 0.0)
    return Fitted(z, log_v, problem.laplace(z, log_v, np.ones(len(problem.windows))))


def part_of(rows, base, known, degrees, shared=(), typical=None):
    """Return segments with covariances `base` of every component, and parameters hardly known."""
    n, m, columns = rows.shape
    noise = Components(
        base=jnp.asarray(np.broadcast_to(base, (n, *np.shape(base))).copy()),
        which=jnp.tile(jnp.arange(len(base)), (n, 1)),
        known=jnp.full((n, m), known),
        segments=jnp.arange(n),
        count=jnp.full(n, float(m)),
    )
    free = columns - 1
    return LinearPart(
        noises={"motion": noise},
        rows={"motion": rows},
        precision=1e-9 * np.eye(free),
        pull=np.zeros(free),
        given=np.zeros((free, free)),
        shared=shared,
        typical=np.zeros(len(base)) if typical is None else typical,
        degrees=degrees,
    )


def drawn(part, start, number, chains=4):
    found = islice(sweeps(part, start, chains, 200, np.random.default_rng(1)), 200, 200 + number)
    return np.stack([at.log_variance for at in found], axis=1)


def assert_quantiles(x, grid, log_density, effective):
    """The draws' quantiles have the probabilities of a density on a grid, to three std errors."""
    weight = np.exp(log_density - log_density.max())
    cumulated = np.cumsum(weight) / weight.sum()
    found = np.interp(np.quantile(x, PROBABILITIES), grid, cumulated)
    error = np.sqrt(PROBABILITIES * (1 - PROBABILITIES) / effective)
    np.testing.assert_allclose((found - PROBABILITIES) / error, 0.0, atol=3.0)


def log_prior(x):
    return -0.5 * (x / VARIANCE_SPREAD) ** 2


@pytest.mark.slow
def test_variances_of_a_balanced_layout_have_the_restricted_likelihood():
    """Sums of squares within and between are chi-square of n (k - 1) and n - 1 degrees.

    The variance between is near zero, so that its density has a long tail.
    """
    n, k = 12, 3
    rng = np.random.default_rng(5)
    y = rng.standard_normal((n, k)) + 0.2 * rng.standard_normal((n, 1))
    rows = np.stack([np.ones((n, k)), y], axis=-1)
    part = part_of(rows, np.stack([np.eye(k), np.ones((k, k))]), 1e-9, degrees=1e7)
    within = ((y - y.mean(axis=1, keepdims=True)) ** 2).sum()
    between = k * ((y.mean(axis=1) - y.mean()) ** 2).sum()
    grid = np.linspace(-14.0, 6.0, 1001)
    log_w, log_b = np.meshgrid(grid, grid, indexing="ij")
    of_mean = np.exp(log_w) + k * np.exp(log_b)
    log = -0.5 * (n * (k - 1) * log_w + within * np.exp(-log_w))
    log += -0.5 * ((n - 1) * np.log(of_mean) + between / of_mean)
    log += log_prior(log_w) + log_prior(log_b)
    weight = np.exp(log - log.max())
    x = drawn(part, np.array([0.0, -1.0]), 800)
    for number in range(2):
        marginal = np.log(weight.sum(axis=1 - number) + 1e-300)
        assert_quantiles(x[..., number], grid, marginal, effective=500)


@pytest.mark.slow
def test_the_variance_of_student_residuals_has_their_density():
    """Outliers hardly move the common mean of the residuals, and widen the variance little."""
    rng, n, degrees = np.random.default_rng(2), 10, 1.0
    y = rng.standard_normal((n, 1)) + np.where(np.arange(n) < 3, 40.0, 0.0)[:, None]
    rows = np.stack([np.ones((n, 1)), y], axis=-1)
    part = part_of(rows, np.eye(1)[None], 1e-9, degrees)
    mean, grid = np.linspace(-80.0, 120.0, 4001)[:, None], np.linspace(-10.0, 12.0, 1001)
    log = log_prior(grid) - 0.5 * n * grid
    for value in y.ravel():
        log = log - 0.5 * (degrees + 1) * np.log1p((value + mean) ** 2 / np.exp(grid) / degrees)
    marginal = np.log(np.exp(log - log.max()).sum(axis=0) + 1e-300)
    x = drawn(part, np.array([2.0]), 800)
    assert_quantiles(x[..., 0], grid, marginal, effective=500)


@pytest.mark.slow
def test_variances_of_session_effects_have_the_density_of_few_sessions():
    """Three sessions of known noise: each axis has a density of its own."""
    n, sessions, known = 12, 3, 0.3
    rng, std = np.random.default_rng(4), np.array([0.0, 0.5, 3.0])
    member = np.eye(sessions)[np.arange(n) % sessions]
    effect = member @ rng.standard_normal((sessions, 3)) * std
    y = effect + np.sqrt(known) * rng.standard_normal((n, 3))
    numbers = np.array([[-1, -1, -1], [-1, -1, -1], [1, 2, 3]])
    shared = SharedEffects(
        segments=jnp.arange(n),
        effect=jnp.tile(jnp.eye(3), (n, 1, 1)),
        near=jnp.zeros((3, n, 1)),
        session=jnp.asarray(member),
        numbers=jnp.asarray(numbers),
    )
    part = part_of(y[..., None], 1e-9 * np.eye(3)[None], known, 1e7, (shared,), typical=np.zeros(4))
    x, grid = drawn(part, np.zeros(4), 800), np.linspace(-14.0, 12.0, 2001)
    mean = np.array([y[np.arange(n) % sessions == s].mean(axis=0) for s in range(sessions)])
    for axis in range(3):
        spread = np.exp(grid) + known / (n / sessions)
        log = -0.5 * (sessions * np.log(spread) + (mean[:, axis] ** 2).sum() / spread)
        assert_quantiles(x[..., 1 + axis], grid, log + log_prior(grid), effective=800)


def test_the_restricted_likelihood_is_that_of_the_covariance_of_all_residuals(problem, fitted):
    """Information of parameters, and of residuals, with shared effects marginalised."""
    part, _ = linear_parts(problem, fitted)
    rng, rows = np.random.default_rng(0), part.rows["motion"]
    n, m, columns = rows.shape
    weight = rng.uniform(0.3, 2.0, n)
    for spread in (0.0, 1.0):
        log_v = part.typical + spread * rng.standard_normal(len(part.typical))
        scale = np.asarray(problem.covariance("motion", log_v)) / weight[:, None, None]
        whole = dense.of_shared(problem, log_v)
        for k, v in enumerate(scale):
            whole[k * m : (k + 1) * m, k * m : (k + 1) * m] += v
        flat = rows.reshape(n * m, columns)
        expected = flat.T @ np.linalg.solve(whole, flat)
        found, log_det = np.zeros((columns, columns)), np.linalg.slogdet(scale)[1].sum()
        for floor in floor_runs(part):
            own = floor_information(floor, part.rows, {"motion": np.linalg.inv(scale)}, log_v)
            at = np.append(floor.columns, -1)
            found[np.ix_(at, at)] += own.rows
            log_det += 2 * np.log(np.diag(own.factor)).sum()
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
        assert log_det == pytest.approx(np.linalg.slogdet(whole)[1], rel=1e-6)


@pytest.mark.slow
def test_the_std_of_load_biases_is_drawn_from_its_likelihood():
    """Load biases that are measured directly, with a half-normal prior of their common std."""
    measured, fitted = np.array([0.06, -0.09, 0.12, -0.05]), np.array([0.03, -0.1, 0.2, 0.0])
    known, now, typical = 0.02, 0.07, 0.05
    rows = np.concatenate([np.eye(4)[:, None], (fitted - measured)[:, None, None]], axis=-1)
    part = replace(
        part_of(rows, np.ones((1, 1, 1)), known**2, degrees=1e7, typical=np.array([-60.0, 0.0])),
        precision=np.zeros((4, 4)),
        pooled=PooledPrior(1, np.arange(4), -fitted, typical),
    )
    assert part.numbers.tolist() == [0, 1]
    start = np.array([-60.0, 2 * np.log(now)])
    found = drawn(part, start, 500)[..., 1]
    grid = np.linspace(*np.array(POOLED_RANGE) * typical, 4000)
    spread = np.sqrt(grid[:, None] ** 2 + known**2)
    log = norm.logpdf(grid / typical) + norm.logpdf(measured, 0.0, spread).sum(axis=1)
    assert_quantiles(np.exp(0.5 * found), grid, log, effective=1500)
    weight = np.exp(log - log.max())
    shrunk = weight @ (1 / (1 + (known / grid) ** 2)) / weight.sum() * measured
    states = islice(sweeps(part, start, 4, 10, np.random.default_rng(1)), 10, 510)
    change = np.mean([at.change for at in states], axis=(0, 1))
    np.testing.assert_allclose(fitted + change, shrunk, atol=4 * known / np.sqrt(2000))


def dense_estimate(problem, part, weight, z, log_v):
    """Estimate of the change of the search vector and its covariance, from dense matrices."""
    rows = part.rows["motion"]
    n, m, columns = rows.shape
    whole = dense.of_shared(problem, log_v)
    scale = np.asarray(problem.covariance("motion", log_v)) / weight[:, None, None]
    for k, v in enumerate(scale):
        whole[k * m : (k + 1) * m, k * m : (k + 1) * m] += v
    flat = rows.reshape(n * m, columns)
    information = flat.T @ np.linalg.solve(whole, flat)
    space = problem.space
    std = np.where(space.pooled, np.exp(0.5 * log_v[problem.objective.pooled]), space.prior_std)
    electric = problem.electric(z, problem.objective.typical)
    slope = log_jacobian(problem.objective, z, electric, np.ones(n))[1]
    pull = (space.prior_mean - z) / std**2 + np.asarray(slope) - information[:-1, -1]
    covariance = np.linalg.inv(np.diag(std**-2.0) + information[:-1, :-1])
    return covariance @ pull, covariance


def test_uncertain_variances_add_to_the_covariance_of_the_motion(problem, fitted):
    """Two sizes of the noise that are equally likely, against dense matrices."""
    part = linear_parts(problem, fitted)[0]
    larger = fitted.log_variance + np.log(4.0)
    draws = np.stack([np.tile(fitted.log_variance, (200, 1)), np.tile(larger, (200, 1))])
    residual, _ = problem.linear(fitted.z, problem.electric(fitted.z, fitted.log_variance))
    effect = effects_at(problem, residual, fitted.log_variance)
    weighed = problem.weighed(residual, fitted.log_variance, problem.full_weight, effect)
    count = residual["motion"].shape[1]
    weight = np.asarray(weighed.whitening.weight["motion"])
    weight = weight * (DEGREES + count) / (DEGREES + count + 2)  # information of a Student t
    motion = ~problem.space.electric
    (first, before), (second, wide) = (
        dense_estimate(problem, part, weight, fitted.z, v) for v in (fitted.log_variance, larger)
    )
    between = np.outer(second - first, second - first) / 4 * 120 / 119  # of 120 draws
    expected = (0.5 * (wide - before) + between)[np.ix_(motion, motion)]
    assert np.linalg.eigvalsh(expected).min() > 0
    found = added_covariance(problem, fitted, draws)
    np.testing.assert_allclose(
        found[np.ix_(motion, motion)], expected, rtol=1e-5, atol=1e-8 * expected.max()
    )
    np.testing.assert_allclose(
        found[np.ix_(~motion, ~motion)],
        electric_excess(problem, fitted, larger),
        rtol=1e-5,
        atol=1e-12,
    )
    # electric parameters are drawn given the motion
    assert not found[np.ix_(motion, ~motion)].any()
    assert np.abs(added_covariance(problem, fitted, draws[:1])).max() < 1e-9 * before.max()


def electric_excess(problem, fitted, larger):
    """Covariance that two sizes of the noise add to that of electric parameters."""
    part, e = linear_parts(problem, fitted)[1], problem.space.electric
    weight = weights_at(problem, fitted)
    found = []
    for log_v in (fitted.log_variance, larger):
        information, pull = part.precision.copy(), part.pull.copy()
        for k, rows in part.rows_at(log_v).items():
            wide = np.asarray(problem.covariance(k, log_v)) / weight[k][:, None, None]
            white = np.linalg.solve(wide, rows)
            product = np.einsum("nmc,nmd->cd", rows, white)
            information += product[:-1, :-1]
            pull -= product[:-1, -1]
        covariance = np.linalg.inv(information[np.ix_(e, e)])
        found.append((covariance @ pull[e], covariance))
    (first, before), (second, wide) = found
    return 0.5 * (wide - before) + np.outer(second - first, second - first) / 4 * 120 / 119


def test_the_likelihood_of_a_segment_is_a_student_density_and_has_its_slope(problem, fitted):
    for part in linear_parts(problem, fitted):
        noises = {k: SegmentNoise.of(noise, part.degrees) for k, noise in part.noises.items()}
        rng = np.random.default_rng(3)
        log_v = part.typical + 0.5 * rng.standard_normal((2, len(part.typical)))
        residual = {k: np.stack([r[..., -1], 0.5 * r[..., -1]]) for k, r in part.rows.items()}
        more = None
        if part.voltages is not None:
            more = np.stack([np.asarray(part.voltages.more)[..., -1]] * 2)
        density = target(part, noises, Residuals(residual, more))
        step = 1e-5
        for k in part.numbers:
            moved = step * (np.arange(log_v.shape[1]) == k)
            rise = density.log_density(log_v + moved) - density.log_density(log_v - moved)
            np.testing.assert_allclose(
                rise / (2 * step), density.slope(log_v)[:, k], rtol=1e-4, atol=1e-5
            )
        for k, noise in noises.items():
            by_scipy = [
                sum(
                    multivariate_t.logpdf(x, shape=v, df=part.degrees)
                    for x, v in zip(r, np.asarray(problem.covariance(k, one)), strict=True)
                )
                for r, one in zip(residual[k], log_v, strict=True)
            ]
            found = noise.log_likelihood(residual[k], log_v)
            assert np.diff(found) == pytest.approx(np.diff(by_scipy), rel=1e-9)


def test_voltages_depend_on_the_variances_as_in_the_fit(problem, fitted):
    """Rows for any variances come from the two extreme shares of the measured current."""
    _, part = linear_parts(problem, fitted)
    log_v = part.typical + np.random.default_rng(1).standard_normal(len(part.typical))
    electric = replace(problem.electric(fitted.z, log_v), resistance=problem.robot.motor.resistance)
    residual, jacobian = problem.linear(fitted.z, electric)
    rows = part.rows_at(log_v)
    for k in ("current", "voltage"):
        np.testing.assert_allclose(rows[k][..., -1], residual[k], rtol=1e-6, atol=1e-9)
        scale = np.abs(jacobian[k]).max()
        np.testing.assert_allclose(rows[k][..., :-1], jacobian[k], atol=1e-6 * scale)


def test_draws_are_reproducible_and_differ_between_ensembles_and_seeds(
    problem, fitted, monkeypatch
):
    for number in ("_LEAST_SWEEPS", "_STATES"):
        monkeypatch.setattr(f"slipid.infer.posterior.variance_draws.{number}", 10)
    one, again, other = (drawn_variances(problem, fitted, (2, 10), seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, again)
    assert (one[0] != one[1]).any(axis=0).all()
    assert (one != other).any(axis=(0, 1)).all()


def test_draws_stop_when_they_are_not_wanted(problem, fitted):
    stop = threading.Event()
    stop.set()
    with pytest.raises(CancelledError):
        drawn_variances(problem, fitted, (2, 10), 0, stop=stop)
