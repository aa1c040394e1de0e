"""Do the linearised regions of predicted end points have the spread of predictions over draws?

For each draw of a fit's short chain (of its Laplace approximation without one), the shared effects
are estimated anew, and all runs are predicted. The spread of the end points stands beside J C J^T,
the part of the regions that is due to uncertain parameters. Set SLIPID_FIT to the folder of a fit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.benchmarks.quick import quick

DRAWS = quick(60, 6)


@pytest.fixture(scope="module")
def spreads(fit_folder):
    """Floor of each run, and spread of its end by draws and linearised [m]."""
    from slipid.app.config import read_config
    from slipid.app.logs import log_folder
    from slipid.app.problem import read_fit_task
    from slipid.fitting.problem import FitState
    from slipid.infer.fit_file import load
    from slipid.infer.posterior.coordinates import Fitted
    from slipid.predict.open_loop import replay_windows
    from slipid.predict.predictive import force_balance_of, parameter_covariance
    from slipid.support.jax_setup import setup_jax
    from slipid.support.progress import Reporter

    setup_jax(quiet=True)
    fit, quiet = load(fit_folder), Reporter(quiet=True)
    task = read_fit_task(
        read_config(fit_folder / "config.toml"), log_folder(fit_folder, None), quiet
    )
    problem = replace(task, choices=fit.choices).problem(fit.robot)
    fitted = Fitted.of(replace(fit, problem=problem))
    balances = [
        force_balance_of(
            problem,
            FitState(z, fitted.log_variance, 0, 0.0, 0.0, "joint"),
            fit.covariance,
            problem.full_weight,
        )
        for z in fit.draws(DRAWS)
    ]
    print(f"draws of {'the Laplace approximation' if fit.chain is None else 'a short chain'}")
    floor, drawn, linear = [], [], []
    for w in replay_windows(task.dataset, fit.contact.robot):
        _, slope = fit.contact.tracks_and_slopes(w)
        ends = np.stack([b.tracks(w).predicted[:, -1, :2] for b in balances])
        of_parameters = parameter_covariance(slope, fit.covariance)
        floor += w.surface
        drawn.append(np.sqrt(ends.var(axis=0, ddof=1).sum(axis=-1)))
        linear.append(np.sqrt(np.trace(of_parameters, axis1=1, axis2=2)))
    return np.array(floor), np.concatenate(drawn), np.concatenate(linear)


def test_linearised_regions_have_the_spread_of_draws(spreads):
    floor, drawn, linear = spreads
    for name in np.unique(floor):
        mine = floor == name
        ratio = np.median(drawn[mine] / linear[mine])
        print(
            f"{name}: {mine.sum()} runs, spread of the end {1000 * np.median(drawn[mine]):.1f} mm "
            f"over draws, {1000 * np.median(linear[mine]):.1f} mm linearised, ratio {ratio:.2f}"
        )
        assert 0.6 < ratio < 1.6
