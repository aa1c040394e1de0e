"""The posterior of a fit by sampling: what `slipid sample` does, but for its pictures."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slipid.app.config import read_config
from slipid.app.problem import ConfigFitTask, read_fit_task
from slipid.infer.fit_file import load, write_identified
from slipid.infer.posterior import sample as netcdf
from slipid.infer.posterior.blocks import FORMAT, Plan
from slipid.infer.posterior.diagnosis import Posterior, identified
from slipid.infer.posterior.sample import sampled
from slipid.infer.result import Fit
from slipid.support.checkpoint import Checkpoint, key_of, versions
from slipid.support.errors import DataError
from slipid.support.files import Content, read_json, write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

FOLDER = "sampling"
"""Folder of the blocks of an unfinished chain, inside the result's."""


@dataclass(frozen=True, eq=False)
class SampleResult:
    """End of `sample`.

    Attributes:
        about: content of sample.json: how the chains did.
        written: names of the files.
    """

    posterior: Posterior
    about: Content
    written: tuple[str, ...]


def sample(out: Path, data: Path | None, plan: Plan, draws: int, report: Reporter) -> SampleResult:
    """Sample around the fit in `out`: posterior.nc, sample.json, intervals in identified.json.

    A chain that was interrupted there goes on. The logs lie in `data`, by default where they were
    fitted; `draws` are kept of each ensemble.
    """
    began = time.monotonic()
    setup_jax(quiet=True)
    fit = load(out)
    _refuse_mixed(fit)
    folder = _log_folder(out, data)
    task = read_fit_task(read_config(out / "config.toml"), folder, report)
    _refuse_other_logs(fit, task)
    report.stage("compiling")
    fit = replace(fit, problem=task.problem(fit.robot), data=task.dataset)
    # all that a chain depends on; how long it may become is not of it
    told = FORMAT, fit.data_hash, replace(plan, most=10**9), draws, sorted(fit.variance.items())
    kept = Checkpoint(out / FOLDER, key_of(*told, np.asarray(fit.z), np.asarray(fit.covariance)))
    found = sampled(fit, plan, draws, kept, report)
    report.stage("writing")
    about = _summary(found, plan, time.monotonic() - began)
    marks = {k: str(v) for k, v in about.items() if not isinstance(v, dict) and k != "schema"}
    netcdf.write(netcdf.tree(found, marks), out / "posterior.nc")
    write_identified(out, identified(found))
    write_json(out / "sample.json", about)
    if found.converged:
        kept.remove()
    written = ("posterior.nc", "sample.json", "identified.json")
    return SampleResult(found, about, written)


def _summary(found: Posterior, plan: Plan, seconds: float) -> Content:
    """Content of sample.json: what was done and whether to believe it."""
    d = found.diagnosis
    return {
        "schema": "slipid.sample/1",
        "converged": found.converged,
        "reason": found.reason,
        "ensembles": plan.ensembles,
        "walkers": plan.walkers,
        "steps": d.steps,
        "draws": int(np.prod(found.log_prob.shape)),
        "seconds": round(seconds, 1),
        "accepted": found.accepted,
        "seed": plan.seed,
        "worst": {
            "r_hat": float(np.max(d.r_hat)),
            "steps_per_tau": float(d.steps / np.max(d.tau)),
            "effective_draws": float(np.min(d.ess)),
        },
        "coordinates": {
            name: {"r_hat": float(r), "tau": float(t), "effective_draws": float(n)}
            for name, r, t, n in zip(found.names, d.r_hat, d.tau, d.ess, strict=True)
        },
        "versions": versions(),
    }


def _log_folder(out: Path, data: Path | None) -> Path:
    """The data folder: as given, else where the fit found its logs, if they are still there."""
    if data is not None:
        return data
    run = read_json(out / "run.json", "what `slipid identify` keeps of a run")
    folder = Path(run["data"]["folder"])
    if not folder.is_dir():
        raise DataError(f"{folder}: the logs were fitted from there; expected --data DIR")
    return folder


def _refuse_mixed(fit: Fit) -> None:
    """Refuse a fit that learnt from runs over several floors: their likelihood is not sampled."""
    if fit.mixed is not None:
        raise DataError(
            "the fit learnt from runs over several floors, which are not sampled yet; "
            "expected a fit without the log sections that have a map (identify again without them)"
        )


def _refuse_other_logs(fit: Fit, task: ConfigFitTask) -> None:
    """Refuse logs other than those that were fitted; names the first that differs."""
    then, now = dict(fit.runs), {log.name: log.sha256 for log in task.dataset.logs}
    for name in [*then, *now]:
        if then.get(name) != now.get(name):
            what = "is missing" if name not in now else "is new" if name not in then else "changed"
            raise DataError(f"{name}: {what} since the fit; expected the very logs it was made of")
