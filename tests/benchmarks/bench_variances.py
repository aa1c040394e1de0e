"""Draws of the variances of a fit: time, effective draws, and what they would do to intervals.

    SLIPID_FIT=out/2022 .venv/bin/python -m pytest -s -o python_files='bench_*.py' \\
        tests/benchmarks/bench_variances.py

The chain has the variances of the fit. With variances that are drawn, the covariance of the
parameters is E[cov | v] + Cov(mean | v) (Kass and Steffey 1989, Journal of the American Statistical
Association 84(407)), of which `slipid sample` adds the excess to its draws; here it stands beside
the covariance at the fit.
"""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import islice

import numpy as np
from arviz_stats.base import array_stats

from slipid.app.config import read_config
from slipid.app.logs import log_folder
from slipid.app.problem import read_fit_task
from slipid.infer.fit_file import load
from slipid.infer.posterior.coordinates import Fitted
from slipid.infer.posterior.variance_draws import (
    conditional,
    drawn_variances,
    floor_runs,
    weights_at,
)
from slipid.infer.posterior.variance_draws import sweeps as sweeps_of
from slipid.infer.posterior.variance_likelihood import linear_parts
from slipid.support.progress import Reporter
from tests.benchmarks.quick import QUICK, quick

SHAPE = quick((4, 400), (2, 20))
USED = quick(240, 10)
"""Number of draws of variances for which covariances are computed."""
MOST_SECONDS = 60.0
"""Largest time of a core for all draws [s]."""


def test_variance_draws(fit_folder):
    fit = load(fit_folder)
    task = read_fit_task(
        read_config(fit_folder / "config.toml"),
        log_folder(fit_folder, None),
        Reporter(quiet=True),
    )
    problem = replace(task, choices=fit.choices).problem(fit.robot)
    fitted = Fitted.of(replace(fit, problem=problem))
    began, cpu = time.perf_counter(), time.process_time()
    draws = drawn_variances(problem, fitted, SHAPE, 0)
    took, cpu = time.perf_counter() - began, time.process_time() - cpu
    print(f"\n{SHAPE} draws of {draws.shape[-1]} variances: {took:.0f} s, {cpu:.0f} s of a core")
    weight = weights_at(problem, fitted)
    some = draws.reshape(-1, draws.shape[-1])
    some = some[np.linspace(0, len(some) - 1, USED).astype(int)]
    for part in linear_parts(problem, fitted):
        chains = islice(sweeps_of(part, fitted.log_variance, 4, 40, np.random.default_rng(1)), 140)
        chain = np.stack([at.log_variance for at in chains][40:], axis=1)
        effective = [
            array_stats.ess(chain[..., k], chain_axis=0, draw_axis=1) for k in part.numbers
        ]
        print(f"effective of 400: least {min(effective):.0f}, median {np.median(effective):.0f}")
        electric = problem.space.electric
        mine = electric if part.given.any() else ~electric
        ratio = wider(part, weight, fitted.log_variance, some)[mine]
        print(
            f"stds of {mine.sum()} parameters with drawn variances, over those with fitted ones: "
            f"median {np.median(ratio):.3f}, {np.mean(ratio > 1.03):.0%} above 1.03"
        )
        names = np.asarray(problem.space.names)[mine]
        for k in np.argsort(-ratio)[:20]:
            print(f"  {names[k]:48}{ratio[k]:7.3f}")
        assert np.isfinite(ratio).all()
    assert QUICK or cpu < MOST_SECONDS


def wider(part, weight, fitted, draws):
    """Return the ratio of the parameters' stds over draws of variances to those at the fit."""
    floors, every = floor_runs(part), np.arange(len(part.pull))
    found = [conditional(part, floors, weight, v, every) for v in draws]
    mean = np.array([x.mean for x in found])
    variance = np.mean([np.diag(x.covariance) for x in found], axis=0) + mean.var(axis=0)
    before = np.diag(conditional(part, floors, weight, fitted, every).covariance)
    return np.sqrt(variance / before)
