"""One Gauss-Newton step of a fit: how far an optimum is, and the fit without some of the runs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.fitting.problem import FitState, Problem, log_jacobian
from slipid.fitting.shared_effects import EffectPosterior, marginal_residuals, marginal_slopes
from slipid.fitting.variances import MOTION_BLOCKS, Blocks, electric_following


class NewtonStep(NamedTuple):
    """Gauss-Newton step of a search vector.

    Attributes:
        step: change of the search vector.
        information: Gauss-Newton matrix of minus the log posterior.
    """

    step: Float[np.ndarray, " free"]
    information: Float[np.ndarray, "free free"]


def newton_step(
    problem: Problem,
    state: FitState,
    linear: tuple[Blocks, Blocks],
    keep: Float[np.ndarray, " segment"],
) -> NewtonStep:
    """Return the Gauss-Newton step of the fit to the segments `keep`, at given variances.

    The step is -(J^T W J + S^-2)^-1 (J^T W r + S^-2 (z - mean) - g), with r the residuals, J their
    Jacobian, W the weighted inverse noise covariance, S the prior stds, and g the gradient of
    log |d residuals / d data|. Currents and voltages change the electric parameters only. If there
    are runs over several floors, these follow the others (`electric_following`): z - mean and the
    residuals of currents are those of z less what has followed.

    Args:
        problem: the problem.
        state: state of its fit.
        linear: residuals and Jacobians at the state's search vector, from `Problem.linear`.
        keep: 1 for segments that are used, else 0.
    """
    z, log_v = state.z, state.log_variance
    electric = problem.electric(z, log_v)
    residual, jacobian = linear
    weighed = problem.weighed(residual, log_v, keep, state.shared(len(problem.windows)))
    roots = weighed.whitening.root
    following = electric_following(problem.objective, jacobian, roots, jnp.asarray(log_v))
    own = np.eye(len(z)) - np.asarray(following)
    of_electric = own * problem.space.electric[:, None]
    prior = np.asarray(problem.objective.prior_std(log_v)) ** -2
    _, slope = log_jacobian(problem.objective, z, electric, keep)
    gradient = own.T @ (prior * (z - problem.space.prior_mean) - np.asarray(slope))
    information = own.T @ (prior[:, None] * own)
    for k, root in roots.items():
        white = jnp.einsum("nij,nj->ni", root, residual[k])
        half = jnp.einsum("nij,njp->nip", root, jacobian[k])
        if k == "motion":
            white, half = _without_effects(weighed.effects, white, half)
        flat = np.asarray(half).reshape(-1, len(z))
        flat = flat if k in MOTION_BLOCKS else flat @ of_electric
        gradient = gradient + flat.T @ np.asarray(white).ravel()
        information = information + flat.T @ flat
    return NewtonStep(-np.linalg.solve(information, gradient), information)


@jax.jit
def _without_effects(
    effects: tuple[EffectPosterior, ...], white: Array, half: Array
) -> tuple[Array, Array]:
    """Return whitened residuals and their derivative with the shared effects marginalised."""
    return marginal_residuals(effects, white), marginal_slopes(effects, half)
