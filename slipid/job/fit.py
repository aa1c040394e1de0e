"""From runs, a robot and wishes to a fit with intervals, verdicts and simpler models beside it."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from slipid.identify.compare.slip_models import rungs
from slipid.identify.fit.crossing import crossing
from slipid.identify.fit.mixed import update
from slipid.identify.fit.optimise import Optimum, optimise
from slipid.identify.fit.problem import Problem, State
from slipid.identify.result import Fit, summarise, updated
from slipid.job.problem import Task
from slipid.support.checkpoint import Checkpoint
from slipid.support.progress import Reporter

CHECKPOINT = "checkpoint"
"""Name of the file that a fit in progress keeps its state in."""


def optimised(task: Task, problem: Problem, kept: Checkpoint | None, report: Reporter) -> Optimum:
    """Optimum of a task, whose problem is `task.problem()`.

    It goes on from the state that was kept of this very task, and keeps every round.
    """
    wanted = task.settings
    start, history = _restored(kept)
    if start is not None and kept is not None:
        report.line(f"going on from round {start.round} of {kept.folder / CHECKPOINT}.npz")
    progress = _Rounds(report, wanted.tolerance)

    def tell(state: State) -> None:
        progress.tell(state)
        if state.stage == "joint":
            history.append(state.loss)
            if kept is not None:
                kept.save(CHECKPOINT, vars(state) | {"history": np.array(history)})

    report.stage("compiling")
    rounds = wanted.rounds
    if start is not None and start.moved < wanted.tolerance:
        rounds = start.round  # it had settled: only the last steps are missing
    optimum = optimise(
        problem, start=start, most_rounds=rounds, tolerance=wanted.tolerance, tell=tell
    )
    return replace(optimum, history=tuple(history))


def _restored(kept: Checkpoint | None) -> tuple[State | None, list[float]]:
    """Where the fit stood when it was left, and its losses so far."""
    found = None if kept is None else kept.load(CHECKPOINT)
    if found is None:
        return None, []
    history = found.pop("history").tolist()
    plain: dict[str, Any] = {k: v if v.ndim else v.item() for k, v in found.items()}
    return State(**plain), history


class _Rounds:
    """Progress of a fit; its end is where steps that shrink as they do fall below the tolerance."""

    def __init__(self, report: Reporter, tolerance: float):
        self.report, self.tolerance = report, tolerance
        self.first: float | None = None

    def tell(self, state: State) -> None:
        """A round is done."""
        self.report.stage(state.stage)
        what = f"round {state.round}, loss {state.loss:.2f}, moved {state.moved:.3g} std"
        if state.stage != "joint":  # the staged start ends after a given number of rounds
            self.report.note(what)
            return
        moved = max(state.moved, 1e-12)
        self.first = self.first or max(moved, 2 * self.tolerance)
        whole = math.log(self.first / self.tolerance)
        self.report.advance(min(math.log(self.first / moved), whole), whole, what)


def summarised(task: Task, problem: Problem, optimum: Optimum, report: Reporter) -> Fit:
    """The fit with intervals, what runs over several floors add, and simpler models beside it."""
    report.stage("intervals and verdicts")
    fit = summarise(problem, optimum, task.dataset, task.choices, task.settings.seed)
    if task.mixed:
        report.stage("runs over several floors")
        sets = [crossing(data, floor, fit.robot) for data, floor in task.mixed]
        found = update(fit.space, fit.z, fit.covariance, sets)
        report.line(_judged(found.about))
        fit = updated(fit, found, problem, optimum, task.dataset)
    report.stage("simpler models, for comparison")
    return _with_baselines(fit, task)


def _judged(about: Mapping[str, Any]) -> str:
    """What runs over several floors told, as a sentence."""

    def off(errors: Mapping[str, float]) -> str:
        return f"{errors['yaw_rate']:.3f} rad/s and {1000 * errors['speed']:.1f} mm/s"

    said = f"{about['runs']} runs over several floors: predicted within {off(about['before'])}"
    if about["after"] is None:
        return f"{said} by the others; one run cannot judge what it taught"
    return f"{said} by the others, {off(about['after'])} when half has taught the other"


def _with_baselines(fit: Fit, task: Task) -> Fit:
    """The fit, with every simpler model learnt from the same runs at the fitted camera and lag."""
    try:
        fit.robot.geometry.inverse()
    except ValueError:  # wheels that do not fix the twist: none of them applies
        return fit
    cut = task.windows(fit.robot)
    learnt = [rung.fit(cut, fit.robot) for rung in rungs(fit.channels.current)]
    plain = {r.name: {floor: v.tolist() for floor, v in r.state.items()} for r in learnt}
    return replace(fit, baselines=plain)
