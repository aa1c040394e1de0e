"""Every rung of the ladder on equal terms: fitted without some runs, judged on them."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from slipid.data.dataset import Dataset
from slipid.data.log import DataError
from slipid.identify import replay
from slipid.identify.fit import Options, optimise
from slipid.identify.folds import Fold, random_headings, sectors, speeds, still_viscosities
from slipid.identify.ladder import rungs
from slipid.identify.predictive import Predictive, contact_of, with_noise
from slipid.identify.problem import Problem, State
from slipid.identify.validate import score
from slipid.parameter import Choice, Space

QUESTIONS: dict[str, Callable[[Dataset], Fold]] = {
    "sectors": sectors,
    "speeds": speeds,
    "random": random_headings,
}
"""What is left out together: 60-degree sectors of headings, one speed, headings dealt at random."""


def folds_of(data: Dataset, question: str) -> Fold:
    """Fold of every run; -1 for one that cannot be judged and is always fitted.

    A run cannot be judged where leaving out its fold leaves nothing of its floor and load set-up.

    Raises:
        DataError: no such question.
    """
    if question not in QUESTIONS:
        raise DataError(
            f"--folds: '{question}': no such question; expected some of {', '.join(QUESTIONS)}"
        )
    fold = QUESTIONS[question](data)
    group = np.array([f"{log.surface}@{log.load}" for log in data.logs])
    for name in np.unique(group):
        mine = group == name
        if len(np.unique(fold[mine])) < 2:
            fold[mine] = -1
    return fold


def problem_of(
    problem: Problem, choices: Sequence[Choice], data: Dataset, fitted: np.ndarray
) -> Problem:
    """The problem for some of its runs; other than itself where they saw a floor at one speed."""
    held = [*still_viscosities(data, fitted), *choices]
    if Space(problem.robot, held).names == problem.space.names:
        return problem
    return Problem(problem.windows, problem.robot, held, problem.joint)


def judge(
    problem: Problem,
    choices: Sequence[Choice],
    data: Dataset,
    judged: np.ndarray,
    options: Options | None = None,
    tell: Callable[[State], None] = lambda state: None,
) -> dict[str, Any]:
    """One fold: every rung fitted without some runs, and what it says of them, as plain values.

    Args:
        problem: of all the runs of `data`.
        choices: it was made with.
        judged: numbers of the runs left out.
        tell: called after every round of the force balance's fit.
    """
    fitted = np.setdiff1d(np.arange(len(data)), judged)
    problem = problem_of(problem, choices, data, fitted)
    keep = np.isin(problem.windows.run, fitted).astype(float)
    began = time.perf_counter()
    optimum = optimise(problem, keep=keep, options=options, tell=tell)
    contact = contact_of(problem, optimum.state, optimum.covariance, keep)
    models: list[Predictive] = [contact]
    seconds = {contact.name: {"fit": time.perf_counter() - began}}
    for rung in rungs(problem.windows.has_current):
        began = time.perf_counter()
        models.append(with_noise(rung, contact, keep))
        seconds[rung.name] = {"fit": time.perf_counter() - began}
    part = data.subset(judged)
    rows: list[dict[str, Any]] = [{} for _ in judged]
    cuts = replay.cuts(part, contact.robot)
    for model in models:
        began = time.perf_counter()
        for w in cuts:
            score(rows, part, model.name, *model.ends(w))
        seconds[model.name]["predict"] = time.perf_counter() - began
        for row, value in zip(rows, _by_run(model, problem, judged), strict=True):
            row["models"][model.name]["log_density"] = float(value)
    for row, session in zip(rows, part.session, strict=True):
        row["session"] = session
    return {
        "rows": rows,
        "seconds": seconds,
        "numbers": {model.name: model.numbers for model in models},
        "converged": bool(optimum.converged),
        "reason": optimum.reason,
    }


def _by_run(model: Predictive, problem: Problem, runs: np.ndarray) -> Float[np.ndarray, " run"]:
    density, run = model.log_density(problem), problem.windows.run
    return np.array([density[run == k].sum() for k in runs])
