"""Sampling of the posterior of a fit: the work of `slipid sample` except its pictures."""

import hashlib
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from slipid.app.logs import config_of_fit, log_folder
from slipid.app.problem import ConfigFitTask, read_fit_task, with_mixed
from slipid.deploy.deploy import write_robot
from slipid.fitting.multi_floor import multi_floor_runs
from slipid.infer.fit_file import load
from slipid.infer.posterior import sample as netcdf
from slipid.infer.posterior.blocks import FORMAT, Plan
from slipid.infer.posterior.diagnosis import Posterior, identified
from slipid.infer.posterior.sample import sampled
from slipid.infer.result import Fit
from slipid.infer.result_folder import IDENTIFIED, ROBOT, fit_of
from slipid.support.checkpoint import Checkpoint, key_of, versions
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.files import json_text, write_together
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import COMPILING_S, Reporter

FOLDER = "sampling"
"""Name of the folder, inside the result folder, with the blocks of an unfinished chain."""


WRITTEN = ("posterior.nc", "sample.json", IDENTIFIED, ROBOT)
"""Names of the files that `sample` writes."""
OF_SAMPLE = (
    *(ROBOT, "sample.json", "posterior.nc", "posterior_intervals.png", "posterior_pairs.png"),
)
"""Names of the files of an earlier posterior, which are deleted before they are replaced."""


def sample(
    out: Path, data: Path | None, plan: Plan, draws: int, report: Reporter
) -> tuple[Posterior, Content]:
    """Return draws of the posterior of the fit in `out`, and the content of sample.json.

    The draws are written to `out` as posterior.nc, and the content as sample.json. The files
    identified.json and robot.json are replaced; they then have the intervals and draws of the
    posterior. An interrupted chain resumes where it stopped.

    Args:
        out: folder that `slipid identify` wrote.
        data: folder of the logs; None for the folder from which the fit read them.
        plan: size and seed of the chains.
        draws: number of draws kept from each ensemble.
        report: reporter of the progress.
    """
    began = time.monotonic()
    setup_jax(quiet=True)
    fit = load(out)
    folder = log_folder(out, data)
    task = read_fit_task(config_of_fit(out), folder, report)
    task = replace(task, choices=fit.choices)  # those of the calibration are not in the config
    if fit.mixed is not None:
        task = with_mixed(task, folder, report)
    _refuse_other_logs(fit, task)
    report.stage("compiling", usual_s=COMPILING_S)
    problem = task.problem(fit.robot)
    if fit.mixed is not None:
        near = fit.space.tree(np.asarray(fit.mixed["near"]))
        problem = problem.with_multi_floor(multi_floor_runs(task.mixed, near))
    fit = replace(fit, problem=problem, data=task.dataset)
    # The key has everything that the draws depend on. The largest length of the chain is not part
    # of the key, so that a chain that ended at the limit can be continued with a larger limit.
    inputs = FORMAT, fit.data_hash, replace(plan, most=10**9), draws, sorted(fit.variance.items())
    kept = Checkpoint(out / FOLDER, key_of(*inputs, np.asarray(fit.z), np.asarray(fit.covariance)))
    posterior = sampled(fit, plan, draws, kept, report)
    report.stage("predictions of the draws, and writing", usual_s=COMPILING_S)
    mark = fit_of(out)
    about = _summary(posterior, plan, time.monotonic() - began) | {"fit": mark}
    marks = {k: str(v) for k, v in about.items() if not isinstance(v, dict) and k != "schema"}
    path = out / "posterior.nc"
    packed = netcdf.packed(netcdf.tree(posterior, marks), path)
    about["posterior_sha256"] = hashlib.sha256(packed).hexdigest()
    content = identified(posterior) | {"fit": mark}
    files = {
        out / IDENTIFIED: json_text(content).encode(),
        out / "sample.json": json_text(about).encode(),
        path: packed,
    }
    write_together(files, [out / name for name in OF_SAMPLE])
    write_robot(out, posterior)
    if posterior.converged:
        kept.remove()
    return posterior, about


def _summary(posterior: Posterior, plan: Plan, seconds: float) -> Content:
    """Return the content of sample.json: settings, convergence, diagnosis of each coordinate."""
    d = posterior.diagnosis
    return {
        "schema": "slipid.sample/2",
        "converged": posterior.converged,
        "reason": posterior.reason,
        "ensembles": plan.ensembles,
        "walkers": plan.walkers,
        "steps": d.steps,
        "draws": int(np.prod(posterior.log_prob.shape)),
        "seconds": round(seconds, 1),
        "accepted": posterior.accepted,
        "seed": plan.seed,
        "worst": {
            "r_hat": float(np.max(d.r_hat)),
            "steps_per_tau": float(d.steps / np.max(d.tau)),
            "effective_draws": float(np.min(d.ess)),
            "bulk_draws": float(np.min(d.bulk)),
            "tail_draws": float(np.min(d.tail)),
        },
        "coordinates": {
            name: {"r_hat": float(r), "tau": float(t), "effective_draws": float(n)}
            for name, r, t, n in zip(posterior.names, d.r_hat, d.tau, d.ess, strict=True)
        },
        "versions": versions(),
    }


def _refuse_other_logs(fit: Fit, task: ConfigFitTask) -> None:
    """Raise `DataError` about the first log that differs from the logs of the fit, if any does."""
    logs = task.dataset.logs if fit.mixed is None else task.logs
    then, now = dict(fit.runs), {log.name: log.sha256 for log in logs}
    for name in [*then, *now]:
        if then.get(name) != now.get(name):
            what = "is missing" if name not in now else "is new" if name not in then else "changed"
            raise DataError(f"{name}: {what} since the fit; expected the logs that were fitted")
