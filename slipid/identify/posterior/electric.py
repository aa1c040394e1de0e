"""A draw of the electric numbers for every draw of the motion.

Given the motion their most likely values are found by Gauss-Newton steps, and proposals are drawn
from a Student t there, whose tails reach where a skewed density does. Each is accepted or not by
the exact density (Metropolis-Hastings with independent proposals; Tierney 1994, Annals of
Statistics 22(4)).
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.identify.fit.variances import Square
from slipid.identify.posterior.coordinates import Anchor
from slipid.identify.posterior.density import Density, Held

_STEPS, _PROPOSALS = 4, 16
"""Gauss-Newton steps, and proposals of every draw."""
_DEGREES = 5.0
"""Degrees of freedom of proposals."""
_WIDER = 1.15
"""Scale of proposals over that of the Gaussian at the most likely values."""


@dataclass(frozen=True, eq=False)
class ElectricDraws:
    """Electric numbers for every draw of the motion, and how they were found.

    Accepted is the part of the proposals that were, still that of draws that never moved.
    """

    x: Float[np.ndarray, "ensemble draw size"]
    accepted: float
    still: float


def electric_given_motion(
    first: Density,
    second: Density,
    covariance: Square,
    x: Float[np.ndarray, "ensemble draw size"],
    seed: int,
) -> ElectricDraws:
    """Draws of the second density given draws of the first.

    The covariance is Laplace's of the search vector: its regression of electric numbers on those of
    the motion is where Gauss-Newton steps start.
    """
    motion, electric = first.coordinates.structure, second.coordinates.structure
    slope = np.linalg.solve(
        covariance[np.ix_(motion, motion)], covariance[np.ix_(motion, electric)]
    )
    flat = x.reshape(-1, x.shape[-1])
    start = second.centre + (flat - first.centre) @ slope
    rng = np.random.default_rng(seed)
    student = rng.standard_normal((len(flat), _PROPOSALS + 1, second.size))
    student *= np.sqrt(_DEGREES / rng.chisquare(_DEGREES, student.shape[:2]))[..., None]
    chance = np.log(rng.uniform(size=(len(flat), _PROPOSALS)))
    many = (first.hold(flat), *map(jnp.asarray, (start, student, chance)))
    drawn, moves = second.mapped(_draw, many)
    moved = np.asarray(moves)
    return ElectricDraws(
        x=np.asarray(drawn).reshape(*x.shape[:2], -1),
        accepted=float(moved.mean()),
        still=float((~moved.any(axis=1)).mean()),
    )


def _draw(
    density: Density, anchor: Anchor, held: Held, start: Array, student: Array, chance: Array
) -> tuple[Array, Array]:
    """The last of the proposals that were accepted, and which were."""

    def log_prob(x: Array) -> Array:
        return jnp.sum(density.sums(anchor, x, held))

    def information(x: Array) -> Array:
        slope = jax.jacfwd(lambda x: density.whitened(anchor, x, held))(x)
        return slope.T @ slope

    def step(x: Array, _: None) -> tuple[Array, None]:
        return x + jnp.linalg.solve(information(x), jax.grad(log_prob)(x)), None

    found, _ = jax.lax.scan(step, start, None, length=_STEPS)
    # steps that run away end in nan; proposals from the start are poor, and seen to be by `still`
    centre = jnp.where(jnp.all(jnp.isfinite(found)), found, start)
    root = jnp.linalg.cholesky(jnp.linalg.inv(information(centre)))
    at = centre + _WIDER * student @ root.T
    tail = 0.5 * (_DEGREES + len(start)) * jnp.log1p(jnp.sum(student**2, axis=1) / _DEGREES)
    log_ratio = jax.vmap(log_prob)(at) + tail
    log_ratio = jnp.where(jnp.isfinite(log_ratio), log_ratio, -jnp.inf)

    def choose(now: Array, k: Array) -> tuple[Array, Array]:
        took = chance[k - 1] < log_ratio[k] - log_ratio[now]
        return jnp.where(took, k, now), took

    last, took = jax.lax.scan(choose, jnp.zeros((), int), jnp.arange(1, len(at)))
    return at[last], took
