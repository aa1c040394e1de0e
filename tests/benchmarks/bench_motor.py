"""A motor on a bench: bias, scatter and coverage over made logs of the test site's motor.

Seeds change the noise and where rows fall between the steps of the voltage.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from slipid.infer.bench.fit import fit_motor
from slipid.infer.bench.verdict import bench_fit
from tests.benchmarks.quick import QUICK, quick
from tests.benchmarks.record import record
from tests.helpers import made_bench as made

SEEDS = quick(20, 1)
CASES = quick(
    [
        *((made.FLYWHEEL, rate, 0.0) for rate in (50, 100, 200, 500, 1000, 2000)),
        (made.FLYWHEEL, 500, 0.6),
        *((made.ROTOR, rate, 0.0) for rate in (100, 500, 1000, 2000)),
    ],
    [(made.FLYWHEEL, 100, 0.6)],
)

SHOWN = "resistance", "back_emf", "rotor_inertia", "coulomb_friction"
"""Numbers in the documentation's table, in the order of its columns."""


@pytest.mark.parametrize(("inertia", "rate", "drop"), CASES)
def test_intervals_hold_the_truth(inertia, rate, drop):
    rows, known = made.driven(inertia, drop=drop), made.truth(inertia, drop)
    fits = [bench_fit([fit_motor([made.logged(rows, rate, k)])]) for k in range(SEEDS)]
    low = binom.ppf(0.001, SEEDS, 0.9) / SEEDS
    print(f"\n{inertia:g} kg m^2, {rate} rows/s, brushes {drop} V")
    cells = {}
    for path, true in known.items():
        found = [f.parameters[path] for f in fits]
        value = np.array([e.value for e in found])
        inside = np.mean([e.interval90[0] <= true <= e.interval90[1] for e in found])
        claimed = np.mean([e.verdict == "identified" for e in found])
        percent = 100 / (abs(true) or 1.0)
        said = np.mean([e.std for e in found])
        print(
            f"  {path:24} bias {percent * (value.mean() - true):7.2f} %, "
            f"scatter {percent * value.std():6.2f} %, said {percent * said:6.2f} %, "
            f"90 % intervals hold {inside:.2f}, identified {claimed:.2f}"
        )
        cells[path] = f"{percent * value.std():.2g} % ({inside:.2f})"
        if claimed < 0.5:
            cells[path] = "not identified"
        # of what is called identified, intervals hold the truth
        assert QUICK or claimed < 0.5 or inside >= low, path
    load = "flywheel" if inertia == made.FLYWHEEL else "none"
    shown = [cells[f"motor.{name}"] for name in SHOWN]
    record("motor_bench", [[load + (f", brushes {drop} V" if drop else ""), rate, *shown]], keys=2)
    assert QUICK or all(f.converged for f in fits)
    assert QUICK or np.mean([f.good for f in fits]) >= 0.9
