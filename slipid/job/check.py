"""What a set of logs holds and can tell before anything is fitted: what `slipid check` does."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from slipid.data.log import Log
from slipid.identify import slip_curves as curves_of
from slipid.identify.fit.problem import Problem
from slipid.identify.verdicts.estimates import Estimate, derived, estimates, expected_covariance
from slipid.identify.verdicts.unidentified import flat_directions, sentences
from slipid.job.config import read_config
from slipid.job.problem import Job, Task, read_job
from slipid.support.content import Content
from slipid.support.files import write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

_CHANNELS = (
    "wheel_speed",
    "wheel_speed_command",
    "twist_command",
    "current",
    "voltage",
    "duty",
    "bus_voltage",
    "gyro",
    "pose",
)


@dataclass(frozen=True)
class Expected:
    """What logs can be expected to tell of every number and ratio, and what stays open.

    Attributes:
        parameters, derived: numbers and ratios at the start values, by path.
        messages: what stays open and what would close it, one sentence each.
    """

    parameters: dict[str, Estimate]
    derived: dict[str, Estimate]
    messages: tuple[str, ...]

    def to_json(self) -> Content:
        """Its part of check.json."""
        return {
            "parameters": {path: _before(e) for path, e in self.parameters.items()},
            "derived": {path: _before(e) for path, e in self.derived.items()},
            "messages": list(self.messages),
        }


@dataclass(frozen=True, eq=False)
class Checked:
    """End of `check`: the logs, and the content of check.json."""

    job: Job
    content: Content


def check(config_path: Path, data: Path, out: Path | None, report: Reporter) -> Checked:
    """Say what the logs hold, and what they can be expected to tell, before any fit.

    Args:
        config_path: of the job.
        data: folder its globs start from.
        out: folder for check.json, if it is wanted.
        report: progress.

    Raises:
        DataError: config or logs are wrong.
    """
    setup_jax(quiet=True)
    job = read_job(read_config(config_path), data, report)
    report.stage("expected information")
    content = overview(job, job.skipped) | expected(job, job.problem()).to_json()
    if out is not None:
        write_json(out / "check.json", content)
    return Checked(job, content)


def overview(job: Task, skipped: Sequence[str] = ()) -> Content:
    """Runs by floor, load and session, channels that every run has, repairs, what was left out."""
    data = job.dataset
    groups: dict[tuple[str, str, str], list[int]] = {}
    for k, log in enumerate(data.logs):
        groups.setdefault((log.surface or "unknown", log.load, data.session[k]), []).append(k)
    # the same repair in many files is one line: numbers and names are taken out
    notes = Counter(note for log in data.logs for note in log.notes)
    return {
        "schema": "slipid.check/1",
        "runs": len(data),
        "groups": [
            {
                "surface": surface,
                "load": load,
                "session": session,
                "runs": len(runs),
                "seconds": round(sum(data.logs[k].duration for k in runs), 1),
                "headings": len(set(np.round(np.degrees(_known(data.heading[runs])), 1).tolist())),
                "speeds": sorted(set(np.round(_known(data.speed[runs]), 3).tolist())),
            }
            for (surface, load, session), runs in sorted(groups.items())
        ],
        "channels": [_channel(data.logs, name) for name in _CHANNELS if _has(data.logs, name)],
        "notes": dict(notes.most_common()),
        "skipped": list(skipped),
        "data": {"hash": job.data_hash, "logs": {log.name: log.sha256 for log in data.logs}},
    }


def _known(x: np.ndarray) -> np.ndarray:
    return x[np.isfinite(x)]


def _has(logs: tuple[Log, ...], name: str) -> int:
    return sum(getattr(log, name) is not None for log in logs)


def _channel(logs: tuple[Log, ...], name: str) -> str:
    count = _has(logs, name)
    said = name if count == len(logs) else f"{name} ({count} of {len(logs)} runs)"
    unsigned = name == "current" and not all(log.current_is_signed for log in logs)
    return f"{said} (unsigned)" if unsigned else said


def expected(job: Task, problem: Problem) -> Expected:
    """Verdicts from the information expected at the start values with typical noise."""
    space, w = problem.space, problem.windows
    covariance = expected_covariance(problem)
    robot = space.tree(jnp.asarray(space.start))
    validity = curves_of.validity(job.dataset, robot, problem.batch)
    flat = flat_directions(space, covariance, w.has_current, w.has_voltage, validity)
    found = estimates(space, job.choices, space.start, covariance, w.has_voltage)
    ratios = derived(space, space.start, covariance, w.has_voltage)
    return Expected({e.path: e for e in found}, {e.path: e for e in ratios}, sentences(flat))


def _before(e: Estimate) -> Content:
    return {
        "unit": e.unit,
        "start": e.value,
        "expected_std": e.std,
        "ratio": e.ratio,
        "verdict": e.verdict,
    }
