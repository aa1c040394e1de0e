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


def squares(
    v: Float[Array, "m m piece"], r: Float[Array, "m piece"]
) -> tuple[Float[Array, " piece"], Float[Array, " piece"]]:
    """Log |V| and r^T V^-1 r of many small matrices, pieces last.

    Columns of L and of L^-1 r, one after the other; the columns are few enough to be written out.
    """
    rows = jnp.concatenate([v, r[None]])
    columns: list[Array] = []
    log_det, square = jnp.zeros(v.shape[-1]), jnp.zeros(v.shape[-1])
    for j in range(v.shape[0]):
        c = rows[j:, j]
        if columns:
            known = jnp.stack([old[j - k :] for k, old in enumerate(columns)], axis=1)
            c = c - jnp.sum(known * known[:1], axis=1)
        c = jax.lax.optimization_barrier(c * jax.lax.rsqrt(c[0]))
        columns.append(c)
        log_det += 2 * jnp.log(c[0])
        square += c[-1] ** 2
    return log_det, square
