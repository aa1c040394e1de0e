"""Noise of steps between poses: neighbours share the pose between them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cholesky_banded, solve_banded


@dataclass(frozen=True, eq=False)
class StepNoise:
    """What scatters in the steps of one component.

    Attributes:
        seen: variance of where the body was seen, which two neighbouring steps share.
        own: variance of each step of its own, as of slip.
    """

    seen: float
    own: float

    @classmethod
    def of(cls, left: Float[np.ndarray, " step"], joined: Bool[np.ndarray, " step"]) -> "StepNoise":
        """From what is left over of steps; those that are `joined` begin where the last ended."""
        whole = max(float((left**2).mean()), 1e-12)
        neighbours = (left[1:] * left[:-1])[joined[1:]]
        seen = float(np.clip(-neighbours.mean(), 0.0, 0.499 * whole)) if len(neighbours) else 0.0
        return cls(seen, whole - 2.0 * seen)

    def whitened(
        self, rows: Float[np.ndarray, "step column"], joined: Bool[np.ndarray, " step"]
    ) -> Float[np.ndarray, "step column"]:
        """Columns times the inverse root of the covariance: 2 seen + own, and -seen beside it."""
        beside = np.where(joined[1:], -self.seen, 0.0)
        band = np.stack([np.full(len(rows), 2.0 * self.seen + self.own), np.append(beside, 0.0)])
        return np.asarray(solve_banded((1, 0), cholesky_banded(band, lower=True), rows))
