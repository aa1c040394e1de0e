"""A floor map for jitted functions, and its evidence about floors and pose.

With a map, the estimated pose and its covariance determine which floors are likely under the
wheels. Pose samples x_s are a fixed set of standard samples, scaled by the root of the covariance.
The map gives the probability W_sc of every hypothesis c (a floor for each wheel) at each sample
x_s; the mean over samples is the prior of c. [...] is 1 if its content is true, else 0, and `leak`
is `MAP_ERROR`:

    W_sc ~ prod_wheel ((1 - leak) [map at the wheel of x_s is c's] + leak / floors),  sum_c W_sc = 1
    prior_c = mean_s W_sc

Currents and gyro of a step change the probability of a hypothesis from p_c to p_c'. This in turn
changes the probability P of each pose sample (`slipid.robot.filter.pose_fix.apply_map`):

    P(x_s) ~ (sum_c p_c' W_sc / prior_c  /  sum_c p_c W_sc / prior_c)^(1/4)

so that crossing an edge at an unexpected position corrects the pose. Evidence corrects the pose
only in the step in which it is measured; without evidence the map does not change the pose.
"""

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from slipid.support.errors import DataError
from slipid.support.files import read_arrays, write_arrays

MAP_ERROR = 0.1
"""Probability that the map shows the wrong floor under a wheel [1]."""
SAMPLE_PAIRS = 16
"""Number of pairs of opposite pose samples."""


def _spread() -> Float[np.ndarray, "sample 3"]:
    """Return pose samples whose mean is exactly 0 and whose covariance is exactly the identity."""
    draws = np.random.default_rng(0).normal(size=(SAMPLE_PAIRS, 3))
    draws = draws @ np.linalg.inv(np.linalg.cholesky(draws.T @ draws / SAMPLE_PAIRS)).T
    return np.concatenate([draws, -draws])


SPREAD = _spread()
"""Standard pose samples; the root of a covariance scales them to samples of a pose."""


class Floor(eqx.Module):
    """Map of surfaces as arrays that a jitted function can look up.

    Attributes:
        cells: index of the surface in every square cell (row, column), row 0 at the lowest y; -1
            for a surface that was not identified.
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
        """Return the map with surfaces numbered as in `labels`, from indices into `surfaces`."""
        numbers = [labels.index(name) if name in labels else -1 for name in surfaces]
        numbered = np.array(numbers)[np.asarray(cells)]
        return cls(jnp.asarray(numbered), jnp.asarray(corner), jnp.asarray(cell))

    def save(self, path: Path | str, labels: Sequence[str]) -> None:
        """Write the map of a robot with the floors `labels` as a file that numpy can read.

        Raises:
            DataError: the file cannot be written.
        """
        arrays = {name: np.asarray(array) for name, array in vars(self).items()}
        write_arrays(Path(path), {"labels": np.array(labels), **arrays})

    @classmethod
    def load(cls, path: Path | str, labels: Sequence[str]) -> "Floor":
        """Return the map in a file written by `save`, for a robot with the floors `labels`.

        Raises:
            DataError: the file is absent or was not written by `save`.
        """
        expected = "a map written by Floor.save"
        kept = read_arrays(Path(path), expected)
        names, corner, cell, cells = (
            kept.get(name, np.zeros(0)) for name in ("labels", "corner", "cell", "cells")
        )
        shapes = (names.ndim, corner.shape, cell.shape, cells.ndim) == (1, (2,), (), 2)
        kinds = (names.dtype.kind, corner.dtype.kind, cell.dtype.kind) == ("U", "f", "f")
        if not (shapes and kinds and cells.dtype.kind == "i" and cells.size):
            raise DataError(f"{path}: arrays of other names, shapes or types; expected {expected}")
        finite = np.isfinite(corner).all() and np.isfinite(cell) and cell > 0
        if not finite or cells.min() < -1 or cells.max() >= len(names):
            raise DataError(
                f"{path}: corner {corner}, cell {cell}, floors {cells.min()} to {cells.max()}; "
                f"expected finite numbers, a positive cell and floors of -1 to {len(names) - 1}"
            )
        # index -1, an unknown surface, picks the last name, "", which is no label
        return cls.of([*names.tolist(), ""], cells, tuple(corner.tolist()), float(cell), labels)

    def under(
        self, pose: Float[Array, "3"], wheels: Float[Array, "wheel 2"]
    ) -> Int[Array, " wheel"]:
        """Return the index of the surface under each wheel of a robot at a pose.

        Outside the map the nearest cell determines the surface.

        Args:
            pose: x, y [m] and heading [rad].
            wheels: positions of the wheels in the body frame [m].
        """
        (row, column), (rows, columns) = self.steps_to(pose, wheels), self.cells.shape
        return self.cells[row.clip(0, rows - 1), column.clip(0, columns - 1)]

    def steps_to(
        self, pose: Float[Array, "3"], wheels: Float[Array, "wheel 2"]
    ) -> tuple[Int[Array, " wheel"], Int[Array, " wheel"]]:
        """Return the row and the column of the cell under each wheel, possibly off the map."""
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
        """Return the probability W_sc that the map gives each hypothesis c at each pose sample s.

        Args:
            pose: estimated pose [m, m, rad].
            root: lower triangular root of the pose's covariance.
            wheels: positions of the wheels in the body frame [m].
            hypotheses: index of the floor under every wheel in each hypothesis.
            floors: number of floors.
        """
        poses = pose + SPREAD @ root.T
        under = jax.vmap(self.under, (0, None))(poses, wheels)
        same = under[:, None, :] == jnp.asarray(hypotheses)
        weight = jnp.prod((1 - MAP_ERROR) * same + MAP_ERROR / floors, axis=-1)
        return weight / jnp.sum(weight, axis=-1, keepdims=True)
