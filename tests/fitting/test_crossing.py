"""Runs over several floors: their part of a fit, wheel positions, and their config."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal
from typer.testing import CliRunner

from slipid.app import compare
from slipid.app import sample as sampling
from slipid.app.config import read_config
from slipid.app.logs import packaged_config
from slipid.app.problem import read_fit_task, with_mixed
from slipid.cli.main import app
from slipid.data.floor_map import from_polygons, uniform
from slipid.data.runs import collect
from slipid.data.windows import Windows
from slipid.deploy.deploy import read_robot
from slipid.fitting import likelihood as lk
from slipid.fitting import multi_floor as cut
from slipid.fitting import optimise as optimising
from slipid.fitting.multi_floor_fit import (
    _every_second_sector,
    fit_multi_floor,
)
from slipid.fitting.newton import newton_step
from slipid.fitting.optimise import optimise
from slipid.fitting.problem import Problem
from slipid.fitting.variances import _cut, whitened
from slipid.infer.fit_file import load
from slipid.infer.posterior.coordinates import ELECTRIC, MOTION, Fitted, around, on_one_floor
from slipid.infer.posterior.density import Density, electric_given_motion
from slipid.infer.posterior.variance_draws import conditional, floor_runs, weights_at
from slipid.infer.posterior.variance_likelihood import linear_parts
from slipid.lab.selftest.logs import SimulatedSensors, heading_grid, simulate_logs, true_robot
from slipid.model import se2
from slipid.report.html.evidence import read_evidence
from slipid.report.html.sections.predictions import end_error
from slipid.robot.interface import MIXED_FLOORS_PENALTY, Settings
from slipid.search_space import Choice
from slipid.support.errors import DataError
from tests.app.test_config import GOOD, written
from tests.helpers.broken_logs import ROBOTINO, robotino_text, write_good
from tests.helpers.made_logs import write_logs
from tests.helpers.made_windows import made, robot
from tests.helpers.said import KeptMessages

NUMBERS = ("friction", "creep", "roller_drag")
CHOICES = [
    Choice("*", free=False),
    *(Choice(f"surface.*.{name}", free=True) for name in NUMBERS),
    Choice("surface.*.friction", prior_mean=0.6, prior_std=0.4),
    Choice("motor.back_emf", prior_mean=0.0514, prior_std=0.0025),
    Choice("motor.coulomb_friction", free=True),
    Choice("camera.scale", prior_mean=1.1, prior_std=0.01),
]
PLACE, HEADING, CURRENT, OFFSET = 0.0002, 0.0005, 0.05, 0.1
PER_RUN = 20


def made_robot(friction=(0.8, 0.45)):
    blank = robot(loads=("as_built",), sessions=("one",))
    return eqx.tree_at(lambda r: r.surfaces.friction, blank, jnp.asarray(friction))


def still(lag, runs, per_run):
    """Windows of wheels that do not turn, at the origin."""
    zero = np.zeros((runs, per_run, 3))
    return Windows(
        run=np.arange(runs),
        surface=("unknown",) * runs,
        load=("as_built",) * runs,
        session=("elsewhere",) * runs,
        start=np.zeros(runs),
        dt=np.full((runs, per_run), 0.25),
        turn=zero,
        speed_change=zero,
        direction=zero,
        pose=np.zeros((runs, per_run + 1, 3)),
        current=zero,
        voltage=zero,
        current_var=zero + 1e-4,
        voltage_var=zero,
        has_current=True,
        has_voltage=False,
        current_is_signed=False,
        lag=float(lag),
    )


def crossed(truth_, runs, seed, offset=OFFSET):
    """Runs whose wheels stand on floors drawn at random, with camera and ammeter noise.

    The currents of a run have an offset in common; one window in five does not count.
    """
    rng = np.random.default_rng(seed)
    shape = (runs, PER_RUN)
    way, speed = rng.uniform(0, 2 * np.pi, shape), rng.uniform(0.1, 0.25, shape)
    xi = np.stack([speed * np.cos(way), speed * np.sin(way), np.zeros(shape)], -1)
    rate = xi @ np.asarray(truth_.geometry.forward()).T / 0.04
    floor = rng.integers(2, size=(*shape, 3))
    w = still(truth_.camera.lag, runs, PER_RUN)
    w = replace(w, turn=0.25 * rate, direction=np.tanh(rate / 0.2))

    @jax.jit
    def seen(b):
        p = lk.predict(truth_, b)
        return p.increment, lk.predicted_current(truth_, b, p.motor_force)

    increment, amps = seen(lk.batch(w, truth_, floor))

    def onward(pose, step):
        pose = se2.compose(pose, step)
        return pose, pose

    first = jnp.zeros((runs, 3))
    _, places = jax.lax.scan(jax.vmap(onward), first, jnp.swapaxes(increment, 0, 1))
    poses = jnp.concatenate([first[:, None], jnp.swapaxes(places, 0, 1)], axis=1)
    pose = np.array(jax.jit(jax.vmap(jax.vmap(truth_.camera.logged)))(poses))
    pose += rng.normal(size=pose.shape) * [PLACE, PLACE, HEADING]
    noise = CURRENT * rng.normal(size=amps.shape) + offset * rng.normal(size=(runs, 1, 3))
    w = replace(w, pose=pose, current=np.asarray(amps) + noise)
    runs_ = tuple((f"site/run{k}.csv", f"{k:x}") for k in range(runs))
    return cut.MultiFloorRuns(w, floor, rng.uniform(size=shape) > 0.2, runs_)


STD = {"camera.place": PLACE, "camera.heading": HEADING, "current.window": CURRENT}


@pytest.fixture(scope="module")
def fitted():
    """Truth, the problem of runs on one floor each, and its optimum."""
    true = made_robot()
    w = replace(made(true, runs=24, std=STD, signed=False), has_voltage=False)
    problem = Problem(w, true, CHOICES)
    return true, problem, optimise(problem)


@pytest.fixture(scope="module")
def learnt(fitted):
    true, problem, optimum = fitted
    return fit_multi_floor(problem, optimum, crossed(true, 12, 1), lambda state: None)


def ratio(space, z, covariance):
    """Log of the ratio of both frictions, and its std."""
    c = np.zeros(space.size)
    for floor, sign in (("firm", 1.0), ("soft", -1.0)):
        c[space.slices[f"surface.{floor}.friction"]] = sign
    return float(c @ z), float(np.sqrt(c @ covariance @ c))


@pytest.mark.slow
def test_what_one_floor_leaves_open_several_tell(fitted, learnt):
    true, problem, before = fitted
    _, wide = ratio(problem.space, before.state.z, before.covariance)
    found, std = ratio(problem.space, learnt.optimum.state.z, learnt.optimum.covariance)
    assert learnt.optimum.converged
    assert std < 0.7 * wide
    assert found == pytest.approx(np.log(0.8 / 0.45), abs=3 * std)
    away = learnt.optimum.state.z - problem.space.vector(true)
    told = away @ np.linalg.solve(learnt.optimum.covariance, away)
    assert told < chi2(problem.space.size).ppf(0.999)


@pytest.mark.slow
def test_a_contradiction_of_motion_and_currents_does_not_drift_from_round_to_round(fitted):
    """Motion over several floors has another ratio of frictions than all currents."""
    true, problem, optimum = fitted
    slippery = eqx.tree_at(lambda r: r.surfaces.friction, true, jnp.array([0.8, 0.25]))
    several = crossed(slippery, 12, 1)
    current = crossed(true, 12, 1).windows.current
    several = replace(several, windows=replace(several.windows, current=current))
    whole = problem.with_multi_floor(several)
    start, states = replace(whole.carried_over(optimum.state, problem), round=0), []
    found = optimise(whole, start=start, tell=states.append)
    assert found.converged
    ratios = np.array([ratio(whole.space, s.z, found.covariance)[0] for s in states])
    low, high = np.log(0.8 / 0.45), np.log(0.8 / 0.25)
    assert low < ratios[-1] < high  # of currents and of motion
    assert (np.abs(np.diff(ratios[-5:])) < 0.001).all()
    assert (
        np.diff(found.history).max() < 0.1
    )  # the loss never rises, but by what noise is rounded to


@pytest.mark.slow
def test_held_out_runs_over_several_floors_change_no_step_of_the_motion(fitted):
    """Neither do currents or the prior of friction, without motion over several floors."""
    true, problem, optimum = fitted
    state = replace(optimum.state, z=problem.space.vector(true))
    whole = problem.with_multi_floor(crossed(true, 6, 5))
    joint = whole.carried_over(state, problem)
    alone = np.ones(len(problem.windows))
    keep = np.concatenate([alone, np.zeros(6)])
    motion = ~problem.space.electric
    stds = []
    for p, at, used in ((problem, state, alone), (whole, joint, keep)):
        linear = p.linear(at.z, p.electric(at.z, at.log_variance))
        found = newton_step(p, at, linear, used)
        stds.append((found.step[motion], np.linalg.inv(found.information)[np.ix_(motion, motion)]))
    np.testing.assert_allclose(stds[1][0], stds[0][0], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(stds[1][1], stds[0][1], rtol=1e-6, atol=1e-12)
    one, other = (
        optimise(p, keep=used, start=at, tolerance=0.001, variances=False)
        for p, at, used in ((problem, state, alone), (whole, joint, keep))
    )
    off = (other.state.z - one.state.z) / np.sqrt(np.diag(one.covariance))
    assert np.abs(off).max() < 0.01


def test_a_round_gives_its_solver_the_derivative_of_its_residuals(fitted, monkeypatch):
    true, problem, optimum = fitted
    whole = problem.with_multi_floor(crossed(true, 6, 5))
    given = []

    def noted(residuals, size, near, steps):
        given.append((residuals, near))
        return np.zeros(size), near

    monkeypatch.setattr(optimising, "levenberg", noted)
    start = whole.carried_over(optimum.state, problem)
    optimise(whole, start=start, tolerance=1e9, variances=False)
    residuals, near = given[0]
    size = problem.space.size
    y, along = np.random.default_rng(0).normal(size=(2, size)) * 0.05
    before, at, after = (residuals(y + h * along, near) for h in (-0.01, 0, 0.01))
    slope = (after.residual - before.residual) / 0.02
    off = slope - at.jacobian @ along
    np.testing.assert_allclose(off[-size:], 0.0, atol=1e-9)  # those of the prior are linear
    assert np.linalg.norm(off) < 1e-3 * np.linalg.norm(slope)


@pytest.mark.slow
def test_left_out_halves_are_predicted_down_to_the_noise(learnt):
    noise = np.sqrt(2) * np.array([1.1 * PLACE, HEADING]) / 0.25
    assert learnt.after.yaw_rate < learnt.before.yaw_rate
    assert learnt.after.speed < learnt.before.speed
    of_motion = replace(learnt, after=learnt.after._replace(current=None), settled=True)
    assert of_motion.gain == of_motion.after.over(learnt.before) < 1
    assert replace(of_motion, settled=False).gain is None
    assert replace(of_motion, after=None).gain is None
    assert learnt.after.yaw_rate == pytest.approx(noise[1], rel=0.15)
    assert learnt.after.speed == pytest.approx(np.sqrt(2) * noise[0], rel=0.25)
    assert learnt.after.current == pytest.approx(np.hypot(CURRENT, OFFSET), rel=0.25)


@pytest.mark.slow
def test_the_sampled_density_has_the_mode_and_the_curvature_of_the_fit(learnt):
    o = learnt.optimum
    whole = Fitted(o.state.z, o.state.log_variance, o.covariance)
    density = Density(*around(learnt.problem, whole), MOTION)
    target, size, step = density.target(), density.size, 1e-3
    assert [name for name in density.names if "friction" in name] == [
        "surface.firm.friction",
        "surface.soft.friction",
    ]
    std = np.sqrt(np.diag(density.covariance))
    off = step * np.concatenate([np.diag(std), -np.diag(std)])
    values = target.log_prob(density.centre + off)[:, 0]
    slope = (values[:size] - values[size:]) / (2 * step)
    # The Student t has its factor of information for each block, so that modes differ a little.
    assert np.abs(slope).max() < 0.3
    assert np.abs(slope[:2]).max() < 0.01  # of friction
    information = np.diag(1 / target.prior_std**2) + target.link.T @ target.link
    for group in range(target.groups):
        y, _ = target.rows(density.centre + off, group)
        half = (y[:size] - y[size:]) / (2 * step * std[:, None])
        information += half @ half.T
    found = np.linalg.inv(information)
    own = np.sqrt(np.diag(found))
    np.testing.assert_allclose(own, std, rtol=0.12)
    correlation = density.covariance / np.outer(std, std)
    np.testing.assert_allclose(found / np.outer(own, own), correlation, atol=0.05)
    # so has the linear part, from which variances are drawn
    problem, fitted = around(learnt.problem, whole)
    part = linear_parts(problem, fitted)[0]
    weights = weights_at(problem, fitted)
    every = np.arange(problem.space.size)
    linear = conditional(part, floor_runs(part), weights, fitted.log_variance, every)
    mine = density.structure
    own = np.sqrt(np.diag(linear.covariance)[mine])
    np.testing.assert_allclose(own, std, rtol=0.12)
    assert np.abs(linear.mean[mine] / std).max() < 0.3
    linked = (density.centre + off - target.link_centre) @ target.link.T
    values = target.terms(density.centre + off)[:, -2] - 0.5 * (linked**2).sum(axis=1)
    by_several = (values[:size] - values[size:]) / (2 * step)
    np.testing.assert_allclose(by_several, fitted.multi_floor.pull[mine] * std, atol=1e-3)
    several = linear.covariance[np.ix_(mine, mine)] / np.outer(own, own)
    np.testing.assert_allclose(several, correlation, atol=0.05)


@pytest.mark.slow
def test_electric_parameters_are_drawn_given_motion_and_friction(learnt):
    """From the currents of all runs, those over several floors included."""
    o = learnt.optimum
    whole = Fitted(o.state.z, o.state.log_variance, o.covariance)
    problem, fitted = around(learnt.problem, whole)
    first, second = Density(problem, fitted, MOTION), Density(problem, fitted, ELECTRIC)
    assert second.names == ("motor.back_emf", "motor.coulomb_friction")
    x = np.tile(first.centre, (1, 150, 1))
    found = electric_given_motion(first, second, o.covariance, x, 0)[0][0]
    precision = np.linalg.inv(o.covariance)[np.ix_(second.structure, second.structure)]
    given = np.sqrt(np.diag(np.linalg.inv(precision)))
    np.testing.assert_allclose(found.std(axis=0), given, rtol=0.25)
    assert np.abs(found.mean(axis=0) - second.centre).max() < 0.4 * given.max()


@pytest.mark.slow
def test_currents_of_runs_over_several_floors_alone_leave_the_motion_to_motion():
    true = made_robot()
    w = replace(made(true, runs=24, std=STD, signed=False), has_voltage=False, has_current=False)
    problem = Problem(w, true, CHOICES).with_multi_floor(crossed(true, 6, 5))
    log_v = 2 * np.log(problem.noise.typical)
    size = problem.space.size
    alone, fitted = on_one_floor(problem, Fitted(problem.space.start, log_v, np.eye(size)))
    assert not alone.objective.joint
    assert problem.with_multi_floor(None).objective.joint
    assert len(fitted.log_variance) == len(alone.noise.names) < len(log_v)


@pytest.mark.slow
def test_the_noise_of_currents_and_the_offsets_of_runs_are_told_apart(learnt):
    problem, log_v = learnt.problem, learnt.optimum.state.log_variance
    std = dict(zip(problem.noise.names, np.exp(0.5 * np.asarray(log_v)), strict=True))
    assert std["crossing.current.window"] == pytest.approx(CURRENT, rel=0.15)
    assert std["crossing.current.run"] == pytest.approx(OFFSET, rel=0.35)


@pytest.mark.slow
def test_what_a_run_is_off_all_along_counts_once_not_once_a_window(fitted):
    """Information of currents falls to that of a mean over runs as their offsets grow."""
    true, problem, optimum = fitted
    whole = problem.with_multi_floor(crossed(true, 12, 1))
    state = whole.carried_over(optimum.state, problem)
    jacobian = whole.linear(state.z, whole.electric(state.z, state.log_variance))[1]
    at = whole.noise.names.index("crossing.current.run")
    told = []
    for offset in (1e-4, OFFSET):
        log_v = np.array(state.log_variance)
        log_v[at] = 2 * np.log(offset)
        half = whitened(whole.noise.blocks, jacobian, log_v, whole.full_weight)[
            cut.MULTI_FLOOR_CURRENT
        ]
        k = whole.space.slices["motor.back_emf"]
        told.append(float((half[..., k] ** 2).sum()))
    assert told[1] < 0.3 * told[0]


@pytest.mark.slow
def test_windows_that_do_not_count_say_nothing(fitted):
    true, problem, optimum = fitted
    several = crossed(true, 6, 5)
    whole = problem.with_multi_floor(several)
    state = whole.carried_over(optimum.state, problem)
    where = state.z, whole.electric(state.z, state.log_variance)
    dead = ~several.counts
    moved = replace(
        several.windows,
        current=np.where(dead[..., None], 7.0, several.windows.current),
        turn=np.where(dead[..., None], 0.3, several.windows.turn),
    )
    other = problem.with_multi_floor(replace(several, windows=moved))
    for k in (cut.MULTI_FLOOR_MOTION, cut.MULTI_FLOOR_CURRENT):
        (r, slope), (r2, slope2) = (
            (p.linear(*where)[0][k], p.linear(*where)[1][k]) for p in (whole, other)
        )
        np.testing.assert_array_equal(np.asarray(r), np.asarray(r2))
        np.testing.assert_array_equal(np.asarray(slope), np.asarray(slope2))
        live = np.repeat(several.counts, 3, axis=1)
        assert not np.asarray(r)[~live].any()
        assert np.asarray(r)[live].all()
        v = np.asarray(whole.covariance(k, state.log_variance))
        segment, row = np.argwhere(~live)[0]
        np.testing.assert_array_equal(v[segment, row], np.eye(v.shape[1])[row])
        np.testing.assert_array_equal(
            np.asarray(whole.noise.blocks[k].count), 3.0 * several.counts.sum(axis=1)
        )


@pytest.mark.slow
def test_pieces_left_out_change_nothing(fitted):
    """The loss of kept segments does not know what was measured in the others."""
    true, problem, optimum = fitted
    several = crossed(true, 6, 5)
    keep = np.concatenate([np.ones(len(problem.windows)), np.arange(6) % 2])
    losses = []
    for shift in (0.0, 0.4):
        current = several.windows.current + shift * (1 - np.arange(6) % 2)[:, None, None]
        whole = problem.with_multi_floor(
            replace(several, windows=replace(several.windows, current=current))
        )
        state = whole.carried_over(optimum.state, problem)
        electric = whole.electric(state.z, state.log_variance)
        blocks, _ = whole.linear(state.z, electric)
        seen = whole.weighed(blocks, state.log_variance, keep, state.shared(len(problem.windows)))
        losses.append(whole.loss(state.z, state.log_variance, keep, seen, electric))
    assert losses[0] == losses[1]


def test_runs_in_the_same_direction_are_held_out_together():
    """The two runs towards 180 degrees have headings of either sign."""
    headings = np.radians([0, 179, 90, -179, 2, 93, 60])
    w = still(0.0, len(headings) + 1, 2)
    w = replace(w, run=np.array([0, 1, 2, 3, 4, 4, 5, 6]))  # the fifth run has two segments
    steps = np.stack([np.cos(headings), np.sin(headings), 0 * headings], axis=1)[w.run]
    pose = np.array([0.0, 0.5, 1.0])[:, None] * steps[:, None]
    pose[5] += steps[5]

    def halves(windows):
        floor, counts = np.zeros((8, 2, 3), int), np.ones((8, 2), bool)
        return _every_second_sector(cut.MultiFloorRuns(windows, floor, counts, ()))

    odd = halves(replace(w, pose=pose))
    of_run = dict(zip(w.run.tolist(), odd.tolist(), strict=True))
    assert of_run[0] == of_run[4] == odd[4]
    assert of_run[1] == of_run[3]
    assert of_run[2] == of_run[5]
    # sectors at 0, 60, 90 and 180 degrees
    assert [of_run[k] for k in (0, 6, 2, 1)] == [False, True, False, True]
    one = replace(w, pose=np.broadcast_to(pose[:1], pose.shape))
    assert halves(one).tolist() == (w.run % 2 == 1).tolist()


def test_the_gain_of_held_out_runs_is_that_of_the_worse_channel_and_needs_currents():
    before = cut.WindowErrors(0.04, 0.2, 0.3)

    def gain(speed, yaw_rate, current):
        return cut.WindowErrors(speed, yaw_rate, current).over(before)

    assert gain(0.01, 0.1, 0.2) == pytest.approx(0.5)
    assert gain(0.03, 0.1, 0.3) == pytest.approx(0.75)
    assert gain(0.01, 0.1, None) == pytest.approx(0.5)
    assert gain(0.01, 0.1, 0.31) is None


@pytest.mark.slow
def test_a_single_run_judges_nothing(fitted, monkeypatch):
    """Where a fit of it ends does not matter, and it is not compiled for one run."""
    true, problem, optimum = fitted

    def ended(whole, start, **_):
        return replace(optimum, state=start)

    monkeypatch.setattr("slipid.fitting.multi_floor_fit.optimise", ended)
    found = fit_multi_floor(
        problem, optimum, crossed(true, 1, 3), lambda state: None, most_rounds=2
    )
    assert found.after is None
    assert len(found.problem.full_weight) == len(problem.windows) + 1


def test_information_of_a_cut_is_that_of_motion_and_of_electric_parameters_given_motion():
    """Against densities written out; y1 is of the motion, y2 of currents."""
    rng = np.random.default_rng(2)
    e = np.array([False, True, False, True, False])
    first, second = rng.normal(size=(2, 7, 5))
    prior = np.diag(rng.uniform(0.5, 2.0, 5))
    motion, electric = first.T @ first, second.T @ second
    found = np.asarray(_cut(*map(jnp.asarray, (motion, electric, prior, e))))
    # what y2 and the prior say of electric parameters, given the others
    both = electric + prior
    spread = np.linalg.inv(both[np.ix_(e, e)])

    def log_density(z):
        given = -spread @ both[np.ix_(e, ~e)] @ z[~e]
        of_others = prior[np.ix_(~e, ~e)]
        return (
            -0.5 * np.sum((first @ z) ** 2)
            - 0.5 * z[~e] @ of_others @ z[~e]
            + multivariate_normal(given, spread).logpdf(z[e])
        )

    z = rng.normal(size=(6, 5))
    expected = [log_density(x) - log_density(np.zeros(5)) for x in z]
    np.testing.assert_allclose([-0.5 * x @ found @ x for x in z], expected, rtol=1e-9)
    # if motion says nothing about electric parameters, the others are those of motion alone
    alone = motion * (~e[:, None] & ~e[None, :])
    found = np.asarray(_cut(*map(jnp.asarray, (alone, electric, prior, e))))
    marginal = np.linalg.inv((alone + prior)[np.ix_(~e, ~e)])
    np.testing.assert_allclose(np.linalg.inv(found)[np.ix_(~e, ~e)], marginal, rtol=1e-9)


# where wheels stand -----------------------------------------------------------------------------


@pytest.mark.slow
def test_wheels_stand_where_the_camera_says_less_the_marker():
    true = made_robot()
    true = eqx.tree_at(lambda r: r.camera.marker_yaw, true, jnp.asarray(0.1))
    w = still(0.0, 1, 1)
    x, y, heading = 0.3, -0.2, np.pi / 2
    px, py = np.asarray(true.camera.marker_place)
    marker = jnp.array([x - py, y + px, heading + 0.1])
    logged = np.asarray(eqx.filter_jit(true.camera.logged)(marker))
    pose = np.asarray(lk.corrected(true, jnp.tile(logged, (1, 2, 1))))
    found = cut.wheel_places(true, pose, w.session)
    place = 0.125 * np.asarray(true.geometry.place)
    expected = np.stack([x - place[:, 1], y + place[:, 0]], 1)
    assert found.shape == (1, 2, 3, 2)
    np.testing.assert_allclose(found[0], np.tile(expected, (2, 1, 1)), atol=1e-6)


@pytest.fixture(scope="module")
def driven():
    drives = heading_grid(setups=(("soft", "as_built"), ("firm", "as_built")), headings=2, turns=0)
    true = true_robot(drives)
    logs = [
        replace(log, surface=None) for log in simulate_logs(true, drives, 1, SimulatedSensors())
    ]
    return true, collect(logs)


RIGHT = [[0.0, -9.0], [9.0, -9.0], [9.0, 9.0], [0.0, 9.0]]


@pytest.mark.slow
def test_windows_in_which_no_wheel_changes_floors(driven):
    true, data = driven
    half = from_polygons("soft", [("firm", RIGHT)], (-3.0, -3.0, 3.0, 3.0))
    whole = cut.multi_floor_runs([(data, uniform("soft", 3.0))], true)
    some = cut.multi_floor_runs([(data, half)], true)
    assert set(whole.floor.ravel()) == {true.surface_index("soft")}
    assert 0 < some.counts.sum() < whole.counts.sum()
    for run, window in np.argwhere(some.counts):
        w = some.windows
        logged = jnp.asarray(w.pose[run : run + 1, window : window + 2])
        edges = np.asarray(lk.corrected(true, logged))[0]
        pose = np.stack([edges[0], edges.mean(axis=0), edges[1]])
        x = cut.wheel_places(true, pose[None], w.session[run : run + 1])[0, ..., 0]
        assert ((x > 0) == (some.floor[run, window] == true.surface_index("firm"))).all()
    w = whole.windows
    assert w.dt[whole.counts].max() < 2 * cut.LONGEST
    rim = 0.04 * np.abs(w.turn) / w.dt[..., None]
    assert rim.max(axis=2)[whole.counts].min() >= cut.LEAST_SPEED


@pytest.mark.slow
def test_windows_of_a_run_stand_in_a_row_and_two_maps_go_together(driven):
    true, data = driven
    floor = uniform("soft", 3.0)
    one = cut.multi_floor_runs([(data, floor)], true)
    assert one.counts.shape[1] <= cut.MOST_WINDOWS
    for k in range(len(data)):
        row = one.windows.segments(np.array([k]))
        poses = data.pose[data.rows(k)]
        at = [np.flatnonzero((poses == place).all(axis=1))[0] for place in row.pose[0]]
        there = np.flatnonzero(one.counts[k])[-1] + 2  # beyond it the last window is repeated
        assert (np.diff(at[:there]) > 0).all()  # edges are logged poses, in their order
        live = one.counts[k]
        steps = np.diff(row.pose[0], axis=0)[live]
        assert (np.abs(steps).max(axis=1) > 0).all()
    both = cut.multi_floor_runs([(data, floor), (data.subset([0]), floor)], true)
    assert both.runs == (*one.runs, one.runs[0])
    assert both.windows.run.tolist() == [*one.windows.run.tolist(), len(data)]
    np.testing.assert_array_equal(both.windows.turn[-1], one.windows.turn[0])


@pytest.mark.slow
def test_runs_without_a_window_are_refused(driven, monkeypatch):
    true, data = driven
    monkeypatch.setattr(cut, "LEAST_SPEED", 9.0)
    with pytest.raises(DataError, match=r"no window in which .*expected larger patches"):
        cut.multi_floor_runs([(data, uniform("soft", 3.0))], true)


# configs ----------------------------------------------------------------------------------------

SITE = (
    '[[logs]]\nglob = "site/*.csv"\nformat = "robotino2022"\nmap = "maps/site.toml"\n[parameters]'
)
MAP = 'schema = "slipid.map/1"\nbase = "gray"\nextent_m = [-2, -2, 2, 2]\n'


@pytest.fixture
def folder(tmp_path):
    write_good(tmp_path)
    for path, text in (
        ("site/exp01.csv", robotino_text(heading=70)),
        ("maps/site.toml", MAP),
    ):
        (tmp_path / path).parent.mkdir()
        (tmp_path / path).write_text(text, encoding="utf-8")
    return tmp_path


def mixed_job(folder: Path, text: str, said=None):
    said = said or KeptMessages()
    return with_mixed(read_fit_task(read_config(written(folder, text)), folder, said), folder, said)


def test_runs_with_a_map_are_kept_apart(folder):
    job = mixed_job(folder, GOOD.replace("[parameters]", SITE))
    assert [log.name for log in job.dataset.logs] == [ROBOTINO]
    ((data, floor),) = job.mixed
    assert floor.surfaces == ("gray",)
    assert [(log.name, log.surface) for log in data.logs] == [("site/exp01.csv", None)]
    assert [log.name for log in job.logs] == [ROBOTINO, "site/exp01.csv"]
    assert job.data_hash != mixed_job(folder, GOOD).data_hash


def test_a_set_with_a_map_and_no_files_is_skipped(folder):
    said = KeptMessages()
    job = mixed_job(folder, GOOD.replace("[parameters]", SITE.replace("site/", "far/")), said)
    assert job.mixed == ()
    assert len(said.lines) == 1
    assert said.lines[0].startswith("skipped: ")
    assert job.skipped == tuple(said.lines)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("maps/site.toml", "none.toml"), r"none\.toml: No such file.*expected a floor map"),
        (("site/*", "one_surface/gray/*"), "found by two globs of .*my.toml; expected it once"),
        (("map =", 'load = "far"\nmap ='), "load set-up 'far'.*expected one of as_built"),
        (("map =", 'surface = "gray"\nmap ='), "both surface and map are given"),
        (("map =", "maps ="), "did you mean map"),
    ],
)
def test_mistakes_with_maps_are_named(folder, change, expected):
    assert change[0] in SITE
    with pytest.raises(DataError, match=expected):
        mixed_job(folder, GOOD.replace("[parameters]", SITE.replace(*change)))


def test_every_floor_of_a_map_needs_runs_of_its_own(folder):
    path = folder / "maps/site.toml"
    path.write_text(MAP.replace("gray", "sand"), encoding="utf-8")
    with pytest.raises(DataError, match=r"site\.toml: surface 'sand'.*expected one of gray"):
        mixed_job(folder, GOOD.replace("[parameters]", SITE))


def test_a_config_needs_runs_on_one_floor(folder):
    head = GOOD[: GOOD.index("[[logs]]")]
    with pytest.raises(
        DataError, match="every section has a map; expected at least one section without"
    ):
        read_config(written(folder, head + SITE))


# the whole way ----------------------------------------------------------------------------------


def invoke(*words):
    return CliRunner().invoke(app, [str(w) for w in words])


@pytest.mark.slow
def test_identify_learns_from_them_and_later_commands_know(tmp_path, monkeypatch):
    drives = heading_grid(setups=(("soft", "as_built"),), headings=6, speeds=(0.1, 0.3), turns=0)
    true = true_robot(drives)
    write_logs(
        simulate_logs(true, drives, 1, SimulatedSensors()), true, tmp_path / "logs", tmp_path / "t"
    )
    write_logs(
        simulate_logs(true, drives[:4], 2, SimulatedSensors()),
        true,
        tmp_path / "site",
        tmp_path / "t",
    )
    (tmp_path / "site/as_built/soft").rename(tmp_path / "logs/site")
    (tmp_path / "site.toml").write_text(MAP.replace("gray", "soft"), encoding="utf-8")
    section = '[[logs]]\nglob = "site/*.csv"\nformat = "demo"\nmap = "site.toml"\n[parameters]'
    text = packaged_config("robotino.toml").replace("[parameters]", section)
    config, out = written(tmp_path, text), tmp_path / "out"
    said = invoke("identify", config, "--data", tmp_path / "logs", "--out", out)
    assert said.exit_code == 0, said.stderr
    assert "4 runs over several floors: predicted within" in said.stderr
    fit = load(out)
    assert fit.converged
    assert len(fit.runs) == 16
    assert fit.mixed["runs"] == 4
    assert fit.refused is None
    assert not fit.mixed["floors"]["soft"]["is_worse"]
    assert {"crossing.run.yaw", "crossing.process.along", "crossing.current.run"} < set(
        fit.variance
    )
    shown = read_evidence(out / "evidence.json")
    assert [run.map for run in shown.over_floors] == [0] * 4
    assert (len(shown.runs), shown.maps[0].surfaces) == (12, ["soft"])
    for one in shown.over_floors:  # they were driven on this floor
        assert one.floor == "soft"
        assert end_error(one, "contact") < 0.05 * one.path_m < 2 * end_error(one, "nominal")
    assert "Runs over several floors (4) are drawn" in (out / "report.html").read_text()
    run = json.loads((out / "run.json").read_text())
    assert run["data"]["hash"] == fit.data_hash
    assert len(run["data"]["logs"]) == 16
    judged = invoke("validate", out, "--data", tmp_path / "logs", "--json", tmp_path / "v.json")
    assert judged.exit_code == 0, judged.stderr
    assert len(json.loads((tmp_path / "v.json").read_text())["runs"]) == 12
    compared(config, tmp_path, monkeypatch)
    (tmp_path / "site.toml").unlink()  # the folder of the results has a copy
    whole = sampling.sample

    def of_few_rows(out, data, plan, *more):
        return whole(out, data, replace(plan, rows=300, warm_up=(1, 2)), *more)

    monkeypatch.setattr(sampling, "sample", of_few_rows)
    drawn = invoke("sample", out, "--most", 40, "--block", 2, "--draws", 10)
    assert drawn.exit_code == 1, drawn.stderr  # so few steps are not converged
    about = json.loads((out / "sample.json").read_text())
    assert about["worst"]["r_hat"] < 1.5
    assert "surface.soft.friction" not in about["coordinates"]  # nothing moves by its friction
    deployed(out)


def compared(config, folder, monkeypatch):
    """The force balance of a fold uses the runs over several floors, and none that is held out."""
    fits, fit = [], compare.optimise

    def spied(problem, *, keep=None, **more):
        fits.append((problem.multi_floor is not None, keep))
        return fit(problem, keep=keep, **more)

    monkeypatch.setattr(compare, "optimise", spied)
    options = ("--data", folder / "logs", "--out", folder / "compared", "--folds", "random")
    result = invoke("compare", config, *options)
    assert result.exit_code == 0, result.stderr
    assert "is also fitted to runs over several floors (4)" in " ".join(result.stdout.split())
    found = json.loads((folder / "compared/comparison.json").read_text())
    assert found["data"]["over_several_floors"] == {"runs": 4, "refused": None}
    folds = found["questions"]["random"]["folds"]
    assert folds > 1
    assert [crossing for crossing, _ in fits] == [False, *(False, True) * folds]
    beside = []
    for (_, alone), (_, whole) in zip(fits[1::2], fits[2::2], strict=True):
        assert 0 < alone.sum() < len(alone)
        np.testing.assert_array_equal(whole[: len(alone)], alone)
        assert len(whole) >= len(alone) + 4
        beside.append(whole[len(alone) :])
    # a run over several floors is left out with the runs on one floor in its direction
    assert (np.sum(beside, axis=0) == folds - 1).all()
    (folder / "site.toml").write_text(MAP.replace("gray", "soft") + "\n", encoding="utf-8")

    def refusing(*_, **__):
        raise DataError("fitted again")

    monkeypatch.setattr(compare, "optimise", refusing)
    # with another map, fits in the folder are not used
    assert "fitted again" in invoke("compare", config, *options).stderr


def deployed(out):
    """The fit drives its twin; what is done is not done again."""
    fit = load(out)
    robot = read_robot(out)
    assert Settings.of(robot).further_floor_penalty == MIXED_FLOORS_PENALTY
    assert fit.current_trend != (0.0, 0.0)
    np.testing.assert_array_equal(robot.current_trend, fit.current_trend)
    wish = ("trial", out, "--plant", "twin", "--starts", 2, "--jobs", 1)
    wish = (*wish, "--controllers", "encoder,contact", "--json", out / "t.json")
    first = invoke(*wish)
    assert first.exit_code == 0, first.stderr
    said = json.loads((out / "t.json").read_text())
    encoder, contact = (said["summary"][name] for name in ("encoder", "contact"))
    # two starts say nothing of closure, but along the first side encoders lose what slips
    assert contact["first_side_along_track_mm"] < 0.5 * encoder["first_side_along_track_mm"]
    assert encoder["first_side_along_track_mm"] > 20
    assert (out / "trial.png").stat().st_size > 10_000
    again = invoke(*wish)
    assert "driving 0 of 4 runs" in again.stderr
    assert json.loads((out / "t.json").read_text())["runs"] == said["runs"]
    wish = ("trial", out, "--plant", "twin", "--starts", 1, "--jobs", 1, "--controllers", "contact")
    words = ("--path", "circle", "--speed", 0.1, "--rest", 2, "--json", out / "t.json")
    circle = invoke(*wish, *words)
    assert circle.exit_code == 0, circle.stderr
    said = json.loads((out / "t.json").read_text())
    run = said["runs"][0]
    assert said["rest_s"] == 2
    # once round takes 22 s at 0.1 m/s, without the rest
    assert run["path_length_mm"] == pytest.approx(2 * np.pi * 350, rel=0.25)
    assert 22 < run["seconds"] < 45


@pytest.mark.nightly
def test_runs_with_a_wrong_map_are_refused(tmp_path):
    """They were driven on `soft`, and their map says `firm`."""
    drives = heading_grid(
        setups=(("soft", "as_built"), ("firm", "as_built")), headings=6, speeds=(0.1, 0.3), turns=0
    )
    true = true_robot(drives)
    write_logs(
        simulate_logs(true, drives, 1, SimulatedSensors()), true, tmp_path / "logs", tmp_path / "t"
    )
    soft = [d for d in drives if d.surface == "soft"]
    write_logs(
        simulate_logs(true, soft, 2, SimulatedSensors()), true, tmp_path / "site", tmp_path / "t"
    )
    (tmp_path / "site/as_built/soft").rename(tmp_path / "logs/site")
    (tmp_path / "site.toml").write_text(MAP.replace("gray", "firm"), encoding="utf-8")
    section = '[[logs]]\nglob = "site/*.csv"\nformat = "demo"\nmap = "site.toml"\n[parameters]'
    text = packaged_config("robotino.toml").replace("[parameters]", section)
    config, out = written(tmp_path, text), tmp_path / "out"
    said = invoke("identify", config, "--data", tmp_path / "logs", "--out", out)
    assert said.exit_code == 0, said.stderr
    assert "were not used, since they contradict the runs on one floor" in said.stderr
    assert "not used in the fit, which they contradict" in (out / "report.html").read_text()
    fit = load(out)
    assert fit.mixed is None
    assert fit.refused["reason"] in fit.messages
    assert "as if all wheels were on soft" in fit.refused["reason"]
    by_map, soft = fit.refused["learnt"]["speed"], fit.refused["as_if"]["soft"]["speed"]
    assert soft < 0.5 * by_map
    for errors in fit.refused["floors"].values():  # its noise absorbs what the map has wrong
        assert errors["after"] < 1.5 * errors["before"]
    assert len(fit.runs) == 24  # those on one floor
    assert not any(name.startswith("crossing.") for name in fit.variance)
