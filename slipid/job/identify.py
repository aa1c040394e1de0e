"""From a config and its logs to a fit: what `slipid identify` does, but for its pictures."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from slipid.identify.fit_file import save
from slipid.identify.result import Fit
from slipid.identify.verdicts.profile import Profile, profile, profiled
from slipid.job.config import read_config
from slipid.job.fit import CHECKPOINT, optimised, summarised
from slipid.job.problem import Job, read_job, with_mixed
from slipid.support.checkpoint import Checkpoint, key_of, versions
from slipid.support.errors import DataError
from slipid.support.files import writable, write_bytes, write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter


@dataclass(frozen=True, eq=False)
class Identified:
    """End of `identify`: the fit, the runs it saw, the profiles asked for, the files written."""

    fit: Fit
    job: Job
    profiles: tuple[Profile, ...]
    written: tuple[str, ...]


def identify(
    config_path: Path, data: Path, out: Path, report: Reporter, profiles: Sequence[str] = ()
) -> Identified:
    """Fit the robot of a config to its logs and write everything to `out`.

    A fit that was interrupted there goes on. Profile likelihoods are made of the numbers named.

    Raises:
        DataError: config or logs are wrong; nothing was written then.
    """
    began = time.monotonic()
    setup_jax(quiet=True)
    config = read_config(config_path)
    job = read_job(config, data, report)
    report.line(f"{len(job.dataset)} runs on {', '.join(job.robot.surfaces.labels)}")
    job = with_mixed(job, data, report)
    report.stage("cutting windows")
    problem = job.problem()
    for path in profiles:
        try:
            profiled(problem.space, path)
        except ValueError as error:
            raise DataError(f"--profile: {error}") from error
    writable(out)
    key = key_of(config.hash, job.data_hash, problem.space.names, problem.noise.names)
    kept = Checkpoint(out, key)
    optimum = optimised(job, problem, kept, report)
    fit = summarised(job, problem, optimum, report)
    report.stage("writing")
    written = (*save(fit, out), "run.json", "config.toml")
    _keep_run(job, data, out, time.monotonic() - began)
    if profiles and job.mixed:
        report.line("profiles are of the runs on one floor each")

    def tell(points: int, rise: float) -> None:
        report.note(f"{points} points, rise {rise:.2f}")

    found = []
    for path in dict.fromkeys(profiles):
        report.stage(f"profile of {path}")
        found.append(profile(problem, optimum, path, tell))
    if found:
        each = {p.path: asdict(p) for p in found}
        write_json(out / "profile.json", {"schema": "slipid.profile/1", "profiles": each})
        written = (*written, "profile.json")
    kept.remove(f"{CHECKPOINT}.npz")
    return Identified(fit, job, tuple(found), written)


def _keep_run(job: Job, data: Path, out: Path, seconds: float) -> None:
    """What later commands and readers need to know of this run."""
    config = job.config
    write_bytes(out / "config.toml", config.text.encode())
    logs = {log.name: log.sha256 for log in job.logs}
    run = {
        "schema": "slipid.run/1",
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": round(seconds, 1),
        "config": {"name": config.path.name, "sha256": config.hash},
        "data": {"folder": str(data), "hash": job.data_hash, "logs": logs, "skipped": job.skipped},
        "seed": job.settings.seed,
        "versions": versions(),
    }
    write_json(out / "run.json", run)
