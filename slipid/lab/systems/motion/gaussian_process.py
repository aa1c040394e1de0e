"""Gaussian process with a Matern-3/2 kernel on at most a thousand windows (scikit-learn).

    k(x, x') = variance (1 + sqrt(3) d) exp(-sqrt(3) d),    d^2 = sum_i ((x_i - x'_i) / length_i)^2
    mean(x) = k(x, X) (K + noise I)^-1 y
    var(x) = k(x, x) + noise - k(x, X) (K + noise I)^-1 k(X, x)

X are the training inputs, y their outputs and K = k(X, X). All outputs share one kernel, each in
units of its own standard deviation. Hyperparameters maximise the marginal likelihood of `TUNED`
windows, in at most `ROUNDS` steps from one start point; the posterior is conditioned on `KEPT`
windows. Windows are drawn in proportion to their weight, with a fixed seed.

Source: Rasmussen, Williams 2006, Gaussian Processes for RobotSpec Learning, MIT Press, equations
2.25, 2.26, 4.17 and 5.8.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from slipid.lab.systems.one_thread import one_thread

if TYPE_CHECKING:
    from sklearn.gaussian_process import GaussianProcessRegressor

KEPT = 1000
"""Largest number of windows in the posterior."""
TUNED = 150
"""Largest number of windows to which hyperparameters are fitted."""
ROUNDS = 20
"""Largest number of optimiser steps in the fit of hyperparameters."""
SEED = 0

LENGTHS = (0.1, 100.0)
"""Bounds of the length scales, in units of the inputs."""
VARIANCES = (1e-2, 1e2)
"""Bounds of the variance of the process, relative to the variance of the outputs."""
NOISES = (1e-4, 2.0)
"""Bounds of the variance of the noise, relative to the variance of the outputs."""


@dataclass(frozen=True)
class Kernel:
    """Hyperparameters of the process; variances are relative to the variance of the outputs.

    Attributes:
        lengths: length scale of each input, or a single one for all inputs.
        free: True if the length scales are fitted.
        variance: variance of the process.
        noise: variance of the measurement noise.
    """

    lengths: tuple[float, ...]
    free: bool
    variance: float = 1.0
    noise: float = 0.1

    @property
    def numbers(self) -> int:
        """Number of fitted hyperparameters."""
        return 2 + (len(self.lengths) if self.free else 0)

    def tuned(self, rows: "ProcessRows") -> "Kernel":
        """Return the kernel of largest marginal likelihood for a sample of the rows.

        The search starts from this kernel.
        """
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor

        some = rows.drawn(TUNED)
        start = GaussianProcessRegressor(
            _sklearn_kernel(self), optimizer=_few_steps, normalize_y=True
        )
        with one_thread(), warnings.catch_warnings():
            # a length scale at its upper bound only means that its input is irrelevant
            warnings.simplefilter("ignore", ConvergenceWarning)
            best = start.fit(some.x, some.y).kernel_
        return replace(
            self,
            lengths=tuple(np.atleast_1d(best.k1.k2.length_scale).tolist()),
            variance=float(best.k1.k1.constant_value),
            noise=float(best.k2.noise_level),
        )


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

    def only(self, take: Bool[np.ndarray, " row"]) -> "ProcessRows":
        """Return the rows where `take` is True."""
        return ProcessRows(self.x[take], self.y[take], self.weight[take])

    def drawn(self, most: int) -> "ProcessRows":
        """Return at most `most` rows, drawn at random in proportion to their weight."""
        share, rng = self.weight / self.weight.sum(), np.random.default_rng(SEED)
        count = min(most, int(np.count_nonzero(share)))
        some = rng.choice(len(share), count, replace=False, p=share)
        return ProcessRows(self.x[some], self.y[some], self.weight[some])


@dataclass(frozen=True, eq=False)
class ProcessPrediction:
    """Mean and standard deviation of predicted outputs, including measurement noise."""

    mean: Float[np.ndarray, "row output"]
    std: Float[np.ndarray, "row output"]


@dataclass(frozen=True, eq=False)
class GaussianProcess:
    """Posterior of a process given a sample of rows.

    Attributes:
        kernel: hyperparameters.
        known: rows on which the posterior is conditioned.
        regressor: scikit-learn's process.
    """

    kernel: Kernel
    known: ProcessRows
    regressor: "GaussianProcessRegressor"

    @classmethod
    def of(cls, rows: ProcessRows, kernel: Kernel) -> "GaussianProcess":
        """Return the posterior given a random sample of at most `KEPT` of the rows."""
        from sklearn.gaussian_process import GaussianProcessRegressor

        known, start = rows.drawn(KEPT), _sklearn_kernel(kernel)
        with one_thread():
            fitted = GaussianProcessRegressor(start, optimizer=None, normalize_y=True).fit(
                known.x, known.y
            )
        return cls(kernel, known, fitted)

    def predict(self, x: Float[np.ndarray, "row input"]) -> ProcessPrediction:
        """Return the predicted outputs at the inputs."""
        mean, std = self.regressor.predict(x, return_std=True)
        outputs = self.known.y.shape[1]
        return ProcessPrediction(mean.reshape(-1, outputs), std.reshape(-1, outputs))

    @property
    def numbers(self) -> int:
        """Number of fitted numbers: hyperparameters and the entries of (K + noise I)^-1 y."""
        return self.kernel.numbers + self.known.y.size


def _sklearn_kernel(kernel: Kernel) -> object:
    """Return the kernel in scikit-learn's form."""
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

    bounds = LENGTHS if kernel.free else "fixed"
    lengths = kernel.lengths[0] if len(kernel.lengths) == 1 else np.array(kernel.lengths)
    matern = Matern(lengths, bounds, nu=1.5)
    return ConstantKernel(kernel.variance, VARIANCES) * matern + WhiteKernel(kernel.noise, NOISES)


def _few_steps(
    loss: Callable, start: Float[np.ndarray, " log"], bounds: Float[np.ndarray, "log 2"]
) -> tuple[Float[np.ndarray, " log"], float]:
    """Return the minimiser and the loss after at most `ROUNDS` steps of L-BFGS-B.

    It is an optimiser in scikit-learn's form; the variables are logarithms of hyperparameters.
    """
    from scipy.optimize import minimize

    found = minimize(
        loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": ROUNDS}
    )
    return found.x, float(found.fun)
