"""A fit to some runs of a config, and what it and simpler models predict of others."""

from dataclasses import replace
from pathlib import Path

from slipid.app.config import read_config
from slipid.app.identify import fitted
from slipid.app.problem import ConfigFitTask, fit_task, read_fit_task
from slipid.data.runs import Runs
from slipid.predict.validation import Validation
from slipid.support.progress import Reporter


def held_back(
    config: Path, folder: Path, learnt: tuple[str, ...], judged: tuple[str, ...]
) -> Validation:
    """Fitted to runs that have one of some words in their names, judged on those with others."""
    with Reporter(quiet=True) as report:
        read = read_config(config)
        whole: ConfigFitTask = read_fit_task(read, folder, report)
        job = fit_task(read, part(whole.dataset, learnt), (), report)
        fit, _, _ = fitted(job, report)
    assert fit.converged, fit.reason
    other = part(whole.dataset, judged)
    # a session that was not fitted has the marker where the robot has it
    other = replace(other, session=tuple(fit.robot.camera.sessions[:1] * len(other)))
    return fit.validate(other)


def part(data: Runs, names: tuple[str, ...]) -> Runs:
    return data.subset([k for k, log in enumerate(data.logs) if any(n in log.name for n in names)])
