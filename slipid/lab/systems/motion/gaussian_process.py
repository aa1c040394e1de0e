"""Gaussian process with a Matern-3/2 kernel on at most a thousand windows (scikit-learn).

    k(x, x') = variance (1 + sqrt(3) d) exp(-sqrt(3) d),    d^2 = sum_i ((x_i - x'_i) / length_i)^2
    mean(x) = k(x, X) (K + noise I)^-1 y
    var(x) = k(x, x) + noise - k(x, X) (K + noise I)^-1 k(X, x)

X are the training inputs, y their outputs and K = k(X, X). All outputs, each divided by its
standard deviation, share one kernel. Hyperparameters maximise the marginal likelihood of
`MOST_TUNING_WINDOWS` windows, in at most `OPTIMISER_STEPS` steps from one start point; the
posterior is conditioned on `MOST_WINDOWS` windows. Windows are drawn in proportion to their weight,
with a fixed seed.

Source: Rasmussen, Williams 2006, Gaussian Processes for Machine Learning, MIT Press, equations
2.25, 2.26, 4.17 and 5.8.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.lab.systems.one_thread import one_thread

if TYPE_CHECKING:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import Kernel

MOST_WINDOWS = 1000
"""Largest number of windows in the posterior."""
MOST_TUNING_WINDOWS = 150
"""Largest number of windows to which hyperparameters are fitted."""
OPTIMISER_STEPS = 20
"""Largest number of optimiser steps in the fit of hyperparameters."""
SEED = 0

LENGTH_BOUNDS = (0.1, 100.0)
"""Bounds of the length scales, in units of the inputs."""
VARIANCE_BOUNDS = (1e-2, 1e2)
"""Bounds of the variance of the process, relative to the variance of the outputs."""
NOISE_BOUNDS = (1e-4, 2.0)
"""Bounds of the variance of the noise, relative to the variance of the outputs."""


def untuned_kernel(lengths: float | Float[np.ndarray, " input"], free: bool) -> "Kernel":
    """Return the kernel with which a fit of the hyperparameters starts.

    Args:
        lengths: length scale of each input, or a single one for all inputs.
        free: True if the length scales are fitted.
    """
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

    matern = Matern(lengths, LENGTH_BOUNDS if free else "fixed", nu=1.5)
    return ConstantKernel(1.0, VARIANCE_BOUNDS) * matern + WhiteKernel(0.1, NOISE_BOUNDS)


@dataclass(frozen=True, eq=False)
class ProcessRows:
    """Training data of a Gaussian process.

    Attributes:
        x: inputs.
        y: outputs.
        weight: weight of each row.
    """

    x: Float[np.ndarray, "row input"]
    y: Float[np.ndarray, "row output"]
    weight: Float[np.ndarray, " row"]

    def only(self, take: Bool[np.ndarray, " row"] | Int[np.ndarray, " some"]) -> "ProcessRows":
        """Return the rows that `take` selects: by True values, or by indices."""
        return ProcessRows(self.x[take], self.y[take], self.weight[take])

    def drawn(self, most: int) -> "ProcessRows":
        """Return at most `most` rows, drawn at random in proportion to their weight."""
        share, rng = self.weight / self.weight.sum(), np.random.default_rng(SEED)
        count = min(most, int(np.count_nonzero(share)))
        return self.only(rng.choice(len(share), count, replace=False, p=share))

    def tuned(self, kernel: "Kernel") -> "Kernel":
        """Return the kernel of largest marginal likelihood for a sample of the rows.

        The search starts from the given kernel.
        """
        from sklearn.exceptions import ConvergenceWarning

        with warnings.catch_warnings():
            # do not warn of a length scale at its upper bound: its input is merely irrelevant
            warnings.simplefilter("ignore", ConvergenceWarning)
            return self._fitted(kernel, MOST_TUNING_WINDOWS, _few_steps).kernel_

    def process(self, kernel: "Kernel") -> "GaussianProcessRegressor":
        """Return the posterior of the process given a sample of at most `MOST_WINDOWS` rows."""
        return self._fitted(kernel, MOST_WINDOWS, None)

    def _fitted(
        self, kernel: "Kernel", most: int, optimizer: Callable | None
    ) -> "GaussianProcessRegressor":
        from sklearn.gaussian_process import GaussianProcessRegressor

        some = self.drawn(most)
        process = GaussianProcessRegressor(kernel, optimizer=optimizer, normalize_y=True)
        with one_thread():
            return process.fit(some.x, some.y)


def fitted_numbers(process: "GaussianProcessRegressor") -> int:
    """Return the count of hyperparameters and of the entries of (K + noise I)^-1 y."""
    return process.kernel_.n_dims + process.alpha_.size


def _few_steps(
    loss: Callable, start: Float[np.ndarray, " log"], bounds: Float[np.ndarray, "log 2"]
) -> tuple[Float[np.ndarray, " log"], float]:
    """Return the minimiser and the loss after at most `OPTIMISER_STEPS` steps of L-BFGS-B.

    The function has the signature that scikit-learn expects of an optimiser. Its variables are
    logarithms of hyperparameters.
    """
    from scipy.optimize import minimize

    most = {"maxiter": OPTIMISER_STEPS}
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options=most)
    return found.x, float(found.fun)
