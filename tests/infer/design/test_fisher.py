"""Information of runs: it adds up, it is the likelihood's own, and greedy means greedy."""

from __future__ import annotations

import functools
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag

from slipid.fitting import noise as of_noise
from slipid.fitting.problem import Problem
from slipid.infer.design import fisher as info
from slipid.infer.design.planned_runs import PlannedRun, candidates, steady_windows
from slipid.infer.design.planner import Planner, parameter_goal
from slipid.infer.result import Channels
from slipid.search_space import Choice
from tests.helpers import made_windows

SETUP = ("soft", "as_built")
CHOICES = [
    Choice("robot.mass", fixed=10.0),
    Choice("camera.marker_yaw", free=True),
    Choice("camera.scale", prior_mean=1.1, prior_std=0.01),
]
DRIVES = [
    PlannedRun(*SETUP, 0.3, 0.2),
    PlannedRun(*SETUP, 2.0, 0.1, 0.4),
    PlannedRun("firm", "moved", 0.0, 0.0, -0.5),
    PlannedRun("firm", "as_built", 4.0, 0.3, 0.0, 1.2),
]


@functools.cache
def robot():
    # sessions of the fit are over, a planner has one of its own: without them both are one problem
    return made_windows.robot(sessions=())


@functools.cache
def planner(current, voltage):
    channels = Channels(current, voltage, signed=False)
    noise = of_noise.noise(windows(DRIVES, current, voltage), robot())
    return Planner(
        robot(), CHOICES, dict(zip(noise.names, noise.typical**2, strict=True)), channels
    )


def windows(drives, current, voltage):
    return steady_windows(drives, robot(), Channels(current, voltage))


def log_variance(problem):
    """Return typical stds, a run's own effect including those shared with its neighbours."""
    variance = dict(zip(problem.noise.names, problem.noise.typical**2, strict=True))
    own = {n: v + variance.get(n.replace("run.", "neighbours."), 0.0) for n, v in variance.items()}
    runs = [name.startswith("run.") for name in variance]
    return jnp.log(jnp.asarray(np.where(runs, list(own.values()), list(variance.values()))))


@functools.cache
def rows(current, voltage):
    return planner(current, voltage).rows(DRIVES)


def start(current, voltage):
    """Return the information of the prior alone."""
    this = planner(current, voltage)
    return info.information_of(np.diag(this.space.prior_std**2), this.is_electric)


CASES = [
    (False, False),
    pytest.param(True, True, marks=pytest.mark.slow),
]


@pytest.mark.slow
@pytest.mark.parametrize(("current", "voltage"), CASES)
def test_information_is_that_of_the_likelihood_of_the_same_windows(current, voltage):
    """Information of different runs adds, whatever the channels."""
    this = planner(current, voltage)
    problem = Problem(windows(DRIVES, current, voltage), robot(), CHOICES).without_shared_effects()
    log_v = log_variance(problem)
    blocks, jacobian = problem.linear(jnp.asarray(this.z), problem.electric(this.z, log_v))
    assert all(np.abs(r).max() < 1e-9 for r in blocks.values())  # logged as predicted
    std = this.space.prior_std
    for some in ([0], [2], [1, 3], [0, 1, 2, 3]):
        keep = np.isin(np.arange(len(DRIVES)), some).astype(float)
        precision = np.asarray(problem.precision(jacobian, log_v, jnp.asarray(keep)))
        found = start(current, voltage).plus(rows(current, voltage).pick(some)).covariance
        np.testing.assert_allclose(
            found / std / std[:, None], np.linalg.inv(precision) / std / std[:, None], atol=1e-8
        )


@pytest.mark.slow
def test_runs_of_a_session_cannot_average_away_its_effect():
    """The std equals that of the covariance of all runs together, written out."""
    plain = planner(False, False)
    shared = {"session.firm.along": 1e-4, "session.firm.across": 4e-4, "session.firm.yaw": 1e-3}
    this = Planner(robot(), CHOICES, {**plain.variance, **shared}, Channels(False))
    runs = [0, 1, 2, 3, 2, 2]
    w = windows([DRIVES[k] for k in runs], False, False)
    problem = Problem(w, robot(), CHOICES).without_shared_effects()
    log_v = log_variance(problem)
    _, jacobian = problem.linear(jnp.asarray(this.z), problem.electric(this.z, log_v))
    j = np.asarray(jacobian["motion"]).reshape(-1, this.space.size)
    effect = np.asarray(of_noise.effects(w, robot()))
    on = np.array([DRIVES[k].surface == "firm" for k in runs])[:, None, None]
    effect = (effect * on).reshape(-1, 3)
    assert on.any()
    assert not on.all()
    # the information of a Student t, a Gaussian's at its start
    blocks = np.asarray(problem.covariance("motion", log_v))
    weight = np.asarray(problem.precision(jacobian, log_v, jnp.ones(len(runs))))
    prior = np.diag(1 / this.space.prior_std**2)
    gauss = j.T @ np.linalg.solve(block_diag(*blocks), j)
    factor = np.trace(weight - prior) / np.trace(gauss)
    np.testing.assert_allclose(weight - prior, factor * gauss, rtol=1e-6, atol=1e-6 * gauss.max())
    whole = block_diag(*blocks) / factor + effect * list(shared.values()) @ effect.T
    expected = np.linalg.inv(prior + j.T @ np.linalg.solve(whole, j))
    known = info.information_of(
        block_diag(np.diag(this.space.prior_std**2), np.eye(this.effects)), this.is_electric
    )
    n, std = this.space.size, this.space.prior_std
    found = known.plus(this.rows(DRIVES).pick(runs)).covariance[:n, :n]
    np.testing.assert_allclose(found / std / std[:, None], expected / std / std[:, None], atol=1e-8)
    apart = start(False, False).plus(rows(False, False).pick(runs)).covariance
    assert (np.diag(found) > 1.05 * np.diag(apart)).any()


@pytest.mark.slow
def test_known_undoes_covariance():
    now = start(False, False).plus(rows(False, False))
    again = info.information_of(now.covariance, now.is_electric)
    np.testing.assert_allclose(again.covariance, now.covariance, rtol=1e-8, atol=1e-12)


# choosing ---------------------------------------------------------------------------------------


def made_up(seed, electric=3, count=25):
    """Return information, candidates and a goal without any physics."""
    rng = np.random.default_rng(seed)
    free, m = 9, 4
    root = rng.normal(size=(free, free))
    is_electric = np.arange(free) >= free - electric
    rows = info.RunJacobians(
        rng.normal(size=(count, m, free - electric)),
        rng.normal(size=(count, m, electric)),
        rng.normal(size=(count, m, free - electric)),
    )
    goal = rng.normal(size=(2, free))
    return info.information_of(np.linalg.inv(root @ root.T + np.eye(free)), is_electric), rows, goal


@pytest.mark.parametrize("electric", [0, 3])
@pytest.mark.parametrize("seed", range(5))
def test_each_candidate_has_the_criterion_of_driving_it(seed, electric):
    now, rows, goal = made_up(seed, electric)
    brute = [now.plus(rows.pick([k])).criterion(goal) for k in range(len(rows.motion))]
    np.testing.assert_allclose(now.after_each(rows, goal), brute, rtol=1e-9)
    chosen, found = info.greedy(now, rows, goal, 1)
    assert chosen == [int(np.argmin(brute))]
    assert found == pytest.approx([now.criterion(goal), min(brute)])


@pytest.mark.parametrize("seed", range(5))
def test_a_criterion_of_the_motion_never_rises(seed):
    """A criterion of electric numbers may rise, as a cut is no posterior of one model."""
    now, rows, goal = made_up(seed, electric=0)
    chosen, found = info.greedy(now, rows, goal, 8)
    assert (np.diff(found) < 0).all()
    order = np.random.default_rng(seed).permutation(len(rows.motion))
    path = info.criterion_path(now, rows, goal, order)
    assert (np.diff(path) < 0).all()
    assert info.criterion_path(now, rows, goal, order, [3, 10]) == pytest.approx(
        [path[3], path[10]]
    )
    better = info.exchanged(now, rows, goal, chosen)
    ends = info.criterion_path(now, rows, goal, better)
    assert len(better) == 8
    assert ends[-1] <= found[-1] * (1 + 1e-12)
    assert (np.diff(ends) < 0).all()


def test_greedy_stops_at_its_target():
    now, rows, goal = made_up(0)
    target = now.plus(rows).criterion(goal)
    chosen, found = info.greedy(now, rows, goal, 100, target)
    assert found[-1] <= target < found[-2]
    assert len(chosen) == len(found) - 1


# physics ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_long_run_is_worth_less_than_two_and_a_second_one_its_share():
    this, prior = planner(False, False), start(False, False)
    one, long = this.rows([DRIVES[0], replace(DRIVES[0], distance=1.4)]).motion
    once, twice, longer = (x.T @ x for x in (one, np.concatenate([one, one]), long))
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-12, atol=1e-12 * np.abs(once).max())
    shares = parameter_goal(this, "robot.load_share@as_built").rows
    after = [
        info.Information(prior.is_electric, prior.motion + x, prior.own, prior.cross)
        for x in (once, twice, longer)
    ]
    std = [np.sqrt(k.criterion(shares)) for k in after]
    assert std[1] < std[2] < std[0]
    # what a run's own effect hides stays hidden however long it is
    longer = [replace(DRIVES[0], distance=d) for d in (1e4, 1e5)]
    first, second = (x.T @ x for x in this.rows(longer).motion)
    std = this.space.prior_std
    size = np.abs(first * std * std[:, None]).max()
    np.testing.assert_allclose(
        second * std * std[:, None] / size, first * std * std[:, None] / size, atol=0.01
    )


@pytest.mark.slow
def test_scrub_needs_turning():
    """Along its axes of symmetry an even robot does not turn, so scrub has no effect."""
    even = eqx.tree_at(
        lambda r: (r.body.load_share, r.camera.marker_place),
        robot(),
        (jnp.full((2, 3), 1 / 3), jnp.zeros(2)),
    )
    this = Planner(even, CHOICES, planner(False, False).variance, Channels(False))
    offered = candidates(
        [SETUP], {"soft": (0.1, 0.2)}, {"soft": 0.7}, 0.125, [60.0 * k for k in range(6)]
    )
    straight = [d for d in offered if not d.turn]
    scrub, begin = parameter_goal(this, "surface.soft.scrub"), this.nothing()
    driven = begin.plus(this.rows(straight))
    assert len(straight) == 12
    assert scrub.std(driven) == pytest.approx(scrub.std(begin), rel=1e-6)
    assert scrub.std(driven.plus(this.rows(straight), info.UNLIMITED_REPEATS)) > 0.99 * scrub.std(
        begin
    )
    chosen, found = info.greedy(driven, this.rows(offered), scrub.rows, 4)
    assert all(offered[k].turn for k in chosen)
    assert found[-1] < 0.25 * found[0]
