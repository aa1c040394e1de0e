"""Intervals and ranks over a few simulated experiments; `bench_calibration.py` has many."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slipid.infer.posterior import sample as posterior
from slipid.infer.posterior.blocks import Plan
from slipid.infer.posterior.coordinates import MOTION, Fitted
from slipid.infer.posterior.variance_draws import drawn_variances
from slipid.support.progress import Reporter
from tests.helpers import calibration
from tests.helpers.kept import kept
from tests.helpers.memory import Memory

SEEDS = range(1000, 1012)
UNDETERMINED = 45
"""Experiment in which the ammeter hides the noise of the voltmeter."""
QUIET = Reporter(quiet=True)


@pytest.fixture(scope="module")
def replicates():
    return {seed: calibration.replicate(seed) for seed in SEEDS}


@pytest.mark.nightly
def test_intervals_contain_the_truth_as_often_as_stated(replicates):
    """Errors of one experiment depend on each other, so that experiments are what is counted."""
    inside = np.array([r.inside.mean() for r in replicates.values()])
    rank = np.array([r.rank.mean() for r in replicates.values()])
    error = 3 / np.sqrt(len(SEEDS))
    assert inside.mean() == pytest.approx(0.9, abs=error * inside.std(ddof=1))
    assert rank.mean() == pytest.approx(0.5, abs=error * rank.std(ddof=1))
    assert error * inside.std(ddof=1) < 0.1


@pytest.mark.slow
def test_a_small_undetermined_variance_is_not_kept_near_the_fit():
    fit, truth = calibration.experiment(UNDETERMINED)
    fitted, names = Fitted.of(fit), fit.problem.noise.names
    place = names.index("voltage.window")
    drawn = drawn_variances(fit.problem, fitted, (2, 400), 0)[..., place]
    low, high = np.quantile(drawn, [0.05, 0.95])
    assert low < truth[fit.space.size + place] < high
    assert drawn.std() > 0.9
    assert low < fitted.log_variance[place] - 2


@pytest.mark.slow
@pytest.mark.parametrize("count", kept([1, 3], [1]))
def test_sampling_continues_from_any_block(whole, count):
    """Electric numbers and variances, drawn after the last block, are the same as well."""
    fit, plan, blocks, found = whole
    again = posterior.sampled(fit, plan, 10, blocks.first(count), QUIET)
    np.testing.assert_array_equal(again.z, found.z)
    np.testing.assert_array_equal(again.log_variance, found.log_variance)
    assert again.accepted == found.accepted


@pytest.mark.slow
def test_electric_numbers_are_drawn_anew_for_a_longer_chain(whole):
    """Electric draws belong to the draws of the motion that they are conditioned on."""
    fit, plan, blocks, found = whole
    longer = replace(plan, most=plan.most + 1)
    anew = posterior.sampled(fit, longer, 10, None, QUIET)
    again = posterior.sampled(fit, longer, 10, blocks.first(plan.most), QUIET)
    np.testing.assert_array_equal(again.z, anew.z)
    electric = fit.space.electric
    assert (again.z[..., electric] != found.z[..., electric]).any()


@pytest.mark.slow
def test_electric_draws_with_few_accepted_proposals_prevent_convergence(whole, monkeypatch):
    fit, plan, blocks, _ = whole
    diagnose = posterior.diagnosis.diagnose
    monkeypatch.setattr(
        posterior.diagnosis,
        "diagnose",
        lambda chain, plan: replace(diagnose(chain, plan), converged=True),
    )
    assert posterior.sampled(fit, plan, 10, blocks, QUIET).converged
    drawn = posterior.electric_given_motion

    def half_still(*given):
        x, moved = drawn(*given)
        return x, np.where(np.arange(len(moved))[:, None] % 2, moved, False)

    monkeypatch.setattr(posterior, "electric_given_motion", half_still)
    found = posterior.sampled(fit, plan, 10, blocks, QUIET)
    assert not found.converged
    assert found.reason == (
        "50.0 % of the electric draws, which accepted less than 5 % of their proposals"
    )


@pytest.mark.slow
def test_uncertain_variances_widen_draws_of_the_motion_and_what_is_drawn_given_it(
    whole, monkeypatch
):
    """Electric draws are given the widened motion, and widened themselves."""
    fit, plan, blocks, _ = whole
    motion, drawn, given = ~fit.space.electric, posterior.electric_given_motion, []

    def spied(first, second, covariance, x, *more):
        given.append((x, drawn(first, second, covariance, x, *more)))
        return given[-1][1]

    monkeypatch.setattr(posterior, "electric_given_motion", spied)
    found = []
    for size in (0.0, 1e-6):
        added = size * np.diag(np.where(motion, 1.0, 4.0))
        monkeypatch.setattr(posterior, "added_covariance", lambda *_, added=added: added)
        found.append(posterior.sampled(fit, plan, 400, blocks, QUIET))
    off = (found[1].z - found[0].z)[..., motion]
    np.testing.assert_allclose(off.std(axis=(0, 1)), 1e-3, rtol=0.12)
    assert np.abs(np.corrcoef(off.reshape(800, -1).T) - np.eye(motion.sum())).max() < 0.2
    for one, (x, _) in zip(found, given, strict=True):
        np.testing.assert_array_equal(one.z[..., motion], x)
    before, after = (
        one.z[..., ~motion] - electric for one, (_, (electric, _)) in zip(found, given, strict=True)
    )
    assert not before.any()
    np.testing.assert_allclose(after.std(axis=(0, 1)), 2e-3, rtol=0.12)
    np.testing.assert_array_equal(found[0].log_prob, found[1].log_prob)


@pytest.fixture(scope="module")
def whole():
    """Yield an experiment, with blocks and draws of its posterior; few sweeps draw variances."""
    fit, _ = calibration.experiment(12)
    plan = Plan(ensembles=2, walkers=6, block=5, warm_up=(1, 2), most=4, rows=200)
    blocks = Memory()
    with pytest.MonkeyPatch.context() as patch:
        for number in ("_LEAST_SWEEPS", "_STATES"):
            patch.setattr(f"slipid.infer.posterior.variance_draws.{number}", 10)
        found = posterior.sampled(fit, plan, 10, blocks, QUIET)
        assert [part for part, _ in blocks.blocks] == [MOTION] * 4
        yield fit, plan, blocks, found


def test_an_interrupt_stops_the_draws_of_variances_too(whole, monkeypatch):
    fit, plan, _, _ = whole
    stopped = []

    def waits(*_, stop):
        stopped.append(stop.wait(60))

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(posterior, "drawn_variances", waits)
    monkeypatch.setattr(posterior.ensemble, "extended", interrupted)
    with pytest.raises(KeyboardInterrupt):
        posterior.sampled(fit, plan, 10, None, QUIET)
    assert stopped == [True]
