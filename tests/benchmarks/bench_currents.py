"""Does a drag along the drive, which motors bear, predict the currents of left-out sectors better?

    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_currents.py

Currents do not move the numbers of the motion, so these are those of one fit of all runs; the
electric numbers and the scatter of currents are found without a sector, whose currents are then
judged given the motion. Prints gains in log density with standard errors clustered by sector.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slipid.app.config import read_config
from slipid.app.problem import ConfigFitTask, read_fit_task
from slipid.fitting.optimise import optimise
from slipid.predict.folds import folds_of
from slipid.predict.predictive import log_student
from slipid.search_space import Choice
from slipid.support.progress import Reporter
from tests.benchmarks.quick import QUICK

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "robotino2022.toml"
WITHOUT = Choice("motor.rolling_drag", fixed=0.0)


@pytest.fixture(scope="module")
def job(real_data: Path) -> ConfigFitTask:
    return read_fit_task(read_config(CONFIG), real_data / "robotino2022", Reporter())


def densities(job: ConfigFitTask) -> np.ndarray:
    """Log density of the currents of every run, given motion, from fits without its sector."""
    problem, fold = job.problem(), folds_of(job.dataset, "sectors", 6)[job.problem().windows.run]
    end = optimise(problem)
    out, free = np.zeros(len(fold)), problem.space.electric.astype(float)
    for k in range(6):
        part = optimise(
            problem, (fold != k).astype(float), replace(end.state, round=3), 10, free=free
        )
        at = part.state.z, part.state.log_variance
        gap = np.asarray(problem.linear(at[0], problem.electric(*at))[0]["current"])
        density = log_student(gap, np.asarray(problem.covariance("current", at[1])))
        out[fold == k] = density[fold == k]
    if "motor.rolling_drag" in problem.space.names:
        where = problem.space.slices["motor.rolling_drag"]
        std = np.sqrt(np.diag(end.covariance))[where]
        print(f"\ndrag along the drive {end.state.z[where]} +- {std}, in that of the rollers")
    return out


def test_drag_along_the_drive(job: ConfigFitTask) -> None:
    without = densities(replace(job, choices=(*job.choices, WITHOUT)))
    gain = densities(job) - without
    w, fold = job.problem().windows, folds_of(job.dataset, "sectors", 6)
    name, sector = np.array(list(zip(w.surface, w.load, strict=True))), fold[w.run]
    for of in np.unique(name, axis=0):
        mine = (name == of).all(axis=1)
        off = gain[mine] - gain[mine].mean()
        sums = np.array([off[sector[mine] == k].sum() for k in np.unique(sector[mine])])
        error = np.sqrt((sums**2).sum() * len(sums) / (len(sums) - 1)) / mine.sum()
        print(f"  {'@'.join(of):16} {gain[mine].mean():+.2f} +- {error:.2f} nats per run")
        assert QUICK or gain[mine].mean() > 0
