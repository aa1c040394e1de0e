"""Public logs of real motors: slipid beside least squares, scipy and CasADi.

All are fitted to the first half of each record, and judged on the second one, simulated from the
voltage alone in runs of at most `WINDOW` rows. CasADi (3.8.2) is not a dependency:

    pip install --no-deps --target /tmp/casadi casadi==3.8.2
    PYTHONPATH=.:/tmp/casadi SLIPID_MOTOR_LOGS=/path/to/logs .venv/bin/python -m pytest -s \
        -o python_files='bench_*.py' tests/benchmarks/bench_public_motors.py

`tests/helpers/motor_logs.py` has the sources of the logs.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import pytest

from slipid.infer.bench.checks import check_records
from slipid.infer.bench.fit import fit_motor
from slipid.infer.bench.least_squares import RIVALS, least_squares
from slipid.infer.bench.motor import BenchMotor, BenchRecord
from slipid.infer.bench.open_loop import open_loop, values_of
from slipid.infer.bench.rows import Between, rows_of
from slipid.infer.bench.verdict import bench_fit
from slipid.infer.verdicts.estimates import Estimate
from slipid.support.errors import DataError
from tests.benchmarks.quick import QUICK, quick
from tests.benchmarks.record import Cell, record
from tests.helpers.motor_logs import MOTORS, PublicMotor
from tests.helpers.motor_rivals import LinearMotor, by_casadi, by_scipy

MILLI = 1e-3
WINDOW = 10_000
"""Largest number of rows of a simulation that is judged."""
SHOWN = {"least_squares": "least squares", "least_squares_with_offset": "same with offsets"}
"""Names in the table of slipid's own rivals."""
SOLVERS = {"scipy": by_scipy, **({"CasADi": by_casadi} if find_spec("casadi") else {})}
"""Names in the table of other fits of a linear motor with dry friction; CasADi if installed."""

Simulation = Callable[[BenchRecord], np.ndarray]
"""Function from a record to its simulated current and speed."""


@dataclass(frozen=True)
class Fitted:
    """A fit of a method.

    Attributes:
        method: name in the table.
        resistance, back_emf: numbers, lists with intervals for slipid [ohm], [V s/rad].
        inductance: same of the inductance, None if it is not fitted [mH].
        simulate: simulation with what was fitted.
        verdicts: verdicts on these numbers.
    """

    method: str
    resistance: Cell
    back_emf: Cell
    inductance: Cell
    simulate: Simulation
    verdicts: str = ""


def divided(records: Sequence[BenchRecord]) -> tuple[list[BenchRecord], list[BenchRecord]]:
    """Return the first halves of records, and windows of their second ones."""
    first, windows = [], []
    for r in records:
        middle, end = len(r.time) // 2, len(r.time)
        first.append(r.part(0, quick(middle, min(middle, 3000))))
        starts = range(middle, end - 1, WINDOW)
        windows += [r.part(k, min(k + WINDOW, end)) for k in quick(starts, starts[:1])]
    return first, windows


def errors(simulate: Simulation, windows: Sequence[BenchRecord]) -> tuple[float, float]:
    """Return the root mean square errors of speed [rad/s] and current [A]."""
    off = [simulate(r) - np.stack([r.current, r.speed]) for r in windows]
    current, speed = np.sqrt((np.concatenate(off, axis=1) ** 2).mean(axis=1))
    return float(speed), float(current)


def simulation(motor: BenchMotor, between: Between = "held") -> Simulation:
    """Return the simulation of a motor of slipid."""

    def simulated(r: BenchRecord) -> np.ndarray:
        rows = rows_of([r]).between(between)
        readings = open_loop(rows, values_of(motor), rows.start).readings[:, rows.used]
        # Simulated rows follow the first one, which is their start.
        return np.concatenate([[[r.current[0]], [r.speed[0]]], readings], axis=1)

    return simulated


def shown(value: float) -> float:
    return float(f"{value:.3g}")


def off_by(value: Cell, otherwise: float) -> str:
    """Return by how much a number, or the first one of an interval's list, is off."""
    middle = value[0] if isinstance(value, list) else value
    assert isinstance(middle, float)
    return f"{100 * (middle / otherwise - 1):+.1f} %"


def with_interval(e: Estimate, unit: float = 1.0) -> list[float]:
    """Return an estimate with its interval."""
    assert e.interval90 is not None
    return [shown(x / unit) for x in (e.value, *e.interval90)]


def fitted(motor: PublicMotor, first: Sequence[BenchRecord]) -> Iterator[Fitted]:
    """Yield the fits of all methods."""
    try:
        check_records(first, "")
        fit = fit_motor(first)
        found = bench_fit([fit])
        r, c, l = (found.parameters[f"motor.{k}"] for k in ("resistance", "back_emf", "inductance"))
        for e in found.parameters.values():
            print(f"{e.path} {e.value:.4g} {e.interval90} {e.verdict}")
        print(*found.messages, sep="\n")
        numbers = with_interval(r), with_interval(c), with_interval(l, MILLI)
        verdicts = ", ".join(e.verdict.replace("_", " ") for e in (r, c, l))
        yield Fitted("slipid", *numbers, simulation(fit.motor, fit.between), verdicts)
    except DataError as error:
        print(error)
    rows = rows_of(first).between("held")
    simple = {name: least_squares(rows, offset) for name, offset in RIVALS.items()}
    for name, m in simple.items():
        r, c = shown(float(m.resistance)), shown(float(m.back_emf))
        yield Fitted(SHOWN[name], r, c, None, simulation(m))
    start = LinearMotor.near(simple["least_squares"])
    for name, solve in SOLVERS.items():
        linear = solve(first, start)
        print(name, linear)
        numbers = linear.resistance, linear.back_emf, linear.inductance / MILLI
        yield Fitted(name, *map(shown, numbers), linear.simulated)


@pytest.mark.parametrize("motor", MOTORS, ids=lambda motor: motor.folder)
def test_second_halves_are_simulated_about_as_well_as_by_least_squares(motor: PublicMotor) -> None:
    if not motor.path.is_dir():
        pytest.skip(f"no {motor.path}; SLIPID_MOTOR_LOGS names the folder with the public logs")
    first, windows = divided(motor.records())
    inductance = None if motor.inductance is None else shown(motor.inductance / MILLI)
    otherwise: list[Cell] = [motor.resistance, "", motor.back_emf, "", inductance]
    table: list[list[Cell]] = [[motor.name, "measured otherwise", *otherwise, None, None, ""]]
    speeds: dict[str, float] = {}
    for f in fitted(motor, first):
        off = off_by(f.resistance, motor.resistance), off_by(f.back_emf, motor.back_emf)
        errs = [shown(e) for e in errors(f.simulate, windows)]
        numbers = f.resistance, off[0], f.back_emf, off[1], f.inductance
        table.append([motor.name, f.method, *numbers, *errs, f.verdicts])
        speeds[f.method] = errs[0]
        print(*table[-1], sep=", ")
    assert QUICK or speeds["slipid"] < 1.05 * min(speeds.values())
    record("public_motors", table, keys=2)
