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


@jax.custom_vjp
def squares(
    v: Float[Array, "m m piece"], r: Float[Array, "m piece"]
) -> tuple[Float[Array, " piece"], Float[Array, " piece"]]:
    """Log |V| and r^T V^-1 r of many small matrices, pieces last.

    Columns of L and of L^-1 r, one after the other; the columns are few enough to be written out.
    The derivative backwards is V^-1 and -V^-1 r r^T V^-1 (reverse mode only): going back through
    the columns takes longer.
    """
    columns = _columns(jnp.concatenate([v, r[None]]))
    log_det = jnp.sum(jnp.stack([2 * jnp.log(c[0]) for c in columns]), axis=0)
    return log_det, jnp.sum(jnp.stack([c[-1] ** 2 for c in columns]), axis=0)


def _columns(rows: Float[Array, "row m piece"]) -> list[Array]:
    """Columns of L from the diagonal on; rows after the m-th are L^-1 times what they were."""
    columns: list[Array] = []
    for j in range(rows.shape[1]):
        c = rows[j:, j]
        if columns:
            known = jnp.stack([old[j - k :] for k, old in enumerate(columns)], axis=1)
            c = c - jnp.sum(known * known[:1], axis=1)
        columns.append(jax.lax.optimization_barrier(c * jax.lax.rsqrt(c[0])))
    return columns


def _squares_backward(kept: tuple[Array, Array], slope: tuple[Array, Array]) -> tuple[Array, Array]:
    v, r = kept
    low, inverse = _columns(v), []
    for i in range(len(low)):  # rows of L^-1
        row = jnp.zeros_like(v[0]).at[i].set(1.0)
        for k in range(i):
            row = row.at[: k + 1].add(-low[k][i - k] * inverse[k][: k + 1])
        inverse.append(jax.lax.optimization_barrier(row / low[i][0]))
    root = jnp.stack(inverse)
    precision = jnp.einsum("iap,ibp->abp", root, root)
    w = jnp.sum(precision * r, axis=1)
    return slope[0] * precision - slope[1] * w[:, None] * w, 2 * slope[1] * w


squares.defvjp(lambda v, r: (squares(v, r), (v, r)), _squares_backward)
