"""Chosen runs against as many of the 2021 paper's grid, on logs with known truth.

    PYTHONPATH=. pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_design.py

For one floor, from no run at all: 36 runs chosen one after another for load shares and end points,
and the 36 of the grid. Each plan is driven `SEEDS` times as whole logs (ticks, unsigned quantised
currents, repeated frames, ramps) and fitted from the staged start. The root mean square of the real
errors is compared with the std that was expected before anything was driven, and the ratio of the
plans' real errors with the expected ratio. Then the fewest chosen runs expected to do what the grid
does are driven, too.
"""

from __future__ import annotations

import time

import numpy as np
import pytest
from scipy.stats import chi2

from tests.benchmarks.quick import QUICK, quick
from tests.helpers import designs

SEEDS, WHOLE = quick((12, 36), (1, 8))
NAMES = ("load share", "end point")
FREE = 2
"""Least independent numbers behind each error: two shares, an end's two coordinates."""


def driven(drives, expected):
    """Real errors of every seed (seed, 2)."""
    began, found = time.perf_counter(), []
    for seed in range(SEEDS):
        z, converged = designs.fit_logs(drives, seed)
        assert QUICK or converged
        found.append(designs.errors(z))
    real = np.sqrt(np.mean(np.square(found), axis=0))
    for name, r, e in zip(NAMES, real, expected, strict=True):
        print(f"  {name}: expected {e:.5f}, real {r:.5f} ({r / e:.2f})")
    print(f"  {time.perf_counter() - began:.0f} s")
    return real


def within(ratio, expected=1.0):
    """Whether a ratio of rms errors is within chance of what was expected, two in a thousand."""
    low, high = np.sqrt(chi2.ppf([1e-3, 1 - 1e-3], FREE * SEEDS) / (FREE * SEEDS))
    return low < ratio / expected < high


@pytest.mark.slow
def test_chosen_runs_do_what_was_expected_of_them():
    plans = designs.plans(WHOLE)
    real = {}
    for name, drives in plans.drives.items():
        print(f"\n{len(drives)} runs, {name}")
        real[name] = driven(drives, plans.expected[name])
    for k, name in enumerate(NAMES):
        gain = real["grid"][k] / real["chosen"][k]
        hoped = plans.expected["grid"][k] / plans.expected["chosen"][k]
        print(f"{name}: the grid's error is {gain:.2f} times as large, expected {hoped:.2f}")
        assert QUICK or gain > 1.0
    few = (n for n in range(4, WHOLE) if better(designs.plans(n), plans))
    fewer = next(few, WHOLE)
    assert QUICK or fewer < WHOLE
    print(f"\n{fewer} chosen runs are expected to do what {WHOLE} of the grid do")
    again = designs.plans(fewer)
    short = driven(again.drives["chosen"], again.expected["chosen"])
    for k, name in enumerate(NAMES):
        print(f"{name}: {short[k] / real['grid'][k]:.2f} of the grid's real error")
        for plan, found in (
            (plans.expected["chosen"], real["chosen"]),
            (plans.expected["grid"], real["grid"]),
        ):
            assert QUICK or within(found[k] / plan[k])
        assert QUICK or within(short[k] / again.expected["chosen"][k])
        # both sides scatter by chance
        assert QUICK or short[k] / real["grid"][k] < 1.5


def better(plan, whole):
    """Whether the chosen runs of a plan are expected to beat the whole grid in both."""
    return all(a <= b for a, b in zip(plan.expected["chosen"], whole.expected["grid"], strict=True))
