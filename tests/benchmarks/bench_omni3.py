"""Long closed paths of another omni robot: sizes of its wheels and base, and what they predict.

    make bench
    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_omni3.py

(about a minute a case). Fitted to the runs by joystick and judged on squares and circles, and
fitted to squares and judged on the others. Prints mean errors of the end in millimetres and over
the path; a closed path has no displacement that a share of would mean anything. Asserts that
slipid is ahead of least squares of a radius per wheel, base radius, lag and marker place on the
same runs, whose errors stand beside each case.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from slipid.predict.validation import Validation
from tests.benchmarks.quick import QUICK
from tests.benchmarks.record import record
from tests.helpers.held_back import held_back

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "omni3.toml"


@dataclass(frozen=True)
class Case:
    """What is in the names of fitted and of judged runs, and the error of least squares [mm]."""

    fitted: tuple[str, ...]
    judged: tuple[str, ...]
    least_squares_mm: float


CASES = {
    "runs by joystick": Case(("joystick",), ("square", "circular"), 50.5),
    "squares": Case(("square",), ("joystick", "circular"), 92.3),
}


SHOWN = {
    "selected": "selected by slipid",
    "identified": "force balance",
    "calibrated": "calibrated kinematics",
    "encoder": "no slip, with the sizes that slipid fitted",
    "nominal": "nominal sizes",
}
"""Models in the table of results, with their labels."""


def errors_mm(found: Validation, model: str) -> np.ndarray:
    return np.array([1e3 * run.chord * run.models[model].endpoint_error for run in found.runs])


@pytest.mark.parametrize("name", CASES)
def test_ends_of_closed_paths(name: str, real_data: Path, tmp_path: Path) -> None:
    case = CASES[name]
    text = CONFIG.read_text().partition("# `slipid validate` predicts")[0]
    every = tmp_path / "omni3.toml"
    every.write_text(text.replace('glob = "joystick/*/*_run', 'glob = "*/*/*_run'))
    found = held_back(every, real_data / "omni3_optitrack", case.fitted, case.judged)
    print(f"\nfitted to {name}, {len(found.runs)} others; least squares {case.least_squares_mm} mm")
    path = np.array([run.path for run in found.runs])
    for model in found.runs[0].models:
        off = errors_mm(found, model)
        mean, share = off.mean(), 100 * np.mean(1e-3 * off / path)
        print(f"{model:24}{mean:8.1f} mm{share:8.2f} % of the path")
        if model in SHOWN:
            row = [name, SHOWN[model], round(mean, 1), round(share, 2)]
            record("omni3", [row], keys=2)
    squares = [name, "least squares on the same runs", case.least_squares_mm, None]
    record("omni3", [squares], keys=2)
    mine = errors_mm(found, "identified").mean()
    assert QUICK or mine < case.least_squares_mm
    assert QUICK or mine < errors_mm(found, "encoder").mean() < errors_mm(found, "nominal").mean()
