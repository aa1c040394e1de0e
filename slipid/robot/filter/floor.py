"""A floor map as a jitted function looks it up, and what it says of the floors and of the pose.

Where a map is known, the believed pose and its covariance say which floors are likely under the
wheels. Poses x_s drawn from the belief, fixed ones in its own axes, make of it a prior of every
hypothesis c, one floor under each wheel:

    W_sc ~ prod_wheel [(1 - leak) (map at the wheel of x_s is c's) + leak / floors],  sum_c W_sc = 1
    prior_c = mean_s W_sc

What the currents and the gyro of a step say of the hypotheses, p_c before and p_c' after it, says
how likely each pose is, beside how likely it was (`slipid.robot.filter.pose_fix.apply_map`):

    P(x_s) ~ (sum_c p_c' W_sc / prior_c  /  sum_c p_c W_sc / prior_c)^(1/4)

so that an edge that is crossed where it was not expected corrects the pose. Evidence counts in the
step in which it comes, and where none comes no pose moves.
"""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from zipfile import BadZipFile

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from slipid.support.errors import DataError
from slipid.support.files import write_bytes

LEAK = 0.1
"""Probability that a map is wrong under a wheel."""
HALF = 16
"""Pairs of opposite poses that are drawn from a belief."""


def _spread() -> Float[np.ndarray, "sample 3"]:
    """Poses in a belief's own axes: mean 0 and covariance 1, exactly."""
    some = np.random.default_rng(0).normal(size=(HALF, 3))
    some = some @ np.linalg.inv(np.linalg.cholesky(some.T @ some / HALF)).T
    return np.concatenate([some, -some])


SPREAD = _spread()


class Floor(eqx.Module):
    """Which surface lies where, as arrays a jitted function can look up.

    Attributes:
        cells: index of the surface in every square cell (row, column), row 0 at the lowest y; -1
            where it is none that the robot knows.
        corner: x, y of the corner with the lowest coordinates [m].
        cell: edge of a cell [m].
    """

    cells: Int[Array, "row column"]
    corner: Float[Array, "2"]
    cell: Float[Array, ""]

    @classmethod
    def of(
        cls,
        surfaces: Sequence[str],
        cells: Int[np.ndarray, "row column"],
        corner: tuple[float, float],
        cell: float,
        labels: Sequence[str],
    ) -> "Floor":
        """The map whose cells count its own surfaces, for a robot that knows these labels."""
        counted = [labels.index(name) if name in labels else -1 for name in surfaces]
        found = np.array(counted)[np.asarray(cells)]
        return cls(jnp.asarray(found), jnp.asarray(corner), jnp.asarray(cell))

    def save(self, path: Path | str, labels: Sequence[str]) -> None:
        """Write a map of a robot with these labels; numpy alone reads it again.

        Raises:
            DataError: nothing can be written there.
        """
        kept = {"cells": self.cells, "corner": self.corner, "cell": self.cell}
        out = BytesIO()
        np.savez_compressed(out, labels=np.array(labels), **jax.tree.map(np.asarray, kept))
        write_bytes(Path(path), out.getvalue())

    @classmethod
    def load(cls, path: Path | str, labels: Sequence[str]) -> "Floor":
        """The map of a file that `save` wrote, for a robot with these labels.

        Raises:
            DataError: the file is absent or no such map.
        """
        try:
            with np.load(BytesIO(Path(path).read_bytes()), allow_pickle=False) as kept:
                names = [*kept["labels"].tolist(), ""]  # -1 is none that was known
                place = tuple(kept["corner"].tolist()), float(kept["cell"])
                return cls.of(names, kept["cells"], *place, labels)
        except (
            OSError,
            ValueError,
            KeyError,
            IndexError,
            TypeError,
            EOFError,
            BadZipFile,
        ) as error:
            raise DataError(f"{path}: {error}; expected a map that Floor.save wrote") from error

    def under(
        self, pose: Float[Array, "3"], wheels: Float[Array, "wheel 2"]
    ) -> Int[Array, " wheel"]:
        """Surface under wheels at these places in the body frame [m], of a body at a pose.

        Beyond the edge it is that of the nearest cell.
        """
        row, column = self.cell_under(pose, wheels)
        return self.cells[row, column]

    def cell_under(
        self, pose: Float[Array, "3"], wheels: Float[Array, "wheel 2"]
    ) -> tuple[Int[Array, " wheel"], Int[Array, " wheel"]]:
        """Row and column of the cell under each wheel; beyond the edge those of the nearest."""
        row, column = self.steps_to(pose, wheels)
        rows, columns = self.cells.shape
        return row.clip(0, rows - 1), column.clip(0, columns - 1)

    def steps_to(
        self, pose: Float[Array, "3"], wheels: Float[Array, "wheel 2"]
    ) -> tuple[Int[Array, " wheel"], Int[Array, " wheel"]]:
        """Rows and columns from the corner to each wheel, also where there is no cell."""
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        turned = jnp.stack(
            [c * wheels[:, 0] - s * wheels[:, 1], s * wheels[:, 0] + c * wheels[:, 1]], axis=-1
        )
        steps = jnp.floor((pose[:2] + turned - self.corner) / self.cell).astype(jnp.int32)
        return steps[:, 1], steps[:, 0]

    def supports(
        self,
        pose: Float[Array, "3"],
        root: Float[Array, "3 3"],
        wheels: Float[Array, "wheel 2"],
        hypotheses: Int[np.ndarray, "hypothesis wheel"],
        floors: int,
    ) -> Float[Array, "sample hypothesis"]:
        """Probability W of every hypothesis by the map, at every pose drawn from a belief.

        Args:
            pose: believed; root: of its covariance, lower triangular.
            wheels: their places in the body frame [m].
            hypotheses: floor under every wheel; floors: how many there are.
        """
        poses = pose + SPREAD @ root.T
        under = jax.vmap(self.under, (0, None))(poses, wheels)
        same = under[:, None, :] == jnp.asarray(hypotheses)
        weight = jnp.prod((1 - LEAK) * same + LEAK / floors, axis=-1)
        return weight / jnp.sum(weight, axis=-1, keepdims=True)
