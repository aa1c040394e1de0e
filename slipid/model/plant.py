"""Which floor lies where, as arrays a compiled function can look up."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class Floor(eqx.Module):
    """Which surface lies where, as arrays a jitted function can look up.

    Attributes:
        cells: index of the surface in every square cell (row, column), row 0 at the lowest y.
        corner: x, y of the corner with the lowest coordinates [m].
        cell: edge of a cell [m].
    """

    cells: Int[Array, "row column"]
    corner: Float[Array, "2"]
    cell: Float[Array, ""]

    def at(self, place: Float[Array, "*batch 2"]) -> Int[Array, "*batch"]:
        """Surface at places [m]; beyond the edge that of the nearest cell."""
        steps = jnp.floor((place - self.corner) / self.cell).astype(jnp.int32)
        rows, columns = self.cells.shape
        row, column = steps[..., 1].clip(0, rows - 1), steps[..., 0].clip(0, columns - 1)
        return self.cells[row, column]

    def under(
        self, pose: Float[Array, "3"], wheels: Float[Array, "wheel 2"]
    ) -> Int[Array, " wheel"]:
        """Surface under wheels at these places in the body frame [m], of a body at a pose."""
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        turned = jnp.stack(
            [c * wheels[:, 0] - s * wheels[:, 1], s * wheels[:, 0] + c * wheels[:, 1]], axis=-1
        )
        return self.at(pose[:2] + turned)
