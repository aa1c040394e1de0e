"""Leave-one-run-out density of the force balance from one fit, by importance sampling.

Draws of the Laplace posterior are weighted towards the posterior without a run, both of the model
made linear at its optimum: where a number is hardly known (a viscosity at its bound) draws of that
posterior are none of the true one, and their weights have no mean. It asks what a fit says of one
run when all its neighbours in heading were seen: less than left-out sectors ask. Variances are held
where the whole fit left them.

Only the force balance has such draws: least squares, support vectors and ridges, by which the other
rungs are fitted, are no posterior of this likelihood. Exact cross-validation serves all.
"""

import warnings
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.data.log import DataError
from slipid.identify import likelihood as lk
from slipid.identify.predictive import Contact, contact_of, log_student
from slipid.identify.problem import State
from slipid.identify.result import draws

TOGETHER = 50
"""Draws of the camera at once."""
MOST_ROUNDS = 12
"""Of an exact refit without a run."""


@dataclass(frozen=True, eq=False)
class Loo:
    """Leave-one-run-out densities.

    Attributes:
        log_density: of each run [nats].
        pareto_k: shape of the tail of each run's weights; above `good_k` its value is not reliable.
        good_k: min(1 - 1 / log10(draws), 0.7).
    """

    log_density: Float[np.ndarray, " run"]
    pareto_k: Float[np.ndarray, " run"]
    good_k: float


def psis_loo(contact: Contact, count: int = 1000, seed: int = 0) -> Loo:
    """Leave-one-run-out density of every run of the problem, in order of their numbers.

    Args:
        contact: fitted to all runs of its problem, without what sessions share.
        count: draws.

    Raises:
        DataError: arviz-stats is not installed.

    Source: Vehtari, Gelman and Gabry 2017, Stat. Comput. 27.
    """
    try:
        from arviz_base import from_dict
        from arviz_stats.loo import loo
    except ImportError as error:
        raise DataError(
            "PSIS-LOO needs arviz-stats; install it by: pip install 'slipid[posterior]'"
        ) from error
    problem = contact.problem
    z = draws(contact.z, contact.covariance, count, seed)
    by_piece = _densities(contact, z)
    run = problem.windows.run
    by_run = np.stack([by_piece[:, run == k].sum(axis=1) for k in np.unique(run)], axis=1)
    data = from_dict({"log_likelihood": {"run": by_run[None]}})
    with warnings.catch_warnings():  # the caller has every k and says it in his own words
        warnings.simplefilter("ignore", UserWarning)
        found = loo(data, pointwise=True, reff=1.0)  # draws are independent
    return Loo(
        log_density=np.asarray(found.elpd_i),
        pareto_k=np.asarray(found.pareto_k),
        good_k=float(found.good_k),
    )


def _densities(contact: Contact, z: Float[np.ndarray, "draw free"]) -> np.ndarray:
    """Log density of every piece under every draw (draw, piece), gaps linear in the draw."""
    problem = contact.problem
    volt = problem.volt(contact.log_variance)
    blocks, jacobian = problem.linear(jnp.asarray(contact.z), volt)
    scale = np.asarray(problem.covariance("motion", jnp.asarray(contact.log_variance)))
    gap, jac = np.asarray(blocks["motion"]), np.asarray(jacobian["motion"])
    camera = np.asarray(_cameras(problem.space, jnp.asarray(z), problem.batch.pose))
    off = z - contact.z
    return np.stack([log_student(gap + jac @ d, scale) for d in off]) + camera


@partial(jax.jit, static_argnums=0)
def _cameras(space: Any, z: Array, pose: Array) -> Array:
    def one(x: Array) -> Array:
        return lk.camera_log_jacobian(space.tree(x), pose)

    return jax.lax.map(one, z, batch_size=TOGETHER)


def exact_loo(contact: Contact, run: int) -> float:
    """The same for one run by a fit without it, variances held [nats]."""
    problem = contact.problem
    keep = (problem.windows.run != run).astype(float)
    state = State(contact.z, contact.log_variance, 0, np.inf, np.inf, "joint")
    mask = np.ones(problem.space.size)
    for _ in range(MOST_ROUNDS):
        state = problem.round(state, keep, mask, steps=8, scoring=0)
        if state.moved < 0.005:
            break
    _, jacobian = problem.linear(jnp.asarray(state.z), problem.volt(state.log_variance))
    info = problem.precision(jacobian, jnp.asarray(state.log_variance), jnp.asarray(keep))
    without = contact_of(problem, state, np.linalg.inv(np.asarray(info)))
    return float(without.log_density(problem)[problem.windows.run == run].sum())
