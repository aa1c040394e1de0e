"""Linear algebra of many small matrices inside compiled functions."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def inverse_root(v: Float[Array, "piece m m"]) -> Float[Array, "piece m m"]:
    """L^-1 of V = L L^T for many small matrices, all at once, column by column.

    Written out because batched LAPACK calls that run beside each other inside one compiled function
    can wait for each other for ever on a machine with two cores (seen with jax 0.10).
    """
    a = jnp.moveaxis(v, 0, -1)
    m = a.shape[0]
    low = jnp.zeros_like(a)
    for j in range(m):
        rest = a[j:, j] - jnp.sum(low[j:, :j] * low[j, :j], axis=1)
        low = low.at[j:, j].set(rest / jnp.sqrt(rest[0]))
    inverse = jnp.zeros_like(a)
    eye = jnp.eye(m)
    for i in range(m):
        known = jnp.sum(low[i, :i, None] * inverse[:i], axis=0)
        inverse = inverse.at[i].set((eye[i][:, None] - known) / low[i, i])
    return jnp.moveaxis(inverse, -1, 0)
