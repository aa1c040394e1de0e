"""The density of the sampler equals its definition, written out with dense covariances."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import multivariate_t

from slipid.fitting import likelihood as lk
from slipid.fitting import noise as of_noise
from slipid.fitting.noise import POOLED
from slipid.fitting.problem import Problem
from slipid.fitting.shared_effects import AXES
from slipid.fitting.variances import DEGREES
from slipid.infer.posterior.coordinates import ELECTRIC, EVERYTHING, MOTION, Fitted
from slipid.infer.posterior.density import Density
from slipid.infer.posterior.left_out import log_likelihoods
from slipid.search_space import Choice
from tests.helpers.density_slopes import slope
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
    Choice("surface.*.load_bias", free=True),
]


def stated(choices=FREE):
    truth = robot()
    w = made(truth, std=NOISE)
    w = replace(w, current_var=np.full_like(w.current_var, 1e-3))
    return Problem(w, truth, choices)


@pytest.fixture(scope="module")
def problem():
    return stated()


def fitted(problem):
    """Return fixed values of variances and weights, as a fit would."""
    z, log_v = problem.space.start, 2 * np.log(problem.noise.typical)
    return Fitted(z, log_v, 0.01 * np.eye(len(z)))


def density(problem, part):
    return Density(problem, fitted(problem), part)


def near(d, count=4, width=0.1):
    rng = np.random.default_rng(0)
    return d.centre + width * rng.normal(size=(count, d.size))


def residuals_at(problem, z):
    """Return residuals by block, and log |d residuals / d data| of segments, in plain numpy."""
    volt = problem.electric(z, fitted(problem).log_variance)
    tree = problem.space.tree(jnp.asarray(z))
    blocks = {k: np.asarray(r) for k, r in jax.jit(residuals)(tree, problem.batch, volt).items()}
    camera, spread = (np.asarray(x) for x in lk.log_jacobians(tree, problem.batch, volt))
    return blocks, {"motion": camera, "voltage": spread}


def spread_of(problem, block):
    """Return the covariance V of the residuals of a block at the fit, segment by segment."""
    return np.asarray(problem.covariance(block, fitted(problem).log_variance))


def shared_covariance(problem):
    """Return the covariance of all motion residuals from shared effects (n m, n m)."""
    w, index = problem.windows, problem.noise.names.index
    moved, v = of_noise.effects(w, problem.robot), np.exp(fitted(problem).log_variance)
    n, m, _ = moved.shape
    session = np.asarray(w.session)[:, None] == np.asarray(w.session)
    out = np.zeros((n, m, n, m))
    for floor, of in zip(problem.robot.surfaces.labels, problem.objective.shared, strict=True):
        mine, near = np.asarray(of.segments), np.asarray(of.near)
        assert [w.surface[k] for k in mine] == [floor] * len(mine)
        for k, axis in enumerate(AXES):
            like = v[index(f"neighbours.{floor}.{axis}")] * near[k] @ near[k].T
            like += v[index(f"session.{floor}.{axis}")] * session[np.ix_(mine, mine)]
            by = moved[mine, :, k]
            out[np.ix_(mine, range(m), mine, range(m))] += np.einsum("im,ij,jl->imjl", by, like, by)
    return out.reshape(n * m, n * m)


def weights(problem):
    """Return weights of segments by block: of a Student t at the fit, times its information.

    A run is an outlier for what it does not share with others, found in turn with the weights.
    """
    blocks, _ = residuals_at(problem, fitted(problem).z)
    shared, moved = shared_covariance(problem), np.zeros_like(blocks["motion"])

    def weight(block, r):
        q = np.einsum(
            "ni,ni->n", r, np.linalg.solve(spread_of(problem, block), r[..., None])[..., 0]
        )
        return (DEGREES + r.shape[1]) / (DEGREES + q)

    for _ in range(3):
        own = (
            spread_of(problem, "motion") / weight("motion", blocks["motion"] - moved)[:, None, None]
        )
        solved = np.linalg.solve(shared + block_diag(*own), blocks["motion"].ravel())
        moved = (shared @ solved).reshape(moved.shape)
    out = {k: weight(k, r - moved if k == "motion" else r) for k, r in blocks.items()}
    less = {k: (DEGREES + r.shape[1]) / (DEGREES + r.shape[1] + 2) for k, r in blocks.items()}
    return {k: w * less[k] for k, w in out.items()}


class Dense:
    """Log density of each floor by the Gaussian of all its residuals, up to constants."""

    def __init__(self, problem, blocks, alone=False):
        self.problem, self.blocks, weight = problem, blocks, weights(problem)
        self.own = {k: spread_of(problem, k) / weight[k][:, None, None] for k in blocks}
        self.shared = shared_covariance(problem) * (0.0 if alone else 1.0)

    def floors(self, z):
        surface = np.asarray(self.problem.batch.surface)
        blocks, jacobian = residuals_at(self.problem, z)
        out = np.zeros(surface.max() + 1)
        for k in self.blocks:
            m = blocks[k].shape[1]
            whole = block_diag(*self.own[k]) + (self.shared if k == "motion" else 0.0)
            for g in range(len(out)):
                rows = (surface[:, None] == g).repeat(m, axis=1).ravel()
                r = blocks[k].ravel()[rows]
                out[g] -= 0.5 * r @ np.linalg.solve(whole[np.ix_(rows, rows)], r)
                more = jacobian.get(k, np.zeros(len(surface)))[surface == g].sum()
                out[g] += more * (DEGREES + m) / (DEGREES + m + 2)
        return out

    def effects(self, z):
        """Return the conditional mean of shared effects in the motion residuals (segment, m)."""
        residual = residuals_at(self.problem, z)[0]["motion"]
        solved = np.linalg.solve(self.shared + block_diag(*self.own["motion"]), residual.ravel())
        return (self.shared @ solved).reshape(residual.shape)


def prior(problem, d, x):
    """Return the log prior of every coordinate, up to constants."""
    at, space = d.structure, problem.space
    found = np.exp(0.5 * fitted(problem).log_variance[problem.noise.names.index(POOLED)])
    std = np.where(["load_bias" in name for name in space.names], found, space.prior_std)
    return -0.5 * ((x - space.prior_mean[at]) / std[at]) ** 2


def terms_of(problem, d, dense, x):
    """Return the terms of the log density of one vector, by definition."""
    z = np.asarray(d.full(d.anchor, jnp.asarray(x)))
    of_prior, group = prior(problem, d, x), d.group
    own = [of_prior[group == g].sum() for g in (0, 1)]
    return np.append(dense.floors(z) + own, of_prior[group < 0].sum())


BLOCKS = {MOTION: ["motion"], EVERYTHING: ["motion", "current", "voltage"]}


@pytest.mark.parametrize("part", [MOTION, EVERYTHING])
def test_terms_equal_the_posterior_by_definition(problem, part):
    """The Gaussian of all runs on a floor includes their shared effects."""
    d, dense = density(problem, part), Dense(problem, BLOCKS[part])
    x = near(d)
    found = d.terms(x)
    expected = np.array([terms_of(problem, d, dense, one) for one in x])
    np.testing.assert_allclose(found - found[0], expected - expected[0], rtol=1e-8, atol=1e-7)
    alone = Dense(problem, BLOCKS[part], alone=True)
    other = np.array([terms_of(problem, d, alone, one) for one in x])
    assert (np.abs((other - other[0]) - (found - found[0]))[1:, :2] > 0.1).all()


def test_many_elements_have_the_residuals_of_few(problem):
    """They are evaluated in chunks, the last of which has other elements than its own."""
    d = density(problem, EVERYTHING)
    few = near(d)
    many = np.concatenate([few] * (70 // len(few) + 1))[:69]
    of_few, found = (d.mapped(Density.residual_blocks, x, None) for x in (few, many))
    for k, r in found.items():
        assert len(r) == len(many)
        np.testing.assert_allclose(r, of_few[k][np.arange(69) % len(few)], rtol=1e-9, atol=1e-12)


def test_rows_of_a_batch_that_is_not_full_are_those_of_single_vectors(problem):
    d = density(problem, MOTION)
    x = np.concatenate([near(d)] * 6)[:23]
    x += 1e-3 * np.arange(23)[:, None]  # no two are equal
    alone = np.concatenate([d.terms(x[k : k + 1]) for k in (0, 19, 20, 22)])
    np.testing.assert_allclose(d.terms(x)[[0, 19, 20, 22]], alone, rtol=1e-9)
    first = d.mapped(Density.whitened, x, None, first=3).rows
    assert first[:3].any(axis=1).all()
    assert not first[3:].any()


def test_residuals_are_less_shared_effects(problem):
    d, dense = density(problem, EVERYTHING), Dense(problem, BLOCKS[EVERYTHING])
    x = near(d)
    found = d.mapped(Density.residual_blocks, x, None)
    assert found.keys() == set(BLOCKS[EVERYTHING])
    for j, one in enumerate(x):
        z = np.asarray(d.full(d.anchor, jnp.asarray(one)))
        blocks, _ = residuals_at(problem, z)
        moved = dense.effects(z)
        assert np.abs(moved).max() > 0.001
        blocks["motion"] = blocks["motion"] - moved
        for k, r in blocks.items():
            np.testing.assert_allclose(found[k][j], r, rtol=1e-8, atol=1e-10)


def left_out_by_definition(dense, r, v, k, out):
    """Return the log density of segment k without the segments `out`, by dense matrices."""
    n, m = r.shape
    whole = (dense.shared + block_diag(*dense.own["motion"])).reshape(n, m, n, m)
    shared, rest = dense.shared.reshape(n, m, n, m), np.setdiff1d(np.arange(n), out)
    others = whole[np.ix_(rest, range(m), rest, range(m))].reshape(len(rest) * m, -1)
    across = shared[k][:, rest].reshape(m, -1)
    mean = across @ np.linalg.solve(others, r[rest].ravel())
    scale = v[k] + shared[k, :, k] - across @ np.linalg.solve(others, across.T)
    return multivariate_t.logpdf(r[k], mean, scale, DEGREES)


@pytest.mark.parametrize("segments", [1, 3])
def test_log_likelihoods_are_those_of_runs_left_out(problem, segments):
    """Runs of three segments are predicted segment by segment."""
    d, dense = density(problem, EVERYTHING), Dense(problem, BLOCKS[EVERYTHING])
    surface, run = np.asarray(problem.batch.surface), np.zeros(len(problem.windows), int)
    for g in np.unique(surface):
        run[surface == g] = 100 * g + np.arange((surface == g).sum()) // segments
    x = near(d)
    found = log_likelihoods(d, x[None], run)
    assert found.keys() == set(BLOCKS[EVERYTHING])
    for j, one in enumerate(x):
        blocks, jacobian = residuals_at(problem, np.asarray(d.full(d.anchor, jnp.asarray(one))))
        for k, r in blocks.items():
            v = spread_of(problem, k)
            each = [
                multivariate_t.logpdf(a, shape=b, df=DEGREES) for a, b in zip(r, v, strict=True)
            ]
            if k == "motion":
                out = [
                    np.flatnonzero((run == n) & (np.arange(len(run)) >= i))
                    for i, n in enumerate(run)
                ]
                each = [left_out_by_definition(dense, r, v, i, o) for i, o in enumerate(out)]
            expected = np.array(each) + jacobian.get(k, 0.0)
            np.testing.assert_allclose(found[k][0, j], expected, rtol=1e-7)


def test_the_electric_part_holds_the_motion_of_each_walker(problem):
    """log p(electric | motion) is that of everything less that of the motion, up to constants."""
    motion, electric, all_ = (density(problem, p) for p in (MOTION, ELECTRIC, EVERYTHING))
    of_motion, x = near(motion), near(electric)
    found = electric.mapped(Density.log_prob, x, motion.hold(of_motion))
    together = np.zeros((4, all_.size))
    where = {name: k for k, name in enumerate(all_.names)}
    together[:, [where[n] for n in motion.names]] = of_motion
    together[:, [where[n] for n in electric.names]] = x
    assert sorted([*motion.names, *electric.names]) == sorted(all_.names)
    rest = all_.terms(together).sum(axis=1) - motion.terms(of_motion).sum(axis=1)
    np.testing.assert_allclose(np.asarray(found), rest, rtol=1e-8)


def test_its_curvature_is_the_information_of_the_fit():
    """At zero residuals runs weigh (nu + m) / nu, and the curvature of the model has no effect."""
    truth = robot()
    w = replace(made(truth), has_current=False, has_voltage=False)
    # the camera's scale is logarithmic, so that it does not bend the Jacobian
    problem = Problem(w, truth, FREE)
    z, log_v = problem.space.vector(truth), 2 * np.log(problem.noise.typical)
    keep = np.full(len(w), (DEGREES + 6) / DEGREES)
    _, jacobian = problem.linear(z, problem.electric(z, log_v))
    precision = np.asarray(problem.precision(jacobian, jnp.asarray(log_v), keep))
    d = Density(problem, Fitted(z, log_v, np.linalg.inv(precision)), EVERYTHING)
    h = 1e-2 * np.sqrt(np.diag(d.covariance)) * np.eye(d.size)
    bend = -(slope(d, z + h) - slope(d, z - h)) / (2 * np.diag(h)[:, None])
    scale = np.sqrt(np.diag(precision))
    np.testing.assert_allclose(
        bend / scale / scale[:, None], precision / scale / scale[:, None], atol=1e-3
    )
    alone = np.asarray(
        problem.without_shared_effects().precision(jacobian, jnp.asarray(log_v), keep)
    )
    assert (np.diag(alone) / np.diag(precision)).max() > 1.2


def test_numbers_of_one_floor_change_its_term_only(problem):
    d = density(problem, EVERYTHING)
    x = near(d, 1)[0]
    base = d.terms(x[None])[0]
    for k, (name, group) in enumerate(zip(d.names, d.group, strict=True)):
        moved = d.terms((x + 0.01 * np.eye(d.size)[k])[None])[0] - base
        changed = set(np.flatnonzero(np.abs(moved) > 1e-9))
        floor = next((f for f in ("firm", "soft") if f".{f}." in name), None)
        assert group == (-1 if floor is None else d.floors.index(floor)), name
        assert changed <= ({0, 1, 2} if group < 0 else {group}), name
        assert changed, name


def test_far_from_the_fit_twists_are_solved_anew(problem):
    d, dense = density(problem, MOTION), Dense(problem, BLOCKS[MOTION])
    far = near(d, 3, width=2.0)
    for one, found in zip(far, d.terms(far), strict=True):
        np.testing.assert_allclose(found, terms_of(problem, d, dense, one), rtol=1e-7)


def test_gradients_are_those_of_finite_differences(problem):
    d = density(problem, MOTION)
    [x], h = near(d, 1), 1e-5 * np.eye(d.size)
    [found] = slope(d, x[None])
    numeric = (d.terms(x + h).sum(axis=1) - d.terms(x - h).sum(axis=1)) / 2e-5
    np.testing.assert_allclose(found, numeric, rtol=1e-4, atol=1e-3)


def test_the_surrogate_of_a_floor_has_the_quotient_of_its_rollers_drag_and_creep():
    """Floors of which both are fitted, and no other floor."""
    choices = [Choice("*", free=False), Choice("surface.*.roller_drag", free=True)]
    choices += [Choice("surface.soft.roller_creep", free=True)]
    target = density(stated(choices), MOTION).target()
    pairs = [tuple(target.names[k] for k in pair) for pair in target.quotients]
    assert pairs == [("surface.soft.roller_drag", "surface.soft.roller_creep")]
    for floor in range(target.groups):
        at, less = target.inputs(floor)
        assert (less >= 0).sum() == (target.depends[floor, target.quotients[0][1]])
        assert set(at[less < 0]) == set(np.flatnonzero(target.depends[floor]))


def test_a_single_floor_is_a_single_group():
    truth = robot(floors=("firm",), loads=("as_built",), sessions=("one",))
    w = replace(made(truth, std=NOISE), has_current=False, has_voltage=False)
    d = density(Problem(w, truth, [FREE[0], Choice("surface.*.creep", free=True)]), EVERYTHING)
    assert (d.group == 0).all()
    assert d.terms(near(d)).shape == (4, 2)


def test_a_density_is_forgotten_after_use():
    """Chains around one fit after another must not keep the data of all of them."""
    problem = stated()
    d = density(problem, MOTION)
    d.terms(near(d))
    d.mapped(Density.residual_blocks, np.concatenate([near(d)] * 16), None)  # in chunks
    kept = weakref.ref(problem), weakref.ref(d)
    del problem, d
    gc.collect()
    assert [ref() for ref in kept] == [None] * 2
