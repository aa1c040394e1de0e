"""Linear algebra of many small matrices inside compiled functions."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def inverse_root(v: Float[Array, "piece m m"]) -> Float[Array, "piece m m"]:
    """L^-1 of V = L L^T for many small matrices, all at once, column by column.

    Written out because batched LAPACK calls that run beside each other inside one compiled function
    can wait for each other for ever on a machine with two cores (seen with jax 0.10).
    """
    a = jnp.moveaxis(v, 0, -1)
    m = a.shape[0]
    rows = jnp.arange(m)[:, None]

    def column(j: Array, low: Array) -> Array:
        rest = a[:, j] - jnp.sum(low * low[j], axis=1)
        return low.at[:, j].set(jnp.where(rows >= j, rest / jnp.sqrt(rest[j]), 0.0))

    low = jax.lax.fori_loop(0, m, column, jnp.zeros_like(a))

    def row(i: Array, inverse: Array) -> Array:
        known = jnp.sum(low[i][:, None] * inverse, axis=0)
        return inverse.at[i].set(((rows == i) - known) / low[i, i])

    inverse = jax.lax.fori_loop(0, m, row, jnp.zeros_like(a))
    return jnp.moveaxis(inverse, -1, 0)
