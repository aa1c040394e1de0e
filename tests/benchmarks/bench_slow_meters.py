"""Ammeters and voltmeters that are read less often than the wheels: R and C_e of made logs.

    make bench
    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_slow_meters.py

(about seven minutes). Rows are 31 ms apart; a meter that is read in every 16th is read twice a
second. Prints how far R and C_e are from the truth, the std that was told, and their ratio. Asserts
that no number is more than 3.5 of its stds off.
"""

import pytest

from slipid.data.runs import collect
from slipid.lab.selftest.logs import SimulatedSensors, simulate_logs
from tests.benchmarks.quick import QUICK, quick
from tests.benchmarks.record import record
from tests.helpers.kinds import SHAPES, fitted, known, plan, wanted
from tests.helpers.slow_meters import held

EVERY = quick((1, 4, 16), (4,))
"""Rows from one reading of the meters to the next."""
SEEDS = quick((0, 1, 2), (0,))
SYMBOLS = {"motor.back_emf": "C_e", "motor.resistance": "R"}
"""Symbols of the identified constants."""
FINE = SimulatedSensors(ripple=0.005, current_step=0.002, voltage_step=0.005, signed=True)


@pytest.mark.parametrize("kind", quick(["differential", "skid"], ["differential"]))
def test_what_slow_meters_tell(kind):
    print(f"\n{kind}\n{'every':>6}{'seed':>6}{'number':>20}{'off':>9}{'std':>9}{'off / std':>11}")
    worst = 0.0
    errors: dict[tuple[int, str], list[tuple[float, float]]] = {}
    for seed in SEEDS:
        drives = plan(SHAPES[kind], 12)
        truth = known(SHAPES[kind], drives)
        logs = simulate_logs(truth, drives, seed, FINE)
        for rows in EVERY:
            data = collect([held(log, rows, 7 * k) for k, log in enumerate(logs)])
            fit = fitted(truth, data, wanted(truth, data))
            assert QUICK or fit.converged, fit.reason
            for name in SYMBOLS:
                (entry,) = (e for e in fit.space.free if e.path == name)
                true, found = float(entry.get(truth)), fit.parameters[name]
                off, std = float(found.value) / true - 1.0, float(found.std) / true
                print(f"{rows:6}{seed:6}{name:>20}{off:9.2%}{std:9.2%}{off / std:11.1f}")
                worst = max(worst, abs(off / std))
                errors.setdefault((rows, name), []).append((abs(off), std))
    for (rows, name), pairs in errors.items():
        largest, std = (round(100 * max(column), 2) for column in zip(*pairs, strict=True))
        record("slow_meters", [[kind, SYMBOLS[name], rows, largest, std]], keys=3)
    assert QUICK or worst < 3.5
