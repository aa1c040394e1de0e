"""Draws of a posterior, and where they contradict its Gaussian approximation."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Z95 = 1.6448536269514722
"""The 95 % quantile of a standard Gaussian."""
LEAST_EFFECTIVE = 1.25
"""Smallest number of effective draws per walker for which draws are of use.

Walkers that stay where they start have one."""
QUANTILE_ERROR = 2.11
"""Standard error of a Gaussian's 5 % quantile from n independent draws, times sqrt(n) [std]."""
CONTRADICTION = 2.5
"""Difference between an end of the interval of the draws and of the Gaussian approximation above
which they contradict each other [standard error]."""


def some_of(
    flat: Float[np.ndarray, "draw size"], count: int, seed: int = 0
) -> Float[np.ndarray, "some size"]:
    """Return some draws at random, each once if there are enough."""
    rows = np.random.default_rng(seed).choice(len(flat), count, replace=len(flat) < count)
    return flat[rows]


class Draws(NamedTuple):
    """Draws of the search vector, or of linear combinations of it, by the walkers of a chain."""

    z: Float[np.ndarray, "walker step size"]

    @property
    def flat(self) -> Float[np.ndarray, "draw size"]:
        """Draws of all walkers in one array."""
        return self.z.reshape(-1, self.z.shape[-1])

    @property
    def effective(self) -> Float[np.ndarray, " size"]:
        """Number of independent draws whose mean has the same variance, at most that of all draws.

        It follows from the scatter of the walkers' means, as if walkers were independent.
        """
        of_means = self.z.mean(axis=1).var(axis=0, ddof=1)
        ratio = self.flat.var(axis=0) / np.maximum(of_means, np.finfo(float).tiny)
        return np.minimum(len(self.z) * ratio, len(self.flat))

    @property
    def useful(self) -> bool:
        """True if the draws are finite and enough."""
        if not np.isfinite(self.z).all():
            return False
        return bool((self.effective >= LEAST_EFFECTIVE * len(self.z)).all())

    def contradict(
        self, mean: Float[np.ndarray, " size"], covariance: Float[np.ndarray, "size size"]
    ) -> bool:
        """Return whether 90 % intervals of the draws differ from those of a Gaussian.

        The differences are larger than the sampling error of the draws explains, along a coordinate
        or a principal direction of the covariance.
        """
        size = len(mean)
        onto = np.eye(size)
        if size > 1:
            onto = np.concatenate([onto, np.linalg.eigh(covariance)[1]], axis=1)
        turned = Draws(self.z @ onto)
        half = Z95 * np.sqrt(np.einsum("ad,ab,bd->d", onto, covariance, onto))
        ends = mean @ onto + np.stack([-half, half])
        off = np.abs(np.quantile(turned.flat, [0.05, 0.95], axis=0) - ends)
        error = QUANTILE_ERROR * turned.flat.std(axis=0) / np.sqrt(turned.effective)
        return bool((off > CONTRADICTION * error).any())
