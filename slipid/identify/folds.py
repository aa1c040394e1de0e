"""Left-out runs: who is left out together, and what a fit of the others says of them.

Runs of one heading stay in one fold at every speed and on every floor, so that nothing of a
left-out heading is seen. Folds differ only in the weight of each piece: one compiled function
serves all.
"""

from collections.abc import Callable, Iterable
from glob import escape
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from slipid.data.dataset import Dataset
from slipid.identify.fit import Optimum, Options, optimise
from slipid.identify.ladder import rungs
from slipid.identify.predictive import contact_of
from slipid.identify.problem import Problem
from slipid.identify.validate import Frozen, validation
from slipid.parameter import Choice

Fold = Int[np.ndarray, " run"]


def sectors(data: Dataset, width_deg: float = 60.0) -> Fold:
    """Fold of every run by the sector its commanded heading lies in, -1 where it has none."""
    known = np.isfinite(data.heading)
    turn = np.degrees(np.where(known, data.heading, 0.0)) % 360.0
    sector = (np.floor((turn + 1e-6) / width_deg) % round(360 / width_deg)).astype(int)
    return np.where(known, sector, -1)


def random_headings(data: Dataset, folds: int = 6, step_deg: float = 5.0, seed: int = 0) -> Fold:
    """Fold of every run by its heading, headings dealt at random, -1 where it has none."""
    count = round(360 / step_deg)
    dealt = np.random.default_rng(seed).permutation(count) % folds
    known = np.isfinite(data.heading)
    way = np.degrees(np.where(known, data.heading, 0.0))
    return np.where(known, dealt[np.round(way / step_deg).astype(int) % count], -1)


def speeds(data: Dataset) -> Fold:
    """Fold of every run by its commanded speed, -1 where its floor and load saw one speed only.

    Turns on the spot have no speed to leave out.
    """
    speed = np.round(data.speed, 3)
    speed[speed == 0] = np.nan
    group = np.array([f"{log.surface}@{log.load}" for log in data.logs])
    out = np.full(len(data), -1)
    every = np.unique(speed[np.isfinite(speed)])
    for name in np.unique(group):
        mine = (group == name) & np.isfinite(speed)
        if len(np.unique(speed[mine])) > 1:
            out[mine] = np.searchsorted(every, speed[mine])
    return out


def still_viscosities(
    data: Dataset, runs: Iterable[int] | np.ndarray | None = None
) -> list[Choice]:
    """Viscous terms held near zero on every floor that was driven at one speed only.

    With one speed they cannot be told from creep, and what they take from it is wrong at every
    other speed.
    """
    seen: dict[str, list[float]] = {}
    for k in range(len(data)) if runs is None else runs:
        seen.setdefault(data.logs[k].surface or "unknown", []).append(float(data.speed[k]))
    out = []
    for floor, speeds in seen.items():
        known = np.asarray(speeds)[np.isfinite(speeds)]
        if len(known) == len(speeds) and known.max() < 1.3 * max(known.min(), 1e-3):
            names = (f"surface.{floor}.{name}" for name in ("slide_viscosity", "roller_viscosity"))
            out += [Choice(escape(path), fixed=1e-4) for path in names]
    return out


def left_out(
    problem: Problem,
    data: Dataset,
    fold: Fold,
    options: Options | None = None,
    tell: Callable[[int, Optimum], None] = lambda fold, optimum: None,
) -> list[dict[str, Any]]:
    """Rows of the validation file of every run, each predicted by a fit that has not seen its fold.

    Args:
        problem: of all the runs of `data`.
        data: the runs.
        fold: of each run; negative runs are fitted always and never predicted.
        tell: called after each fold.
    """
    rows: list[dict[str, Any]] = []
    for k in sorted({int(f) for f in fold if f >= 0}):
        fitted, judged = np.flatnonzero(fold != k), np.flatnonzero(fold == k)
        optimum, frozen = train(problem, data, fitted, options)
        tell(k, optimum)
        rows += validation(frozen, data.subset(judged))["runs"]
    return rows


def train(
    problem: Problem, data: Dataset, runs: np.ndarray, options: Options | None = None
) -> tuple[Optimum, Frozen]:
    """Fit of some runs of a problem, every rung of the ladder included, ready to predict others."""
    keep = np.isin(problem.windows.run, runs).astype(float)
    optimum = optimise(problem, keep=keep, options=options)
    contact = contact_of(problem, optimum.state, optimum.covariance, keep)
    robot = contact.robot
    w = problem.windows.at_lag(float(robot.camera.lag))
    seen = w.pieces(np.flatnonzero(keep > 0))
    frozen = Frozen(
        robot=robot,
        space=problem.space,
        z=contact.z,
        covariance=contact.covariance,
        variance=contact.variance,
        rungs=[rung.fit(seen, robot) for rung in rungs(w.has_current)],
    )
    return optimum, frozen


def only(problem: Problem, z: np.ndarray, pattern: str) -> list[Choice]:
    """Choices that hold every number at a fitted value and leave those of a pattern free.

    Those have their declared prior again.
    """
    robot = problem.space.tree(jnp.asarray(z))
    values = {e.path: np.asarray(e.get(robot)).tolist() for e in problem.space.all}
    return [*(Choice(escape(p), fixed=v) for p, v in values.items()), Choice(pattern, free=True)]
