"""Every rung of the ladder on equal terms: fitted without some runs, judged on them."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from slipid.data.runs import Runs
from slipid.identify.compare import open_loop as replay
from slipid.identify.compare.predictive import Predictive, contact_of, with_noise
from slipid.identify.compare.slip_models import rungs
from slipid.identify.compare.validation import Judged, score
from slipid.identify.fit.one_speed import still_viscosities
from slipid.identify.fit.optimise import Options, optimise
from slipid.identify.fit.problem import Problem, State
from slipid.search_space import Choice, Space


@dataclass(frozen=True)
class FoldResult:
    """What the models say of the runs of a fold.

    Attributes:
        runs: those left out, with the scores of every model.
        seconds: to `fit` and to `predict`, of every model.
        numbers: fitted numbers of every model, by floor.
        converged, reason: how the fit of the force balance ended.
    """

    runs: tuple[Judged, ...]
    seconds: dict[str, dict[str, float]]
    numbers: dict[str, dict[str, int]]
    converged: bool
    reason: str

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        others = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "runs"}
        return {"rows": [run.to_json() for run in self.runs], **others}


def problem_of(
    problem: Problem, choices: Sequence[Choice], data: Runs, fitted: np.ndarray
) -> Problem:
    """The problem for some of its runs; other than itself where they saw a floor at one speed."""
    held = [*still_viscosities(data, fitted), *choices]
    if Space(problem.robot, held).names == problem.space.names:
        return problem
    return Problem(problem.windows, problem.robot, held, problem.joint)


def judge(
    problem: Problem,
    choices: Sequence[Choice],
    data: Runs,
    judged: np.ndarray,
    options: Options | None = None,
    tell: Callable[[State], None] = lambda state: None,
) -> FoldResult:
    """One fold: every rung fitted without some runs, and what it says of them.

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
    runs: dict[int, Judged] = {}
    cuts = replay.cuts(part, contact.robot)
    for model in models:
        began = time.perf_counter()
        for w in cuts:
            score(runs, part, model.name, *model.ends(w))
        seconds[model.name]["predict"] = time.perf_counter() - began
        for k, value in enumerate(_by_run(model, problem, judged).tolist()):
            scores = runs[k].models
            scores[model.name] = replace(scores[model.name], log_density=value)
    return FoldResult(
        runs=tuple(replace(runs[k], session=name) for k, name in enumerate(part.session)),
        seconds=seconds,
        numbers={model.name: model.numbers for model in models},
        converged=bool(optimum.converged),
        reason=optimum.reason,
    )


def _by_run(model: Predictive, problem: Problem, runs: np.ndarray) -> Float[np.ndarray, " run"]:
    density, run = model.log_density(problem), problem.windows.run
    return np.array([density[run == k].sum() for k in runs])
