"""Floors that disagree about the loads are named, those that agree up to noise are not.

The smallest difference that is reported with a given probability is compared with simulations.
"""

from __future__ import annotations

import json
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, norm

from slipid.fitting.optimise import optimise
from slipid.fitting.problem import Problem
from slipid.infer.verdicts.disputed import LoadComparison, load_comparisons, marked, sensitivity
from slipid.infer.verdicts.estimates import estimates
from slipid.parameter import share_basis
from slipid.search_space import Choice
from tests.helpers.made_windows import made, robot

CHOICES = (
    Choice("*", free=False),
    Choice("surface.*.creep", free=True),
    Choice("robot.load_share@*", free=True),
    Choice("surface.*.load_bias", free=True),
)
STD = {
    "camera.place": 0.0005,
    "camera.heading": 0.003,
    **{f"process.{axis}": 0.002 for axis in ("along", "across", "yaw")},
    **{f"run.{axis}": 0.003 for axis in ("along", "across", "yaw")},
}


def problem_of(truth, runs=96):
    w = made(truth, runs=runs, std=STD)
    return Problem(replace(w, has_current=False, has_voltage=False), robot(), CHOICES)


def disputes(space, z, covariance):
    """Return the standard errors of pairs of floors that disagree."""
    found = load_comparisons(space, z, covariance)
    return {one.floors: one.standard_errors for one in found if one.disputed}


@pytest.fixture(scope="module")
def problem():
    return problem_of(robot(), runs=24)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1.0, 4.0])
def test_sigma_is_that_of_the_likelihood_alone(problem, size):
    """Estimates of floors are combined with the prior by Bayes' theorem, and separated again."""
    space, rng, pooled = problem.space, np.random.default_rng(1), 0.03**2
    root = 40 * rng.normal(size=(space.size, space.size))
    own = root @ root.T + np.eye(space.size)  # information, wide priors of the biases included
    alone = 0.05 * size * rng.normal(size=space.size)  # what the data would say by themselves
    at = np.flatnonzero(problem.space.pooled)
    precision = own.copy()
    precision[at, at] += 1 / pooled - 1.0
    # the prior of the biases is around zero, that of all others in what the data say
    z = np.linalg.solve(precision, own @ alone)
    one, other = (space.slices[f"surface.{floor}.load_bias"] for floor in ("firm", "soft"))
    gap = alone[one] - alone[other]
    cov = np.linalg.inv(own)
    spread = cov[one, one] + cov[other, other] - cov[one, other] - cov[other, one]
    chance = chi2.sf(gap @ np.linalg.solve(spread, gap), 2)
    found = disputes(space.with_pooled(np.sqrt(pooled)), z, np.linalg.inv(precision))
    assert list(found) == [("firm", "soft")] * int(chance < 0.01)
    if found:
        assert found["firm", "soft"] == pytest.approx(norm.isf(chance / 2), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("bias", [0.0, 0.12])
def test_a_floor_with_another_law_is_named(bias):
    truth = robot()
    own = jnp.asarray([[0.0, 0.0, 0.0], [bias, -0.5 * bias, -0.5 * bias]])
    truth = eqx.tree_at(lambda r: r.surfaces.load_bias, truth, own)
    problem = problem_of(truth)
    end = optimise(problem)
    pooled = np.exp(end.state.log_variance[problem.objective.pooled])
    space = problem.space.with_pooled(np.sqrt(pooled))
    (found,) = load_comparisons(space, end.state.z, end.covariance)
    assert found.floors == ("firm", "soft")
    assert found.disputed == (bias > 0)
    if bias:
        assert max(found.smallest) < 1.5 * bias  # the difference of the first wheel's load


def test_a_difference_of_the_stated_size_is_found_in_four_of_five_fits(problem):
    """Data of which the likelihood knows the true biases up to noise of known covariance."""
    space, rng, pooled = problem.space, np.random.default_rng(2), 0.03**2
    root = 40 * rng.normal(size=(space.size, space.size))
    own = root @ root.T + np.eye(space.size)  # information, wide priors of the biases included
    precision, at = own.copy(), np.flatnonzero(space.pooled)
    precision[at, at] += 1 / pooled - 1.0
    covariance, fitted = np.linalg.inv(precision), space.with_pooled(np.sqrt(pooled))
    one, other = (space.slices[f"surface.{floor}.load_bias"] for floor in ("firm", "soft"))
    (about,) = load_comparisons(fitted, np.zeros(space.size), covariance)
    noise = np.linalg.cholesky(np.linalg.inv(own))
    spread = np.linalg.inv(own)
    spread = spread[one] - spread[other]
    spread = spread[:, one] - spread[:, other]

    def found(gap):
        """Return the fraction of fits that report a true difference of the biases."""
        truth = np.zeros(space.size)
        truth[one] = gap
        every = truth + rng.standard_normal((500, space.size)) @ noise.T
        z = np.linalg.solve(precision, own @ every.T).T
        return np.mean([load_comparisons(fitted, row, covariance)[0].disputed for row in z])

    for wheel, smallest in zip(share_basis(3), about.smallest, strict=True):
        worst = smallest * spread @ wheel / (wheel @ spread @ wheel)
        assert worst @ wheel == pytest.approx(smallest)
        assert found(worst) == pytest.approx(0.8, abs=0.05)
        alone = smallest * wheel / (wheel @ wheel)
        assert alone @ wheel == pytest.approx(smallest)
        assert found(alone) >= 0.75
    assert found(np.zeros(2)) < 0.03


def test_the_sentence_separates_what_was_seen_from_what_could_not_be():
    seen = LoadComparison(("gray", "green"), 1.7, (0.052, 0.101, 0.052))
    unseen = LoadComparison(("gray", "table"), 1.3, (0.501, 0.868, 0.514))
    assert sensitivity([seen, unseen]) == (
        "a wheel's load that differed by 5 % between gray and green would have been reported as "
        "disputed with a probability of 80 %; the comparison of loads says nothing where only "
        "larger differences would have been reported: between gray and table (50 %)"
    )
    assert sensitivity([unseen]).startswith("the comparison of loads says nothing where")
    assert sensitivity([seen] * 8).count("5 %") == 6
    assert not sensitivity([])
    assert not seen.disputed
    assert replace(seen, standard_errors=2.6).disputed
    assert LoadComparison.of_json(json.loads(json.dumps(seen.to_json()))) == seen


@pytest.mark.slow
def test_only_loads_that_were_identified_are_disputed(problem):
    space = problem.space
    tight = np.diag(np.full(space.size, 1e-4))
    numbers = {
        e.path: e for e in estimates(space, CHOICES, space.start, tight, has_voltage=False, flat=())
    }
    found = marked(numbers, {("firm", "soft"): 3.2})
    for path, e in found.items():
        loads = path.startswith("robot.load_share")
        assert e.verdict == ("disputed" if loads else numbers[path].verdict)
    assert marked(numbers, {}) == numbers
    weak = {path: replace(e, verdict="weak") for path, e in numbers.items()}
    assert marked(weak, {("firm", "soft"): 3.2}) == weak
