"""Draws of a posterior, and where they contradict its Gaussian approximation."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Z95 = 1.6448536269514722
"""The 95 % quantile of a standard Gaussian."""
LEAST_EFFECTIVE = 50.0
"""Smallest number of effective draws of every number for which draws are of use."""
QUANTILE_ERROR = 2.11
"""Standard error of a Gaussian's 5 % quantile from n independent draws, times sqrt(n) [std]."""
CONTRADICTION = 2.0
"""Difference between an end of the interval of the draws and of the Gaussian approximation above
which they contradict each other [standard error]."""


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

        It follows from the scatter of the means of independent walkers.
        """
        of_means = self.z.mean(axis=1).var(axis=0, ddof=1)
        ratio = self.flat.var(axis=0) / np.maximum(of_means, np.finfo(float).tiny)
        return np.minimum(len(self.z) * ratio, len(self.flat))

    @property
    def useful(self) -> bool:
        """True if the draws are finite and enough."""
        free = self.flat.std(axis=0) > 0
        enough = (self.effective >= LEAST_EFFECTIVE) | ~free
        return bool(np.isfinite(self.z).all() and enough.all())

    def contradict(
        self, mean: Float[np.ndarray, " size"], covariance: Float[np.ndarray, "size size"]
    ) -> bool:
        """Return whether 90 % intervals of the draws differ from those of a Gaussian.

        The differences are larger than the sampling error of the draws explains.
        """
        half = Z95 * np.sqrt(np.diag(covariance))
        off = np.quantile(self.flat, [0.05, 0.95], axis=0) - (mean + np.stack([-half, half]))
        error = QUANTILE_ERROR * self.flat.std(axis=0) / np.sqrt(self.effective)
        return bool((np.abs(off) > CONTRADICTION * error).any())
