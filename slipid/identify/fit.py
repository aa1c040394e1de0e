"""Maximum a posteriori over trajectories: weights, structure, variances in turn until all rest."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.identify.problem import Problem, State
from slipid.identify.start import staged_start


@dataclass(frozen=True)
class Options:
    """How long and how precisely to fit.

    Attributes:
        most_rounds: of weights, structure and variances.
        tolerance: stop when no number moves more than this many posterior stds in a round.
    """

    most_rounds: int = 30
    tolerance: float = 0.02


@dataclass(frozen=True, eq=False)
class Optimum:
    """End of a fit.

    Attributes:
        state: where it ended.
        covariance: of the search vector (Laplace).
        converged: whether the tolerance was met.
        reason: why it stopped, for people.
        history: loss after every round.
    """

    state: State
    covariance: Float[np.ndarray, "free free"]
    converged: bool
    reason: str
    history: tuple[float, ...]


def optimise(
    problem: Problem,
    keep: np.ndarray | None = None,
    start: State | None = None,
    options: Options | None = None,
    tell: Callable[[State], None] = lambda state: None,
    free: np.ndarray | None = None,
    variances: bool = True,
) -> Optimum:
    """Maximum a posteriori from a staged start, or going on from a state.

    Args:
        problem: windows, robot and priors.
        keep: weight of each piece, 1 or 0 (piece,); all by default. Folds of a cross-validation
            differ in this only, so they share one compiled function.
        start: goes on from here instead of the staged start.
        tell: called after every round, for progress and checkpoints.
        free: 1 for coordinates that may move from the start, 0 for those held there (free,).
        variances: whether to fit those of the noise, too.
    """
    options = options or Options()
    keep = np.ones(len(problem.windows)) if keep is None else np.asarray(keep, float)
    state = staged_start(problem, keep, tell) if start is None else replace(start, stage="joint")
    mask = np.ones(problem.space.size) if free is None else np.asarray(free, float)
    history: list[float] = []
    reason = f"{options.most_rounds} rounds without settling"
    while state.round < options.most_rounds:
        early = state.round < 3
        scoring = (2 if early else 4) if variances else 0
        state = problem.round(state, keep, mask, steps=8 if early else 4, scoring=scoring)
        history.append(state.loss)
        tell(state)
        if state.moved < options.tolerance:
            reason = f"no number moved {options.tolerance:g} of its std in round {state.round}"
            break
    blocks_jac = problem.linear(jnp.asarray(state.z), problem.volt(state.log_variance))
    info = problem.precision(blocks_jac[1], jnp.asarray(state.log_variance), jnp.asarray(keep))
    return Optimum(
        state=state,
        covariance=np.linalg.inv(np.asarray(info)),
        converged=state.moved < options.tolerance,
        reason=reason,
        history=tuple(history),
    )
