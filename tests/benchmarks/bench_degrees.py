"""Does the number of degrees of the Student t matter? The joint fit of 2022 and left-out sectors.

    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_degrees.py

Four minutes per number of degrees; -k 8 asks for one. The log likelihood has the constants that
depend on the degrees, so that it can be compared; what runs share is integrated out.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.special import gammaln

from slipid.app.config import read_config
from slipid.app.problem import read_fit_task
from slipid.fitting.optimise import Optimum, optimise
from slipid.fitting.problem import Problem, without_effects
from slipid.predict import open_loop
from slipid.predict.folds import folds_of
from slipid.predict.predictive import force_balance_of
from slipid.predict.validation import ScoredRun, add_scores
from slipid.support.progress import Reporter
from tests.benchmarks.quick import QUICK, quick

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "robotino2022.toml"


def likelihood(problem: Problem, end: Optimum, degrees: float) -> dict[str, float]:
    """Log likelihood of the motion, what runs share integrated out, and of the currents."""
    keep, at = np.ones(len(problem.windows)), (end.state.z, end.state.log_variance)
    residual, _ = problem.linear(at[0], problem.electric(*at))
    effect = end.state.shared(len(keep))
    seen = problem.weighed(residual, at[1], keep, effect)
    out = {}
    for block, r in without_effects(problem.objective, residual, effect).items():
        one = {block: r}
        loss = float(problem.whitening(one, at[1], keep).loss)
        m = r.shape[1]
        norm = gammaln((degrees + m) / 2) - gammaln(degrees / 2)
        out[block] = len(keep) * (norm - 0.5 * m * np.log(degrees * np.pi)) - loss
    out["motion"] -= float(seen.loss - seen.whitening.loss)
    return out


@pytest.mark.parametrize("degrees", quick([4.0, 8.0, 16.0, 100.0], [8.0]))
def test_degrees(degrees: float, real_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, module in list(sys.modules.items()):
        if name.startswith("slipid.") and hasattr(module, "DEGREES"):
            monkeypatch.setattr(module, "DEGREES", degrees)
    jax.clear_caches()  # compiled functions have the degrees in them
    job = read_fit_task(read_config(CONFIG), real_data / "robotino2022", Reporter())
    problem, data = job.problem(), job.dataset
    end = optimise(problem)
    found = likelihood(problem, end, degrees)
    std = np.sqrt(np.diag(end.covariance))
    print(f"\n{degrees:g} degrees: log likelihood of {found}")
    for k, name in enumerate(problem.space.names):
        if name.endswith((".creep", ".roller_drag")) or "load_share" in name:
            print(f"  {name:30} {end.state.z[k]:8.4f} +- {std[k]:.4f} (search space)")
    fold = folds_of(data, "sectors", 6)
    rows: list[ScoredRun] = []
    for k in range(6):
        judged = np.flatnonzero(fold == k)
        keep = (~np.isin(problem.windows.run, judged)).astype(float)
        part = optimise(problem, keep=keep, start=replace(end.state, round=0))
        model = force_balance_of(problem, part.state, part.covariance, keep)
        runs: dict[int, ScoredRun] = {}
        some = data.subset(judged)
        for w in open_loop.replay_windows(some, model.robot):
            add_scores(runs, some, model.name, *model.ends(w))
        density = model.log_density(problem)
        for i, row in runs.items():
            told = float(density[problem.windows.run == judged[i]].sum())
            row.models[model.name] = replace(row.models[model.name], log_density=told)
        rows += runs.values()
    for name in sorted({(row.surface, row.load) for row in rows}):
        scores = [row.models["identified"] for row in rows if (row.surface, row.load) == name]
        print(
            f"  {'@'.join(name):16} end error "
            f"{100 * np.mean([s.endpoint_error for s in scores]):.2f} %, 90 % regions hold "
            f"{np.mean([bool(s.covered90) for s in scores]):.0%}, left-out log density "
            f"{np.mean([float(s.log_density or 0) for s in scores]):.2f} nats per run"
        )
    assert len(rows) == len(data)
    assert QUICK or end.converged
