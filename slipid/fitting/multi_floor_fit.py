"""Fit of runs over several floors together with the runs on one floor each.

The runs over several floors are further segments of the same likelihood. Predictions are judged on
held-out runs: each half of the runs over several floors is predicted by a fit to the other half.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.fitting.multi_floor import (
    MultiFloorBatch,
    MultiFloorRuns,
    WindowErrors,
    residuals_at,
    window_errors,
)
from slipid.fitting.optimise import Optimum, optimise
from slipid.fitting.problem import FitState, Problem

_ROUNDS = 10
"""Largest number of rounds of a fit to half of the runs; such a fit only serves to judge errors."""


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
        as_if: errors, keyed by floor, if `learnt` is predicted as if all wheels always stood on
            that floor; they exceed those of `learnt` if the map is correct.
    """

    problem: Problem
    optimum: Optimum
    before: WindowErrors
    after: WindowErrors | None
    learnt: WindowErrors
    as_if: Mapping[str, WindowErrors]


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
    those of `optimise`.
    """
    whole = problem.with_multi_floor(multi_floor)
    start = replace(whole.carried_over(optimum.state, problem), round=0)
    odd = np.unique(multi_floor.windows.run, return_inverse=True)[1] % 2 == 1
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
    after = None
    if odd.any() and not odd.all():
        parts = []
        for half in (odd, ~odd):
            keep = np.concatenate([np.ones(len(problem.windows)), ~half])
            other = optimise(whole, keep=keep, start=start, most_rounds=_ROUNDS)
            parts.append((other.state, half.astype(float)))
        after = errors(batch, *parts)
    end = (learnt.state, every)
    return MultiFloorFit(
        problem=whole,
        optimum=learnt,
        before=errors(batch, (start, every)),
        after=after,
        learnt=errors(batch, end),
        as_if={
            floor: errors(batch.as_if_on(k), end)
            for k, floor in enumerate(whole.robot.surfaces.labels)
        },
    )
