"""What a set of logs holds and can tell, before anything is fitted."""

from collections import Counter
from typing import Any

import numpy as np

from slipid.app.job import Job
from slipid.data.log import Log
from slipid.identify.verdict import Estimate, Flat, estimates, flat_directions

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


def expected(job: Job) -> tuple[tuple[Estimate, ...], tuple[Flat, ...]]:
    """Verdicts from the information expected at the start values with typical noise.

    The information is that of `slipid.identify.fit.Problem.precision`; what the data really hold
    depends on where the fit ends.
    """
    import jax.numpy as jnp

    problem = job.problem()
    z = problem.space.start
    log_v = 2 * np.log(problem.noise.typical)
    _, jacobian = problem.linear(jnp.asarray(z), problem.volt(log_v))
    keep = jnp.ones(len(problem.windows))
    info = np.asarray(problem.precision(jacobian, jnp.asarray(log_v), keep))
    covariance = np.linalg.inv(info)
    windows = problem.windows
    found = estimates(problem.space, job.choices, z, covariance, windows.has_voltage)
    flat = flat_directions(problem.space, covariance, windows.has_current, windows.has_voltage)
    return found, flat
