"""R and C_e where ammeters are noisy: bias and coverage over made experiments of 480 runs each.

Currents that flow have a std of 0.1 A; a window's mean current is measured with 0.02 to 0.1 A.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from tests.benchmarks.quick import QUICK, quick
from tests.helpers import noisy_current as made

REPLICATES = quick(100, 2)


@pytest.mark.parametrize("ammeter", quick([0.02, 0.05, 0.1], [0.05]))
def test_the_motor_is_recovered_whatever_the_ammeter(ammeter):
    found = [made.fitted(made.experiment(seed, ammeter)) for seed in range(REPLICATES)]
    error, std = (np.array([getattr(f, name) for f in found]) for name in ("error", "std"))
    sure = 3 * error.std(axis=0) / np.sqrt(REPLICATES)
    inside = (np.abs(error) < 1.645 * std).mean(axis=0)
    for k, path in enumerate(made.MOTOR):
        print(
            f"{ammeter:5.2f} A {path:18} bias {100 * error[:, k].mean():6.2f} %, scatter "
            f"{100 * error[:, k].std():5.2f} %, claimed {100 * std[:, k].mean():5.2f} %, "
            f"90 % intervals hold {inside[k]:.3f}"
        )
    low, high = binom.ppf((0.0005, 0.9995), REPLICATES, 0.9) / REPLICATES
    assert QUICK or all(f.converged for f in found)
    assert QUICK or (np.abs(error.mean(axis=0)) < 0.005 + sure).all()
    assert QUICK or ((low <= inside) & (inside <= high)).all()
