"""A short chain of the sampler and the draws beside it equal reviewed numbers."""

from __future__ import annotations

import numpy as np
import pytest

from slipid.infer.posterior import sample as posterior
from slipid.infer.posterior.blocks import Plan
from slipid.support.progress import Reporter
from tests.helpers import calibration
from tests.helpers.memory import Memory

PLAN = Plan(ensembles=2, walkers=6, block=4, warm_up=(1, 2), most=3)


@pytest.mark.slow
def test_a_short_chain(golden):
    """Long chains amplify rounding, these few steps do not."""
    fit, _ = calibration.experiment(3)
    kept = Memory()
    found = posterior.sampled(fit, PLAN, 10, kept, Reporter(quiet=True))
    rows = []
    for part, block in kept.blocks:
        last = np.asarray(block.chain)[:, -1].mean(axis=1)
        for ensemble, mean in enumerate(last):
            rows.append(
                {
                    "part": part,
                    "block": block.number,
                    "ensemble": ensemble,
                    "log_prob": float(block.log_prob[ensemble, -1].mean()),
                    "accepted": float(block.accepted[ensemble]),
                }
                | {f"x{k}": float(v) for k, v in enumerate(mean[:12])}
            )
    golden("chain", rows, rtol=1e-4, atol=1e-5)
    of_electric = found.z[..., fit.space.electric].mean(axis=1)
    beside = {"electric": of_electric, "variance": found.log_variance.mean(axis=1)}
    golden(
        "chain_beside",
        [
            {"part": part, "ensemble": ensemble, "number": k, "mean": float(value)}
            for part, means in beside.items()
            for ensemble, mean in enumerate(means)
            for k, value in enumerate(mean)
        ],
        rtol=1e-4,
        atol=1e-5,
    )
