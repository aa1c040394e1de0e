"""Fit of runs over several floors together with the runs on one floor each.

The runs over several floors are further segments of the same likelihood. Predictions are judged on
held-out runs: each half of the runs over several floors is predicted by a fit to the other half.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from slipid.fitting.multi_floor import (
    MultiFloorBatch,
    MultiFloorRuns,
    WindowErrors,
    residuals_at,
    window_errors,
)
from slipid.fitting.optimise import Optimum, optimise
from slipid.fitting.problem import FitState, Problem

_TOLERANCE = 0.1
"""Tolerance of `optimise` for a fit to half of the runs, which only serves to judge errors."""
_SECTORS = 24
"""Number of sectors of direction; runs in the same one are held out together."""


@dataclass(frozen=True, eq=False)
class MultiFloorFit:
    """A fit of runs on one floor and on several floors together.

    Attributes:
        problem: problem of all runs.
        optimum: optimum of all runs.
        before: errors on the runs over several floors, predicted by the fit to all other runs.
        after: errors on the runs over several floors, each half of which is predicted by a fit to
            the other half; None if there is only one run.
        learnt: errors on the runs over several floors, predicted by the fit to all runs.
        settled: True if both fits to half of the runs converged.
        as_if: errors, keyed by floor, if `learnt` is predicted as if all wheels always stood on
            that floor; they exceed those of `learnt` if the map is correct.
    """

    problem: Problem
    optimum: Optimum
    before: WindowErrors
    after: WindowErrors | None
    learnt: WindowErrors
    settled: bool
    as_if: Mapping[str, WindowErrors]

    @property
    def gain(self) -> float | None:
        """Ratio of held-out errors with the other half of the runs to those without.

        None if no run was held out, if a fit to half of the runs did not converge, or if the
        currents are predicted worse.
        """
        if self.after is None or not self.settled:
            return None
        return self.after.over(self.before)


def fit_multi_floor(
    problem: Problem,
    optimum: Optimum,
    multi_floor: MultiFloorRuns,
    tell: Callable[[FitState], None],
    most_rounds: int = 30,
    tolerance: float = 0.02,
) -> MultiFloorFit:
    """Fit all runs together, starting at the optimum of the runs on one floor each.

    `tell` is called after every round of the fit to all runs; `most_rounds` and `tolerance` are
    those of `optimise`. Fits to half of the runs may have twice as many rounds.
    """
    whole = problem.with_multi_floor(multi_floor)
    start = replace(whole.carried_over(optimum.state, problem), round=0)
    odd = _every_second_sector(multi_floor)
    objective, every = whole.objective, np.ones(len(odd))
    batch = objective.multi_floor
    assert batch is not None, "`with_multi_floor` sets the batch of runs over several floors"

    def errors(
        of: MultiFloorBatch, *judged: tuple[FitState, Float[np.ndarray, " run"]]
    ) -> WindowErrors:
        """Return the errors of runs; each state predicts the runs for which its weight is 1."""
        found = [(residuals_at(objective.space, of, jnp.asarray(s.z)), w) for s, w in judged]
        return window_errors(of, found)

    learnt = optimise(whole, start=start, tell=tell, most_rounds=most_rounds, tolerance=tolerance)
    after, settled = None, False
    if odd.any() and not odd.all():
        parts, settled = [], True
        for half in (odd, ~odd):
            keep = np.concatenate([np.ones(len(problem.windows)), ~half])
            other = optimise(
                whole, keep=keep, start=start, most_rounds=2 * most_rounds, tolerance=_TOLERANCE
            )
            settled &= other.converged
            parts.append((other.state, half.astype(float)))
        after = errors(batch, *parts)
    end = (learnt.state, every)
    return MultiFloorFit(
        problem=whole,
        optimum=learnt,
        before=errors(batch, (start, every)),
        after=after,
        learnt=errors(batch, end),
        settled=settled,
        as_if={
            floor: errors(batch.as_if_on(k), end)
            for k, floor in enumerate(whole.robot.surfaces.labels)
        },
    )


def _every_second_sector(runs: MultiFloorRuns) -> Bool[np.ndarray, " segment"]:
    """Return True for segments of every second group of runs in similar directions.

    Runs that repeat each other are in the same half. All runs of a sector of direction, from the
    first to the last pose, are a group; if there is one group only, every run is one.
    """
    w = runs.windows
    names, first, of_run = np.unique(w.run, return_index=True, return_inverse=True)
    last = len(w.run) - 1 - np.unique(w.run[::-1], return_index=True)[1]
    x, y = (w.pose[last, -1, :2] - w.pose[first, 0, :2]).T
    sector = np.round(np.arctan2(y, x) / (2 * np.pi) * _SECTORS) % _SECTORS
    group = np.unique(sector, return_inverse=True)[1]
    group = group if group.any() else np.arange(len(names))
    return np.asarray(group[of_run] % 2 == 1)
