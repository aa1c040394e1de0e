"""How residuals of neighbouring windows scatter, and what each of them counts for."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.identify.fit.variances import DEGREES

CHANNELS = ("along", "across", "yaw")
"""The first columns of the residuals; those after them are currents of wheels."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """Where windows come from: run, place in it, and whether its currents were logged."""

    run: Int[np.ndarray, " window"]
    place: Int[np.ndarray, " window"]
    has_current: Bool[np.ndarray, " window"]


@dataclass(frozen=True, eq=False)
class Scatter:
    """How residuals scatter: what each counts for.

    The weight is the t weight of a residual's block, 0 where nothing was measured, `expected` its
    mean where the scatter is as found. Variances are of columns, wheels alike; the factor is
    windows over the number they are worth.
    """

    weight: Float[np.ndarray, "window channel"]
    expected: Float[np.ndarray, "window channel"]
    variance: Float[np.ndarray, " channel"]
    factor: Float[np.ndarray, " channel"]

    def counted(self, weight: np.ndarray) -> np.ndarray:
        return np.asarray(weight / (self.variance * self.factor))


def scatter(r: np.ndarray, of: Pieces, factor: np.ndarray | None) -> Scatter:
    """Variances and weights of residuals in turn, from their mean squares, then correlation.

    A factor that is given is kept: which lags count changes by jumps, and steps would not settle.
    """
    motion = np.arange(r.shape[1]) < len(CHANNELS)
    counts = np.where(motion, 1.0, of.has_current[:, None])
    weight, expected = counts.copy(), counts.copy()
    for _ in range(5):
        variance = _pooled(weight * r**2, counts)
        for block in (motion, ~motion):
            m = int(block.sum())
            q = (r[:, block] ** 2 / variance[block]).sum(axis=1)
            t = (DEGREES + m) / (DEGREES + q)
            weight[:, block] = counts[:, block] * t[:, None]
            expected[:, block] = counts[:, block] * (DEGREES + m) / (DEGREES + m + 2)
    scaled = np.where(counts > 0, np.sqrt(weight) * r / np.sqrt(variance), np.nan)
    if factor is not None:
        return Scatter(weight, expected, variance, factor)
    # what a motor's current is off all run long is the motor's: no floor is known better without it
    scaled[:, ~motion] -= _mean_of_runs(scaled[:, ~motion], of.run)
    factor = np.array([_dilution(column, of.run, of.place) for column in scaled.T])
    factor[~motion] = factor[~motion].max(initial=1.0)
    return Scatter(weight, expected, variance, factor)


def _mean_of_runs(x: np.ndarray, run: np.ndarray) -> Float[np.ndarray, "window channel"]:
    """Mean of every column over the run a window is of; nan counts for nothing."""
    there = np.isfinite(x)
    total, count = np.zeros((2, run.max() + 1, x.shape[1]))
    np.add.at(total, run, np.where(there, x, 0.0))
    np.add.at(count, run, there.astype(float))
    return np.asarray((total / np.maximum(count, 1.0))[run])


def _pooled(square: np.ndarray, counts: np.ndarray) -> Float[np.ndarray, " channel"]:
    """Mean squares of the columns; wheels share that of their currents."""
    total, number = square.sum(axis=0), counts.sum(axis=0)
    k = len(CHANNELS)
    total[k:], number[k:] = total[k:].sum(), number[k:].sum()
    return np.asarray(np.maximum(total / np.maximum(number, 1.0), 1e-12))


def _dilution(x: np.ndarray, run: np.ndarray, place: np.ndarray) -> float:
    """Windows over the number of independent ones that tell as much; at least 1.

    1 + 2 sum of the correlations over lags within runs, in pairs of lags while these are positive
    (Geyer 1992, Stat. Sci. 7, section 3.3). Residuals x, nan where nothing was measured, are taken
    about zero: of motion, what a whole run has in common counts as correlation.
    """
    grid = np.full((run.max() + 1, place.max() + 2), np.nan)
    grid[run, place] = x
    if not np.isfinite(grid).any():
        return 1.0
    power, longest = np.nanmean(grid**2), grid.shape[1]

    def correlation(lag: int) -> float:
        pairs = grid[:, lag:] * grid[:, : longest - lag]
        share = np.isfinite(pairs).sum() / np.isfinite(grid).sum()  # few pairs say little
        return float(np.nanmean(pairs) / power * share) if share > 0 else 0.0

    total = -1.0
    for lag in range(0, longest - 1, 2):
        pair = correlation(lag) + correlation(lag + 1)
        if pair <= 0:
            break
        total += 2 * pair
    return max(1.0, total)
