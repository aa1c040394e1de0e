"""Gaussian process with a Matern-3/2 kernel on at most a thousand windows (scikit-learn).

    k(x, x') = variance (1 + sqrt(3) d) exp(-sqrt(3) d),    d^2 = sum_i ((x_i - x'_i) / length_i)^2
    mean(x) = k(x, X) (K + noise I)^-1 y
    var(x) = k(x, x) + noise - k(x, X) (K + noise I)^-1 k(X, x)

All outputs share one kernel, each in units of its own standard deviation. Hyperparameters maximise
the marginal likelihood of `TUNED` windows, in at most `ROUNDS` steps from one start; `KEPT` windows
make the posterior. Windows are drawn in proportion to their weight, with a fixed seed.

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
TUNED = 150
ROUNDS = 20
SEED = 0

LENGTHS = (0.1, 100.0)
VARIANCES = (1e-2, 1e2)
NOISES = (1e-4, 2.0)
"""Bounds of the hyperparameters, variances in units of the outputs' variance."""


@dataclass(frozen=True)
class Kernel:
    """Hyperparameters, variances in units of the outputs' variance.

    Attributes:
        lengths: length scale of each input, or a single one for all.
        free: the lengths are fitted.
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
        """Return the most likely kernel for a sample of the rows, found from this one."""
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor

        some = rows.drawn(TUNED)
        start = GaussianProcessRegressor(
            _sklearn_kernel(self), optimizer=_few_steps, normalize_y=True
        )
        with one_thread(), warnings.catch_warnings():
            # a length at its bound means an irrelevant input, which needs no warning
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
    """Training rows of a process.

    Attributes:
        x: inputs.
        y: outputs.
        weight: weight of each row.
    """

    x: Float[np.ndarray, "row input"]
    y: Float[np.ndarray, "row output"]
    weight: Float[np.ndarray, " row"]

    def only(self, take: Bool[np.ndarray, " row"]) -> "ProcessRows":
        """Return some of the rows."""
        return ProcessRows(self.x[take], self.y[take], self.weight[take])

    def drawn(self, most: int) -> "ProcessRows":
        """Return at most so many rows, drawn in proportion to their weight."""
        share, rng = self.weight / self.weight.sum(), np.random.default_rng(SEED)
        count = min(most, int(np.count_nonzero(share)))
        some = rng.choice(len(share), count, replace=False, p=share)
        return ProcessRows(self.x[some], self.y[some], self.weight[some])


@dataclass(frozen=True, eq=False)
class ProcessPrediction:
    """Mean and standard deviation of a new measurement, its noise included."""

    mean: Float[np.ndarray, "row output"]
    std: Float[np.ndarray, "row output"]


@dataclass(frozen=True, eq=False)
class GaussianProcess:
    """Posterior of a process given a sample of rows.

    Attributes:
        kernel: hyperparameters.
        known: the sample of rows.
        regressor: scikit-learn's process.
    """

    kernel: Kernel
    known: ProcessRows
    regressor: "GaussianProcessRegressor"

    @classmethod
    def of(cls, rows: ProcessRows, kernel: Kernel) -> "GaussianProcess":
        """Return the posterior given at most `KEPT` of some rows."""
        from sklearn.gaussian_process import GaussianProcessRegressor

        known, start = rows.drawn(KEPT), _sklearn_kernel(kernel)
        with one_thread():
            fitted = GaussianProcessRegressor(start, optimizer=None, normalize_y=True).fit(
                known.x, known.y
            )
        return cls(kernel, known, fitted)

    def predict(self, x: Float[np.ndarray, "row input"]) -> ProcessPrediction:
        """Return the prediction at some inputs."""
        mean, std = self.regressor.predict(x, return_std=True)
        outputs = self.known.y.shape[1]
        return ProcessPrediction(mean.reshape(-1, outputs), std.reshape(-1, outputs))

    @property
    def numbers(self) -> int:
        """Number of hyperparameters and of entries of (K + noise I)^-1 y."""
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
    """Return logarithms of the hyperparameters and the loss after at most `ROUNDS` steps."""
    from scipy.optimize import minimize

    found = minimize(
        loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": ROUNDS}
    )
    return found.x, float(found.fun)
