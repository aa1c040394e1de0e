"""What a set of logs holds and can tell, before anything is fitted."""

from collections import Counter
from typing import Any

import jax.numpy as jnp
import numpy as np

from slipid.app.job import Job
from slipid.data.log import Log
from slipid.identify import curves as curves_of
from slipid.identify.flat import flat_directions, sentences
from slipid.identify.identifiability import Estimate, derived, estimates, expected_covariance
from slipid.identify.problem import Problem

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


def overview(job: Job) -> dict[str, Any]:
    """Runs by floor, load and session, channels that every run has, repairs."""
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
        "skipped": list(job.skipped),
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


def expected(job: Job, problem: Problem) -> dict[str, Any]:
    """Verdicts from the information expected at the start values with typical noise.

    Returns:
        `parameters` and `derived` by path, `messages`: what stays open and what would close it.
    """
    space, w = problem.space, problem.windows
    covariance = expected_covariance(problem)
    robot = space.tree(jnp.asarray(space.start))
    validity = curves_of.validity(job.dataset, robot, problem.batch)
    flat = flat_directions(space, covariance, w.has_current, w.has_voltage, validity)
    found = estimates(space, job.choices, space.start, covariance, w.has_voltage)
    ratios = derived(space, space.start, covariance, w.has_voltage)
    return {
        "parameters": {e.path: _before(e) for e in found},
        "derived": {e.path: _before(e) for e in ratios},
        "messages": list(sentences(flat)),
    }


def _before(e: Estimate) -> dict[str, Any]:
    return {
        "unit": e.unit,
        "start": e.value,
        "expected_std": e.std,
        "ratio": e.ratio,
        "verdict": e.verdict,
    }
