"""A Gaussian process with a Matern-3/2 kernel learns from a thousand windows (scikit-learn).

    k(x, x') = variance (1 + sqrt(3) d) exp(-sqrt(3) d),    d^2 = sum_i ((x_i - x'_i) / length_i)^2
    mean(x) = k(x, X) (K + noise I)^-1 y
    var(x) = k(x, x) + noise - k(x, X) (K + noise I)^-1 k(X, x)

All outputs share one kernel, each in units of its own standard deviation. Hyperparameters maximise
the marginal likelihood of `TUNED` windows, in at most `ROUNDS` steps from one start; `KEPT` windows
make the posterior. Windows are drawn in proportion to how much they count, with a fixed seed.

Source: Rasmussen, Williams 2006, Gaussian Processes for Machine Learning, MIT Press, equations
2.25, 2.26, 4.17 and 5.8.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

KEPT = 1000
TUNED = 150
ROUNDS = 20
SEED = 0

LENGTHS = (0.1, 100.0)
VARIANCES = (1e-2, 1e2)
NOISES = (1e-4, 2.0)
"""Bounds of the hyperparameters, variances in units of the outputs' variance."""


@runtime_checkable
class ProcessRegressor(Protocol):
    """What is used of scikit-learn's Gaussian process."""

    def predict(
        self, X: np.ndarray, return_std: bool = False, return_cov: bool = False
    ) -> tuple[np.ndarray, np.ndarray]: ...


@dataclass(frozen=True)
class Kernel:
    """Hyperparameters, variances in units of the outputs' variance.

    Attributes:
        lengths: one for each input, or a single one for all.
        free: whether the lengths are fitted.
    """

    lengths: tuple[float, ...]
    free: bool
    variance: float = 1.0
    noise: float = 0.1

    @property
    def numbers(self) -> int:
        """How many of them are fitted."""
        return 2 + (len(self.lengths) if self.free else 0)

    def tuned(self, rows: "ProcessRows") -> "Kernel":
        """The kernel that makes a sample of the rows most likely, found from this one."""
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from threadpoolctl import threadpool_limits

        some = rows.drawn(TUNED)
        start = GaussianProcessRegressor(_written(self), optimizer=_climbed, normalize_y=True)
        with threadpool_limits(1), warnings.catch_warnings():
            # a length at its bound is an input that does not matter, which is no news
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
    """Inputs and outputs of which a process is made, and how much each row counts."""

    x: Float[np.ndarray, "row input"]
    y: Float[np.ndarray, "row output"]
    weight: Float[np.ndarray, " row"]

    def only(self, mine: Bool[np.ndarray, " row"]) -> "ProcessRows":
        return ProcessRows(self.x[mine], self.y[mine], self.weight[mine])

    def drawn(self, most: int) -> "ProcessRows":
        """So many rows at most, drawn in proportion to how much they count."""
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
    """A process that knows a sample of rows.

    Attributes:
        kernel: its hyperparameters.
        known: the rows.
        regressor: scikit-learn's.
    """

    kernel: Kernel
    known: ProcessRows
    regressor: ProcessRegressor

    @classmethod
    def of(cls, rows: ProcessRows, kernel: Kernel) -> "GaussianProcess":
        from sklearn.gaussian_process import GaussianProcessRegressor
        from threadpoolctl import threadpool_limits

        known = rows.drawn(KEPT)
        regressor = GaussianProcessRegressor(_written(kernel), optimizer=None, normalize_y=True)
        with threadpool_limits(1):
            regressor.fit(known.x, known.y)
        return cls(kernel, known, regressor)

    def predict(self, x: Float[np.ndarray, "row input"]) -> ProcessPrediction:
        mean, std = self.regressor.predict(x, return_std=True)
        outputs = self.known.y.shape[1]
        return ProcessPrediction(mean.reshape(-1, outputs), std.reshape(-1, outputs))

    @property
    def numbers(self) -> int:
        """Hyperparameters, and (K + noise I)^-1 y."""
        return self.kernel.numbers + self.known.y.size


def _written(kernel: Kernel) -> object:
    """The kernel as scikit-learn writes it."""
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

    bounds = LENGTHS if kernel.free else "fixed"
    lengths = kernel.lengths[0] if len(kernel.lengths) == 1 else np.array(kernel.lengths)
    matern = Matern(lengths, bounds, nu=1.5)
    return ConstantKernel(kernel.variance, VARIANCES) * matern + WhiteKernel(kernel.noise, NOISES)


def _climbed(
    loss: Callable, start: Float[np.ndarray, " log"], bounds: Float[np.ndarray, "log 2"]
) -> tuple[Float[np.ndarray, " log"], float]:
    """Logarithms of the hyperparameters after a few steps, in the form scikit-learn asks for."""
    from scipy.optimize import minimize

    found = minimize(
        loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": ROUNDS}
    )
    return found.x, float(found.fun)
