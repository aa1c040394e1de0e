"""Runs that a fit of the others predicts, and fits of some runs of a problem."""

from __future__ import annotations

from collections.abc import Callable
from glob import escape

import jax.numpy as jnp
import numpy as np

from slipid.data.runs import Runs
from slipid.identify.compare.folds import Fold
from slipid.identify.compare.predictive import Contact, contact_of
from slipid.identify.compare.rung import Rung
from slipid.identify.compare.slip_models import rungs
from slipid.identify.compare.validation import Judged, validation
from slipid.identify.fit.optimise import Optimum, optimise
from slipid.identify.fit.problem import Problem
from slipid.search_space import Choice


def left_out(
    problem: Problem,
    data: Runs,
    fold: Fold,
    tell: Callable[[int, Optimum], None] = lambda fold, optimum: None,
) -> list[Judged]:
    """Scores of every run, each predicted by a fit that has not seen its fold.

    Args:
        problem: of all the runs of `data`.
        data: the runs.
        fold: of each run; negative runs are fitted always and never predicted.
        tell: called after each fold.
    """
    rows: list[Judged] = []
    for k in sorted({int(f) for f in fold if f >= 0}):
        optimum, fitted, simple = train(problem, data, np.flatnonzero(fold != k))
        tell(k, optimum)
        rows += validation(fitted, simple, data.subset(np.flatnonzero(fold == k))).runs
    return rows


def train(problem: Problem, data: Runs, runs: np.ndarray) -> tuple[Optimum, Contact, list[Rung]]:
    """Fit of some runs of a problem, every rung of the ladder included, ready to predict others."""
    keep = np.isin(problem.windows.run, runs).astype(float)
    optimum = optimise(problem, keep=keep)
    contact = contact_of(problem, optimum.state, optimum.covariance, keep)
    robot = contact.robot
    w = problem.windows.at_lag(float(robot.camera.lag))
    seen = w.pieces(np.flatnonzero(keep > 0))
    return optimum, contact, [rung.fit(seen, robot) for rung in rungs(w.has_current)]


def only(problem: Problem, z: np.ndarray, pattern: str) -> list[Choice]:
    """Choices that hold every number at a fitted value and leave those of a pattern free.

    Those have their declared prior again.
    """
    robot = problem.space.tree(jnp.asarray(z))
    values = {e.path: np.asarray(e.get(robot)).tolist() for e in problem.space.all}
    return [*(Choice(escape(p), fixed=v) for p, v in values.items()), Choice(pattern, free=True)]
