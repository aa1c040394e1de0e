"""The density the sampler sees against the likelihood the fit maximises."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_t, norm

from slipid.identify.fit import likelihood as lk
from slipid.identify.fit import noise as of_noise
from slipid.identify.fit.problem import Problem
from slipid.identify.fit.sessions import AXES
from slipid.identify.fit.variances import DEGREES, VARIANCE_SPREAD
from slipid.identify.posterior.coordinates import ELECTRIC, EVERYTHING, MOTION, Fitted
from slipid.identify.posterior.density import Density
from slipid.search_space import Choice
from tests.helpers.made_windows import made, residuals, robot

pytestmark = pytest.mark.slow  # compiles densities

NOISE = {
    "camera.place": 0.0005,
    "process.along": 0.004,
    "process.across": 0.004,
    "process.yaw": 0.008,
    "run.along": 0.008,
    "run.across": 0.008,
    "run.yaw": 0.03,
    "current": 0.05,
    "voltage": 0.07,
}
FREE = [
    Choice("*", free=False),
    Choice("surface.*.creep", free=True),
    Choice("surface.*.roller_drag", free=True),
    Choice("surface.*.friction", free=True),
    Choice("robot.load_share@*", free=True),
    Choice("camera.scale", free=True),
    Choice("camera.session_yaw@*", free=True),
    Choice("motor.resistance", free=True),
]


def stated():
    truth = robot()
    w = made(truth, std=NOISE)
    w = replace(w, current_var=np.full_like(w.current_var, 1e-3))
    return Problem(w, truth, FREE)


@pytest.fixture(scope="module")
def problem():
    return stated()


def density(problem, part, session=None):
    z, log_v = problem.space.start, 2 * np.log(problem.noise.typical)
    return Density(problem, Fitted(z, log_v, 0.01 * np.eye(len(z)), session or {}), part)


def near(d, count=4, width=0.1):
    rng = np.random.default_rng(0)
    return d.centre + width * rng.normal(size=(count, d.size))


def expected(problem, z, log_v, blocks):
    """Log likelihood of every piece by scipy, straight from the definition."""
    volt = problem.electric(z, log_v)
    tree = problem.space.tree(jnp.asarray(z))
    gaps = jax.jit(residuals)(tree, problem.batch, volt)
    camera, spread = lk.log_jacobians(tree, problem.batch, volt)
    out = np.zeros(len(problem.windows))
    for k in blocks:
        v = np.asarray(problem.covariance(k, log_v))
        for n, r in enumerate(np.asarray(gaps[k])):
            out[n] += multivariate_t.logpdf(r, shape=v[n], df=DEGREES)
        out += np.asarray({"motion": camera, "voltage": spread}.get(k, 0.0))
    return out


def prior(problem, d, x):
    at, space = d.coordinates, problem.space
    typical = 2 * np.log(problem.noise.typical)
    mean = np.concatenate([space.prior_mean[at.structure], typical[at.variance]])
    wide = np.full(len(at.variance), VARIANCE_SPREAD)
    std = np.concatenate([space.prior_std[at.structure], wide])
    return norm.logpdf(x, mean, std)


@pytest.mark.parametrize("part", [MOTION, EVERYTHING])
def test_it_is_the_posterior_by_definition(problem, part):
    d = density(problem, part)
    x = near(d)
    terms = d.terms(x)
    blocks = ["motion"] if part == MOTION else ["motion", "current", "voltage"]
    for one, found in zip(x, terms, strict=True):
        z, log_v = d.full(d.anchor, jnp.asarray(one))
        pieces = expected(problem, np.asarray(z), np.asarray(log_v), blocks)
        of_prior = prior(problem, d, one)
        group, floor = d.coordinates.group, np.asarray(problem.batch.surface)
        for g in (0, 1):
            total = pieces[floor == g].sum() + of_prior[group == g].sum()
            assert found[g] == pytest.approx(total, rel=1e-9)
        assert found[-1] == pytest.approx(of_prior[group < 0].sum(), rel=1e-9)
    for k, each in d.pointwise(x).items():
        z, log_v = d.full(d.anchor, jnp.asarray(x[0]))
        np.testing.assert_allclose(
            each[0], expected(problem, np.asarray(z), np.asarray(log_v), [k]), rtol=1e-8
        )


def test_the_electric_part_holds_the_motion_of_each_walker(problem):
    """log p(electric | motion) is that of everything less that of the motion, but for constants."""
    motion, electric, all_ = (density(problem, p) for p in (MOTION, ELECTRIC, EVERYTHING))
    of_motion, x = near(motion), near(electric)
    found = electric.terms(x, motion.hold(of_motion)).sum(axis=1)
    together = np.zeros((4, all_.size))
    where = {name: k for k, name in enumerate(all_.names)}
    together[:, [where[n] for n in motion.names]] = of_motion
    together[:, [where[n] for n in electric.names]] = x
    assert sorted([*motion.names, *electric.names]) == sorted(all_.names)
    rest = all_.terms(together).sum(axis=1) - motion.terms(of_motion).sum(axis=1)
    np.testing.assert_allclose(found, rest, rtol=1e-8)


SHARED = {f"session.soft.{axis}": v for axis, v in zip(AXES, (4e-4, 1e-4, 9e-4), strict=True)}


def test_runs_of_a_session_share_effects_with_the_priors_that_were_found(problem):
    """Residuals less E a, a = std e; e standard normal beforehand; the other floor is untouched."""
    plain, d = density(problem, MOTION), density(problem, MOTION, SHARED)
    assert d.names[: plain.size] == plain.names
    assert d.names[plain.size] == "session.soft.along@one"
    assert d.size == plain.size + 6
    assert (d.coordinates.group[plain.size :] == d.floors.index("soft")).all()
    x = near(d, 2, width=0.7)
    z, log_v = d.full(d.anchor, jnp.asarray(x[0]))
    tree, noise = problem.space.tree(jnp.asarray(z)), problem.electric(z, log_v)
    residual = np.array(jax.jit(residuals)(tree, problem.batch, noise)["motion"])
    effect, w = of_noise.effects(problem.windows, problem.robot), problem.windows
    std, found = np.array([0.02, 0.01, 0.03]), np.zeros(3)
    for n, r in enumerate(residual):
        if w.surface[n] == "soft":
            first = plain.size + 3 * ("one", "two").index(w.session[n])
            r = r - effect[n] @ (std * x[0, first : first + 3])
        v = np.asarray(problem.covariance("motion", log_v))[n]
        found[problem.batch.surface[n]] += multivariate_t.logpdf(r, shape=v, df=DEGREES)
        found[problem.batch.surface[n]] += lk.log_jacobians(tree, problem.batch, noise)[0][n]
    of_prior = norm.logpdf(x[0, plain.size :]).sum()
    alone = plain.terms(x[:1, : plain.size])[0]
    soft = d.floors.index("soft")
    known = prior(problem, plain, x[0, : plain.size])
    found[soft] += of_prior
    for g in (0, 1):
        found[g] += known[plain.coordinates.group == g].sum()
    terms = d.terms(x[:1])[0]
    np.testing.assert_allclose(terms[:2], found[:2], rtol=1e-9)
    assert terms[1 - soft] == pytest.approx(alone[1 - soft], rel=1e-12)
    assert terms[-1] == pytest.approx(alone[-1], rel=1e-12)


def test_sessions_widen_the_curvature_as_the_fit_says(problem):
    """Marginal of the joint curvature: C + C (sum_s v u u^T) C where effects are told by little."""
    d, small = density(problem, MOTION), {k: 1e-6 * v for k, v in SHARED.items()}
    n = len(d.coordinates.structure)
    z, log_v = problem.space.start, 2 * np.log(problem.noise.typical)
    _, jacobian = problem.linear(z, problem.electric(z, log_v))
    precision = np.asarray(problem.precision(jacobian, jnp.asarray(log_v), np.ones(24)))
    fitted = Fitted(z, log_v, np.linalg.inv(precision), small)
    grown = Density(problem, fitted, MOTION).covariance[:n, :n]
    at = d.coordinates.structure
    laplace = fitted.covariance[np.ix_(at, at)]
    v = np.asarray(problem.covariance("motion", log_v))
    weight = (DEGREES + 6) / (DEGREES + 8)
    meat, w = np.zeros_like(laplace), problem.windows
    for name in ("one", "two"):
        u = np.zeros((3, n))
        for k in range(24):
            if (w.surface[k], w.session[k]) == ("soft", name):
                e = of_noise.effects(w, problem.robot)[k]
                u += weight * e.T @ np.linalg.solve(v[k], np.asarray(jacobian["motion"])[k][:, at])
        meat += u.T @ np.diag(list(small.values())) @ u
    more = laplace @ meat @ laplace
    assert np.abs(more).max() > 0
    np.testing.assert_allclose(grown - laplace, more, atol=2e-3 * np.abs(more).max())


def test_numbers_of_one_floor_move_its_term_only(problem):
    d = density(problem, EVERYTHING)
    x = near(d, 1)[0]
    base = d.terms(x[None])[0]
    for k, (name, group) in enumerate(zip(d.names, d.coordinates.group, strict=True)):
        moved = d.terms((x + 0.01 * np.eye(d.size)[k])[None])[0] - base
        changed = set(np.flatnonzero(np.abs(moved) > 1e-9))
        floor = next((f for f in ("firm", "soft") if f".{f}." in name), None)
        assert group == (-1 if floor is None else d.floors.index(floor)), name
        assert changed <= ({0, 1, 2} if group < 0 else {group}), name
        assert changed, name


def test_far_from_the_fit_the_root_is_found_from_scratch(problem):
    d = density(problem, MOTION)
    far = near(d, 3, width=2.0)
    for one, found in zip(far, d.terms(far).sum(axis=1), strict=True):
        z, log_v = d.full(d.anchor, jnp.asarray(one))
        total = expected(problem, np.asarray(z), np.asarray(log_v), ["motion"]).sum()
        assert found == pytest.approx(total + prior(problem, d, one).sum(), rel=1e-7)


def test_gradients_are_those_of_finite_differences(problem):
    d = density(problem, MOTION)
    [x], h = near(d, 1), 1e-5 * np.eye(d.size)
    [slope] = d.slope(x[None])
    numeric = (d.terms(x + h).sum(axis=1) - d.terms(x - h).sum(axis=1)) / 2e-5
    np.testing.assert_allclose(slope, numeric, rtol=1e-4, atol=1e-3)


def test_a_single_floor_is_a_single_group():
    truth = robot(floors=("firm",), loads=("as_built",), sessions=("one",))
    w = replace(made(truth, std=NOISE), has_current=False, has_voltage=False)
    d = density(Problem(w, truth, [FREE[0], Choice("surface.*.creep", free=True)]), EVERYTHING)
    assert (d.coordinates.group == 0).all()
    assert d.terms(near(d)).shape == (4, 2)


def test_a_density_is_forgotten_after_use():
    """Chains around fit after fit must not keep the data of all of them."""
    problem = stated()
    d = density(problem, MOTION)
    d.terms(near(d))
    kept = weakref.ref(problem), weakref.ref(d)
    del problem, d
    gc.collect()
    assert [ref() for ref in kept] == [None] * 2
