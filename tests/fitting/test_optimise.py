"""The fit: exact where least squares is, robust, resumable, the same for folds and subsets."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag

from slipid.fitting import problem as of_problem
from slipid.fitting import variances
from slipid.fitting.optimise import (
    LinearisedResiduals,
    _floors_fitted,
    _stacked,
    levenberg,
    optimise,
    start_rounds,
)
from slipid.fitting.problem import FitState, Problem, Twists, effects_given, without_effects
from slipid.fitting.variances import DEGREES
from slipid.search_space import Choice
from tests.helpers.dense import of_shared
from tests.helpers.made_windows import made, robot

pytestmark = pytest.mark.slow  # compiles three fits

NOISE = {
    "camera.place": 0.0005,
    "camera.heading": 0.003,
    "process.along": 0.004,
    "process.across": 0.004,
    "process.yaw": 0.008,
    "run.along": 0.008,
    "run.across": 0.008,
    "run.yaw": 0.03,
    "current.window": 0.05,
    "voltage.window": 0.07,
}
NOTHING = Choice("*", free=False)
PRECISE = {"most_rounds": 150, "tolerance": 1e-4}
SURFACE = [
    NOTHING,
    Choice("surface.*.creep", free=True),
    Choice("surface.*.roller_drag", free=True),
    Choice("robot.load_share@*", free=True),
    Choice("camera.marker_yaw", free=True),
    Choice("camera.session_yaw@*", fixed=0.0),
    Choice("robot.wheel_radius", prior_mean=0.04, prior_std=0.004),
]

LEVEL = ("camera.scale", "camera.radial", "motor.resistance", "motor.back_emf")
"""Numbers of a problem of which a test lets some move, so that one compiled fit serves all."""


def held_but(problem, truth, *paths):
    """Start at the truth but for these numbers, and the mask that lets them alone move."""
    mask = problem.space.where(lambda e: e.path in paths)
    return begin(problem, np.where(mask, problem.space.start, problem.space.vector(truth))), mask


def moves(best):
    """Std of every number where the others are held."""
    return 1 / np.sqrt(np.diag(np.linalg.inv(best.covariance)))


def begin(problem, z=None):
    """State to start from without the staged start."""
    return FitState(
        z=problem.space.start if z is None else z,
        log_variance=2 * np.log(problem.noise.typical),
        round=0,
        loss=np.inf,
        moved=np.inf,
        stage="joint",
    )


def value(problem, state, path):
    entry = next(e for e in problem.space.all if e.path == path)
    return np.asarray(entry.get(problem.space.tree(jnp.asarray(state.z))))


@pytest.fixture(scope="module")
def truth():
    return robot(sessions=("one",))


@pytest.fixture(scope="module")
def surface_problem(truth):
    w = replace(made(truth, runs=48, std=NOISE), has_current=False, has_voltage=False)
    return Problem(w, truth, SURFACE)


@pytest.fixture(scope="module")
def surface_fit(surface_problem):
    told = []
    best = optimise(surface_problem, start=begin(surface_problem), **PRECISE, tell=told.append)
    return best, told


def test_a_fit_on_a_gpu_has_the_numbers_of_one_on_a_cpu(truth, surface_problem, surface_fit):
    try:
        gpu = jax.devices("gpu")[0]
    except RuntimeError:
        pytest.skip("JAX sees no GPU")
    with jax.default_device(gpu):
        problem = Problem(surface_problem.windows, truth, SURFACE)
        again = optimise(problem, start=begin(problem), **PRECISE)
    std = np.sqrt(np.diag(surface_fit[0].covariance))
    assert np.abs((again.state.z - surface_fit[0].state.z) / std).max() < 1e-3


@pytest.mark.parametrize("path", LEVEL[:3])
def test_a_fit_ends_where_the_loss_is_level(truth, path):
    """Also in numbers that transform the data: shrinking them must not count as fitting them."""
    w = made(truth, runs=48, std={**NOISE, "run.along": 0.05, "process.along": 0.02})
    w = replace(w, current_var=np.full_like(w.current_var, 0.02))
    problem = Problem(w, truth, [NOTHING, *(Choice(p, free=True) for p in LEVEL)])
    start, mask = held_but(problem, truth, path)
    best = optimise(problem, start=start, **PRECISE, free=mask)
    assert best.converged
    log_v, keep = jnp.asarray(best.state.log_variance), jnp.ones(len(w))
    volt, [std] = problem.electric(best.state.z, log_v), moves(best)[mask]
    std = std * mask

    def loss(z):
        blocks, _ = problem.linear(jnp.asarray(z), volt)
        effect = best.state.effect
        for _ in range(8):  # what runs share follows the numbers
            seen = problem.weighed(blocks, best.state.log_variance, keep, effect)
            effect = effects_given(seen.effects, seen.whitening.root["motion"], blocks["motion"])
        return problem.loss(z, best.state.log_variance, keep, seen, volt)

    z = best.state.z
    rise = [loss(z + k * std) - loss(z) for k in (-1.0, 1.0)]
    assert min(rise) > 0.2  # half a unit each, less what the tails of the t take
    assert abs(loss(z + 0.1 * std) - loss(z - 0.1 * std)) < 0.2 * 0.02


def test_a_voltage_without_noise_of_its_own_leaves_the_motor_alone(truth):
    """The ammeter claims a variance that explains every gap of the voltage."""
    w = made(truth, runs=48, std={**NOISE, "voltage.window": 0.002})
    w = replace(w, current_var=np.full_like(w.current_var, 2e-5))
    numbers = ("resistance", "back_emf")
    problem = Problem(w, truth, [NOTHING, *(Choice(p, free=True) for p in LEVEL)])
    start, mask = held_but(problem, truth, *(f"motor.{name}" for name in numbers))
    best = optimise(problem, start=start, most_rounds=40, free=mask)
    assert best.converged
    found = problem.space.tree(best.state.z).motor
    for name in numbers:
        assert float(getattr(found, name)) == pytest.approx(
            float(getattr(truth.motor, name)), rel=0.01
        )


# exact cases


def test_resistance_and_brush_drop_are_those_of_linear_regression(truth, gaussian):
    """U - C_e wm = R I + U_b tanh(I / 0.05) is linear in both; Gaussian, flat priors."""
    w = replace(made(truth, std=NOISE), current_var=np.zeros((24, 2, 3)))
    choices = [
        NOTHING,
        Choice("motor.resistance", prior_mean=4.0, prior_std=200.0),
        Choice("motor.brush_drop", prior_mean=0.0, prior_std=50.0),
    ]
    problem = Problem(w, truth, choices)
    best = optimise(problem, start=begin(problem), **PRECISE)
    speed = (w.turn / w.dt[..., None]).ravel()
    amps = w.current.ravel()
    x = np.stack([amps, np.tanh(amps / 0.05)], axis=1)
    y = w.voltage.ravel() - 0.05 * 16 * speed
    beta, rss = np.linalg.lstsq(x, y, rcond=None)[:2]
    assert best.converged, best.reason
    got = [value(problem, best.state, f"motor.{n}") for n in ("resistance", "brush_drop")]
    np.testing.assert_allclose(got, beta, rtol=1e-5)
    # and with it the error bars: s^2 = RSS / (N - 2), s^2 (X^T X)^-1
    variance = rss[0] / (len(y) - 2)
    std = np.exp(0.5 * best.state.log_variance[-1])
    assert std**2 + 1e-6 == pytest.approx(variance, rel=0.01)
    expected = variance * np.linalg.inv(x.T @ x)
    slope = np.diag([1 / beta[0], 1.0])  # of the logarithm R is searched in
    order = [problem.space.names.index(f"motor.{n}") for n in ("resistance", "brush_drop")]
    np.testing.assert_allclose(
        best.covariance[np.ix_(order, order)], slope @ expected @ slope, rtol=0.02
    )


def test_camera_scale_is_that_of_weighted_least_squares(truth):
    """The residual is linear in the scale s: a s^2 - b s - n = 0 at the optimum, weights given.

    n is the number of measured lengths: the density of the logged ones is s^n times the residuals'.
    """
    w = replace(made(truth, std=NOISE), has_current=False, has_voltage=False)
    choices = [NOTHING, Choice("camera.scale", prior_mean=1.1, prior_std=10.0)]
    problem = Problem(w, truth, choices)
    best = optimise(problem, start=begin(problem, problem.space.start + 0.1), **PRECISE)
    assert best.converged, best.reason
    electric = problem.electric(best.state.z, best.state.log_variance)
    r = np.asarray(problem.linear(best.state.z, electric)[0]["motion"])
    scale = float(value(problem, best.state, "camera.scale"))
    raw = np.zeros((24, 2, 3))  # increments per unit of scale; yaw does not depend on it
    for k in range(2):
        d = w.pose[:, k + 1] - w.pose[:, k]
        c, s = np.cos(w.pose[:, k, 2]), np.sin(w.pose[:, k, 2])
        raw[:, k, 0], raw[:, k, 1] = c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]
    x = raw.reshape(24, 6)
    y = r + scale * x  # what the robot predicts
    log_v = best.state.log_variance
    v = np.asarray(problem.covariance("motion", log_v))
    own = np.asarray(without_effects(problem.objective, {"motion": r}, best.state.effect)["motion"])
    q = np.einsum("ni,nij,nj->n", own, np.linalg.inv(v), own)
    scaled = v * ((DEGREES + q) / (DEGREES + 6))[:, None, None]
    both = np.linalg.inv(block_diag(*scaled) + of_shared(problem, log_v))
    a, b = (x.ravel() @ both @ other.ravel() for other in (x, y))
    exact = (b + np.sqrt(b**2 + 4 * a * 96)) / (2 * a)
    assert scale == pytest.approx(exact, rel=1e-6)
    assert scale == pytest.approx(1.1, abs=4 * np.sqrt(best.covariance[0, 0]) * 1.1)


# behaviour


def test_the_fit_recovers_what_it_says_it_knows(surface_problem, surface_fit):
    best, _ = surface_fit
    assert best.converged, best.reason
    true = surface_problem.space.vector(robot(sessions=("one",)))
    z = (best.state.z - true) / np.sqrt(np.diag(best.covariance))
    # the camera's yaw of the session was fixed at zero, so the common one carries it
    at = surface_problem.space.names.index("camera.marker_yaw")
    true[at] += float(np.asarray(robot(sessions=("one",)).camera.session_yaw)[0])
    z = (best.state.z - true) / np.sqrt(np.diag(best.covariance))
    assert np.abs(z).max() < 3.5, dict(zip(surface_problem.space.names, z, strict=True))
    assert (np.linalg.eigvalsh(best.covariance) > 0).all()


def test_the_optimum_is_one(surface_problem, surface_fit):
    """At the variances found no step in the structure lowers the loss."""
    best, _ = surface_fit
    log_v = best.state.log_variance
    volt = surface_problem.electric(best.state.z, log_v)

    def loss(z):
        blocks = surface_problem.linear(z, volt)[0]
        seen = surface_problem.weighed(blocks, log_v, np.ones(48), best.state.effect)
        return surface_problem.loss(z, log_v, np.ones(48), seen, volt)

    lowest = loss(best.state.z)
    std = np.sqrt(np.diag(best.covariance))
    for k in range(len(std)):
        for step in (-0.3, 0.3):
            z = best.state.z.copy()
            z[k] += step * std[k]
            assert loss(z) > lowest


def test_every_round_is_told_and_ends_in_the_result(surface_fit):
    best, told = surface_fit
    assert [s.round for s in told] == list(range(1, len(told) + 1))
    assert told[-1] is best.state
    assert tuple(s.loss for s in told) == best.history
    assert best.state.moved < PRECISE["tolerance"]
    assert "no parameter changed" in best.reason


def test_going_on_from_a_state_is_the_same_as_not_having_stopped(surface_problem, surface_fit):
    best, told = surface_fit
    again = optimise(surface_problem, start=told[1], **PRECISE)
    np.testing.assert_array_equal(again.state.z, best.state.z)
    assert again.state.round == best.state.round


def test_too_few_rounds_are_said(surface_problem):
    short = optimise(surface_problem, start=begin(surface_problem), most_rounds=1)
    assert not short.converged
    assert short.reason == "1 rounds without convergence"


def test_left_out_runs_are_as_good_as_absent(truth, surface_problem):
    keep = np.ones(48)
    keep[::4] = 0.0
    part = surface_problem.windows.segments(np.flatnonzero(keep))
    masked = optimise(surface_problem, keep=keep, start=begin(surface_problem), **PRECISE)
    alone = surface_problem.of(part)
    subset = optimise(alone, start=begin(alone), **PRECISE)
    np.testing.assert_allclose(masked.state.z, subset.state.z, atol=1e-4)
    np.testing.assert_allclose(masked.covariance, subset.covariance, rtol=0.01, atol=1e-9)


def test_no_bit_of_the_start_of_a_floor_depends_on_left_out_runs(surface_problem):
    """Neither where each floor starts nor the loss by which that was chosen."""
    w, keep = surface_problem.windows, np.ones(48)
    keep[::4] = 0.0
    noise = np.random.default_rng(2).normal(size=w.pose.shape)
    odd = replace(w, pose=np.where(keep[:, None, None], w.pose, noise))
    (one, loss), (other, loss_of_other) = (
        _floors_fitted(p, keep, lambda _: None, p.space.start, "")
        for p in (surface_problem, surface_problem.of(odd))
    )
    np.testing.assert_array_equal(other.z, one.z)
    assert loss_of_other == loss


def test_a_run_gone_wrong_hardly_counts(surface_problem, surface_fit):
    best, _ = surface_fit
    pose = surface_problem.windows.pose.copy()
    pose[5, 1:, :2] += 0.5  # the camera jumped
    spoilt = surface_problem.of(replace(surface_problem.windows, pose=pose))
    again = optimise(spoilt, start=begin(spoilt), **PRECISE)
    std = np.sqrt(np.diag(best.covariance))
    assert (np.abs(again.state.z - best.state.z) / std).max() < 1.0
    electric = spoilt.electric(again.state.z, again.state.log_variance)
    blocks = spoilt.linear(again.state.z, electric)[0]
    weight = spoilt.whitening(blocks, again.state.log_variance, np.ones(48))[1]["motion"]
    assert np.argmin(weight) == 5
    assert float(weight[5]) < 0.05 * float(np.median(weight))


@pytest.mark.parametrize("radius", [0.04, 0.034])
def test_the_staged_start_finds_the_way_from_far_off(surface_problem, surface_fit, radius):
    """Also from a radius that slip has made shorter: the slip is that of the config's radius."""
    best, _ = surface_fit
    start = Choice("robot.wheel_radius", start=radius, prior_mean=0.04, prior_std=0.004)
    problem = Problem(surface_problem.windows, surface_problem.robot, [*SURFACE[:-1], start])
    assert value(problem, begin(problem), "robot.wheel_radius") == pytest.approx(radius)
    states = []
    found = optimise(problem, tolerance=2e-4, most_rounds=100, tell=states.append)
    assert found.converged, found.reason
    std = np.sqrt(np.diag(best.covariance))
    np.testing.assert_allclose(found.state.z / std, best.state.z / std, atol=0.05)
    held = [s for s in states if s.stage == "all but the lengths"]
    radii = [float(value(problem, s, "robot.wheel_radius")) for s in held]
    assert radii == pytest.approx([0.04, 0.04])
    of_start = [s for s in states if s.stage != "joint"]
    assert len(of_start) == start_rounds(problem.space)  # so that their progress is known
    assert float(value(problem, found.state, "robot.wheel_radius")) != radii[1]


# what is compiled


def test_steps_of_the_solver_go_down_the_valley_of_rosenbrock():
    """A function whose first undamped steps go uphill; each accepted step must lower it."""
    start, twists = np.array([-1.2, 1.0]), Twists(np.zeros((1, 1, 3)), None, None)

    def residuals(y, near):
        a, b = start + y
        slopes = np.array([[-20 * a, 10.0], [-1.0, 0.0]])
        return LinearisedResiduals(np.array([10 * (b - a**2), 1 - a]), slopes, near)

    ends = [levenberg(residuals, 2, twists, steps)[0] for steps in range(1, 40)]
    losses = [residuals(end, twists).loss for end in ends]
    assert losses[0] < residuals(np.zeros(2), twists).loss
    assert all(b < a or a < 1e-15 for a, b in pairwise(losses))
    np.testing.assert_allclose(start + ends[-1], [1.0, 1.0], atol=1e-6)


def test_a_problem_is_forgotten_after_use_and_those_like_it_compile_nothing(truth):
    """A fit of ten folds or replicates must not keep ten data sets, nor wait ten times."""
    w, choices = made(truth, runs=48, std=NOISE), [Choice(p, free=True) for p in LEVEL]

    def fit(seed):
        moved = w.pose + np.random.default_rng(seed).normal(scale=1e-4, size=w.pose.shape)
        made_of = Problem(replace(w, pose=moved), truth, [NOTHING, *choices])
        optimise(made_of, start=begin(made_of), most_rounds=1)
        return made_of

    first = fit(0)
    kept = weakref.ref(first), weakref.ref(first.objective), weakref.ref(first.space)
    del first
    gc.collect()
    assert [ref() for ref in kept] == [None] * 3
    jitted = (of_problem.linear_given, of_problem.log_jacobian, _stacked)
    jitted += (variances.whitening, variances.scoring_step, variances.precision)
    before = [f._cached._cache_size() for f in jitted]
    assert min(before) > 0
    fit(1)
    assert [f._cached._cache_size() for f in jitted] == before
