"""What runs over several floors teach beside those that each keep to one floor.

They are further pieces of the one likelihood. How well they are predicted is told by left-out ones:
each half of the runs is judged by a fit that has seen the other half only.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.identify.fit.crossing import Crossing, Errors, errors
from slipid.identify.fit.optimise import Optimum, optimise
from slipid.identify.fit.problem import Problem, State

_ROUNDS = 6
"""Most rounds of the fits to half of the runs, which only judge."""


@dataclass(frozen=True, eq=False)
class Across:
    """A fit of runs on one floor and on several together.

    Attributes:
        problem, optimum: of all runs.
        before: errors of the runs over several floors by a fit that has seen none of them.
        after: of each half by a fit that has seen the other, None where there is only one run.
    """

    problem: Problem
    optimum: Optimum
    before: Errors
    after: Errors | None


def across(
    problem: Problem, optimum: Optimum, several: Crossing, tell: Callable[[State], None]
) -> Across:
    """Goes on from the optimum of a problem with runs over several floors.

    `tell` is called after every round of the fit to all runs.
    """
    whole = problem.crossed(several)
    start = replace(whole.restated(optimum.state, problem), round=0)
    on_one, odd = len(problem.windows), several.windows.run % 2 == 1
    before = _errors(whole, (start, np.ones(len(odd))))
    learnt = optimise(whole, start=start, tell=tell)
    after = None
    if odd.any() and not odd.all():
        parts = []
        for half in (odd, ~odd):
            keep = np.concatenate([np.ones(on_one), ~half])
            end = optimise(whole, keep=keep, start=start, most_rounds=_ROUNDS)
            parts.append((end.state, half.astype(float)))
        after = _errors(whole, *parts)
    return Across(whole, learnt, before, after)


def _errors(problem: Problem, *judged: tuple[State, Float[np.ndarray, " run"]]) -> Errors:
    """Errors of runs over several floors, each by the state that judges it, with weight 1 or 0."""
    several = problem.target.several
    assert several is not None, "a problem with runs over several floors"
    found = []
    for state, weight in judged:
        electric = problem.electric(state.z, jnp.asarray(state.log_variance))
        residual, _ = problem.linear(jnp.asarray(state.z), electric)
        found.append((residual, weight))
    return errors(several, found)
