"""Intervals and ranks over a few made experiments; `benchmarks/bench_calibration.py` has many."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

from slipid.identify.posterior import sample as posterior
from slipid.identify.posterior.blocks import Plan, Record
from slipid.identify.posterior.coordinates import MOTION
from slipid.identify.posterior.sample import unsettled
from tests.helpers import calibration

SEEDS = (1, 4)


@pytest.fixture(scope="module")
def replicates():
    return {seed: calibration.replicate(seed) for seed in SEEDS}


@pytest.mark.nightly
def test_intervals_hold_the_truth_as_often_as_they_say(replicates):
    inside = np.concatenate([r.inside for r in replicates.values()])
    rank = np.concatenate([r.rank for r in replicates.values()])
    low, high = calibration.band(len(inside), 1)
    assert low <= inside.mean() <= high
    # four standard errors of the mean of uniform ranks
    assert rank.mean() == pytest.approx(0.5, abs=4 / np.sqrt(12 * len(rank)))


@pytest.mark.nightly
def test_a_variance_that_may_be_anything_small_is_not_held_near_the_fit(replicates):
    """In experiments 1 and 4 the ammeter hides the voltmeter's noise, whose truth is tiny."""
    place = replicates[1].names.index("noise.voltage.window")
    for k in (1, 4):
        assert replicates[k].rank[place] > 0.02
        assert replicates[k].draws[..., place].std() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("count", [7, 8])
def test_the_second_stage_goes_on_from_any_block_as_if_it_had_not_ended(whole, count):
    experiment, plan, blocks, found = whole
    kept = {part: b if part == MOTION else b[:count] for part, b in blocks.items()}
    again = posterior.sample(
        *experiment, plan, draws=10, record=Record(done=lambda part: kept[part])
    )
    np.testing.assert_array_equal(again.z, found.z)
    np.testing.assert_array_equal(again.log_variance, found.log_variance)
    assert again.unsettled == found.unsettled


@pytest.mark.slow
def test_a_longer_first_stage_begins_the_second_anew(whole):
    """Electric draws are of the very draws of the motion they were made with."""
    experiment, plan, blocks, _ = whole
    longer = replace(plan, most=plan.most + 1)
    anew = posterior.sample(*experiment, longer, draws=10)
    again = posterior.sample(
        *experiment, longer, draws=10, record=Record(done=lambda part: blocks.get(part, ()))
    )
    np.testing.assert_array_equal(again.z, anew.z)


@pytest.fixture(scope="module")
def whole():
    """An experiment, and a posterior of it whose second stage needs more than the fewest blocks."""
    *experiment, _ = calibration.experiment(12)
    plan = Plan(ensembles=2, walkers=8, block=5, warm_up=(1, 2), most=3)
    blocks = defaultdict(list)
    found = posterior.sample(
        *experiment,
        plan,
        draws=10,
        record=Record(keep=lambda part, block: blocks[part].append(block)),
    )
    assert max(map(len, blocks.values())) > 8
    return experiment, plan, blocks, found


def test_walkers_that_drift_or_remember_have_not_settled():
    rng = np.random.default_rng(0)
    free = rng.normal(size=(4, 40, 50, 3))
    assert (unsettled(free) < 1).all()
    stuck, drifting = free.copy(), free.copy()
    stuck[..., 1] = stuck[:, :1, :, 1]
    drifting[..., 2] += np.linspace(0, 2, 40)[:, None]
    assert (unsettled(stuck) > 1).tolist() == [False, True, False]
    assert (unsettled(drifting) > 1).tolist() == [False, False, True]
