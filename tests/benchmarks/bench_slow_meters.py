"""Ammeters and voltmeters that are read less often than the wheels: R and C_e of made logs.

    make bench
    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_slow_meters.py

(about seven minutes). Rows are 31 ms apart; a meter that is read in every 16th is read twice a
second. Prints how far R and C_e are from the truth, the std that was told, and their ratio. Asserts
that no number is more than 3.5 of its stds off.
"""

from dataclasses import replace

import numpy as np
import pytest

from slipid.data.log import Log
from slipid.data.runs import collect
from slipid.data.windows import windows
from slipid.identify.fit.optimise import optimise
from slipid.identify.fit.problem import Problem
from slipid.identify.result import summarise
from slipid.model.robot import Robot, build
from slipid.selftest.known import Sensors
from slipid.selftest.logs import make_logs
from tests.helpers.kinds import SHAPES, known, plan, wanted

EVERY = (1, 4, 16)
"""Rows from one reading of the meters to the next."""
SEEDS = (0, 1, 2)
FINE = Sensors(ripple=0.005, current_step=0.002, voltage_step=0.005, signed=True)


def held(log: Log, rows: int, first: int) -> Log:
    """The log, had its meters been read once in so many rows and held in between."""
    number = np.arange(log.samples)
    read = number % rows == first % rows
    read[0] = True
    last = np.maximum.accumulate(np.where(read, number, 0))
    fresh = np.repeat(read[:, None], log.wheel_angle.shape[1], axis=1)
    kept = {"current": log.current[last], "voltage": log.voltage[last]}
    return replace(log, **kept, current_fresh=fresh, voltage_fresh=fresh)


def fitted(truth: Robot, logs: list[Log]):
    data = collect(logs)
    choices = wanted(truth, data)
    labels = truth.surfaces.labels, truth.body.loads, truth.camera.sessions
    radius, lag = float(truth.geometry.wheel_radius), float(truth.camera.lag)
    w = windows(data, radius, lag, longest=2.0)
    problem = Problem(w, build(truth.geometry, *labels), list(choices))
    return summarise(problem, optimise(problem), data, choices)


@pytest.mark.parametrize("kind", ["differential", "skid"])
def test_what_slow_meters_tell(kind):
    print(f"\n{kind}\n{'every':>6}{'seed':>6}{'number':>20}{'off':>9}{'std':>9}{'off / std':>11}")
    worst = 0.0
    for seed in SEEDS:
        drives = plan(SHAPES[kind], 12)
        truth = known(SHAPES[kind], drives)
        logs = make_logs(truth, drives, seed, FINE)
        for rows in EVERY:
            fit = fitted(truth, [held(log, rows, 7 * k) for k, log in enumerate(logs)])
            assert fit.converged, fit.reason
            for name in ("motor.back_emf", "motor.resistance"):
                (entry,) = (e for e in fit.space.free if e.path == name)
                true, found = float(entry.get(truth)), fit.parameters[name]
                off, std = float(found.value) / true - 1.0, float(found.std) / true
                print(f"{rows:6}{seed:6}{name:>20}{off:9.2%}{std:9.2%}{off / std:11.1f}")
                worst = max(worst, abs(off / std))
    assert worst < 3.5
