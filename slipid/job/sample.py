"""The posterior of a fit by sampling: what `slipid sample` does, but for its pictures."""

import importlib
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slipid.identify.fit.problem import Problem
from slipid.identify.fit_file import load, write_identified
from slipid.identify.posterior import netcdf
from slipid.identify.posterior import sample as posterior
from slipid.identify.posterior.blocks import FORMAT, Block, Plan, Record, packed, unpacked
from slipid.identify.posterior.coordinates import Fitted
from slipid.identify.posterior.diagnosis import Posterior, estimates, identified
from slipid.identify.result import Fit
from slipid.identify.verdicts.estimates import Estimate
from slipid.job.config import read_config
from slipid.job.problem import Job, read_job
from slipid.support.checkpoint import Checkpoint, key_of, versions
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.files import read_json, write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

for _module in ("arviz_base", "arviz_stats", "h5netcdf"):
    importlib.import_module(_module)  # they are used after hours of work: what is missing shows now

FOLDER = "sampling"
"""Folder of the blocks of an unfinished chain, inside the result's."""


@dataclass(frozen=True, eq=False)
class Sampled:
    """End of `sample`.

    Attributes:
        parameters: numbers from the draws, by path.
        about: content of sample.json: how the chains did.
        written: names of the files.
    """

    fit: Fit
    posterior: Posterior
    parameters: dict[str, Estimate]
    about: Content
    written: tuple[str, ...]


def sample(out: Path, data: Path | None, plan: Plan, draws: int, report: Reporter) -> Sampled:
    """Sample around the fit in `out`: posterior.nc, sample.json, intervals in identified.json.

    A chain that was interrupted there goes on. The logs lie in `data`, by default where they were
    fitted; `draws` are kept of each ensemble.
    """
    began = time.monotonic()
    setup_jax(quiet=True)
    fit = load(out)
    _on_one_floor(fit)
    folder = _where_the_logs_are(out, data)
    job = read_job(read_config(out / "config.toml"), folder, report)
    _same_logs(fit, job)
    report.stage("compiling")
    problem = job.problem(fit.robot)
    # all that a chain depends on; how long it may become is not of it
    told = FORMAT, fit.data_hash, replace(plan, most=10**9), draws, sorted(fit.variance.items())
    kept = Checkpoint(out / FOLDER, key_of(*told, np.asarray(fit.z), np.asarray(fit.covariance)))
    found = sampled_around(fit, problem, plan, draws, kept, report)
    report.stage("writing")
    about = _summary(found, plan, time.monotonic() - began)
    numbers = estimates(fit, found.z)
    marks = {k: str(v) for k, v in about.items() if not isinstance(v, dict)}
    marks |= {"schema": netcdf.SCHEMA, "data_hash": fit.data_hash}
    runs = tuple(log.name for log in job.dataset.logs)
    netcdf.write(netcdf.tree(problem, found, runs, marks), out / "posterior.nc")
    write_identified(out, identified(fit, found, numbers, problem))
    write_json(out / "sample.json", about)
    if found.converged:
        kept.remove()
    written = ("posterior.nc", "sample.json", "identified.json")
    return Sampled(fit, found, numbers, about, written)


def sampled_around(
    fit: Fit, problem: Problem, plan: Plan, draws: int, kept: Checkpoint | None, report: Reporter
) -> Posterior:
    """Posterior of a fit by the likelihood it was made of; arguments as of `sample`.

    It goes on from the blocks that an earlier call has kept, and keeps new ones.
    """

    def done(part: str) -> list[Block]:
        blocks: list[Block] = []
        if kept is None:
            return blocks
        while (arrays := kept.load(f"{part}-{len(blocks):04d}")) is not None:
            blocks.append(unpacked(arrays))
        if blocks:
            report.line(f"going on from block {len(blocks)} ({part}) of {kept.folder}")
        return blocks

    def keep(part: str, block: Block) -> None:
        if kept is not None:
            kept.save(f"{part}-{block.number:04d}", packed(block))
        _tell(block, plan, report)

    def steps(part: str, count: int) -> None:
        report.stage(f"sampling {part}")

    variance = np.array([fit.variance[name] for name in problem.noise.names])
    fitted = Fitted(fit.z, np.log(variance), fit.covariance)
    return posterior.sample(problem, fitted, plan, draws=draws, record=Record(done, keep, steps))


def _tell(block: Block, plan: Plan, report: Reporter) -> None:
    """Progress of a chain; the time left is what it takes at most."""
    count = block.number + 1
    warm = "warm-up, " if count <= plan.warm_up[-1] else ""
    what = (
        f"block {count}: {warm}{count * block.chain.shape[1]} steps, "
        f"{100 * block.accepted.mean():.0f} % moved, "
        f"log density {block.log_prob[:, -1].mean():.1f}"
    )
    report.advance(count, plan.most, what)


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


def _where_the_logs_are(out: Path, data: Path | None) -> Path:
    """The data folder: as given, else where the fit found its logs, if they are still there."""
    if data is not None:
        return data
    run = read_json(out / "run.json", "what `slipid identify` keeps of a run")
    folder = Path(run["data"]["folder"])
    if not folder.is_dir():
        raise DataError(f"{folder}: the logs were fitted from there; expected --data DIR")
    return folder


def _on_one_floor(fit: Fit) -> None:
    """Refuse a fit that learnt from runs over several floors: their likelihood is not sampled."""
    if fit.mixed is not None:
        raise DataError(
            "the fit learnt from runs over several floors, which are not sampled yet; "
            "expected a fit without the log sections that have a map (identify again without them)"
        )


def _same_logs(fit: Fit, job: Job) -> None:
    """Refuse logs other than those that were fitted; names the first that differs."""
    then, now = dict(fit.runs), {log.name: log.sha256 for log in job.dataset.logs}
    for name in [*then, *now]:
        if then.get(name) != now.get(name):
            what = "is missing" if name not in now else "is new" if name not in then else "changed"
            raise DataError(f"{name}: {what} since the fit; expected the very logs it was made of")
