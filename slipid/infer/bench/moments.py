"""Moments: sums of residuals times signals that share no noise with them, and their scatter.

Let r be the residual of a window, and z the signals that its coefficients multiply, in its even (e)
and its odd (o) rows. At the true numbers p

    E g = 0,    g(p) = sum over windows of (w_e z_o r_e(p) + w_o z_e r_o(p)) / 2,

whatever the noise of voltage, current and speed: none enters the mean. (Least squares has
E sum z r = -n R sigma_I^2 in it, and finds R too small.) As r is linear in the coefficients k(p),

    g(p) = h - G k(p).

Weights w of Student's t with 4 degrees of freedom reduce the effect of outliers. A weight depends
on its residual and not on the signals beside it, or it would bring back their noise. The
uncertainty of k depends on G with the derivative of w r in place of w.

The sum scatters with S = sum_k (1 - |k| / K) sum_c g_c g_c+k^T over cells c of time (Newey and West
1987), where K is longer than the correlation time of residuals: quantisation and a lasting misfit
widen it. A misfit over speed and current widens it as well: see `widened`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.infer.bench.windows import BenchWindows, HalfSignals

DEGREES = 4.0
"""Degrees of freedom of Student's t."""
FORGOTTEN = 0.05
"""Autocorrelation below which residuals count as uncorrelated."""
CELL_S = 0.01
"""Length of the cells of time, two strides of windows at least [s]."""
FEWEST = 12
"""Smallest number of correlation times in a record, or its scatter could not be estimated."""
SPEEDS, CURRENTS = 6, 4
"""Number of bins over speed, and over current within each, for misfits."""

Moments = Float[np.ndarray, " moment"]
Square = Float[np.ndarray, "moment moment"]


@dataclass(frozen=True, eq=False)
class HalfMoments:
    """Moments from the residuals of one half of the rows.

    Attributes:
        residual: residual of every window [V] or [A].
        weight: its weight.
        moments: its summand of g.
    """

    residual: Float[np.ndarray, " window"]
    weight: Float[np.ndarray, " window"]
    moments: Float[np.ndarray, "window moment"]


@dataclass(frozen=True, eq=False)
class MomentSums:
    """h and G of an equation, with the moments that they are sums of.

    Attributes:
        constant: h.
        slope: G.
        tangent: -dg / dk with the change of weights, which determines the uncertainty of k.
        even: moments from the residuals of even rows.
        odd: moments from the residuals of odd rows; both add up to g.
        scale: robust std of a residual of one half.
    """

    constant: Moments
    slope: Float[np.ndarray, "moment column"]
    tangent: Float[np.ndarray, "moment column"]
    even: HalfMoments
    odd: HalfMoments
    scale: float

    @property
    def moments(self) -> Float[np.ndarray, "window moment"]:
        return self.even.moments + self.odd.moments

    @property
    def residual(self) -> Float[np.ndarray, " window"]:
        """Weighted mean of the residuals of both halves."""
        return (self.even.weight * self.even.residual + self.odd.weight * self.odd.residual) / 2


def sums(w: BenchWindows, coefficients: Float[np.ndarray, " column"], signals: int) -> MomentSums:
    """Return the sums at some coefficients, with the first `signals` signals as instruments."""
    totals, halves = [], []
    for mine, other in ((w.even, w.odd), (w.odd, w.even)):
        residual = mine.measured - mine.signals @ coefficients
        scale = _scale(residual[w.usable])
        square = (residual / scale) ** 2
        weight = w.usable * (DEGREES + 1) / (DEGREES + square)
        z = other.signals[:, :signals] * (weight / 2)[:, None]
        bent = z * ((DEGREES - square) / (DEGREES + square))[:, None]
        totals.append((z.T @ mine.measured, z.T @ mine.signals, bent.T @ mine.signals, scale / 2))
        halves.append(HalfMoments(residual, weight, z * residual[:, None]))
    constant, slope, tangent, scale = (a + b for a, b in zip(*totals, strict=True))
    even, odd = halves
    return MomentSums(constant, slope, tangent, even, odd, scale)


def start(w: BenchWindows, count: int, rounds: int = 12) -> np.ndarray:
    """Return the first `count` coefficients that make their moments vanish, 0 for the others."""
    found = np.zeros(w.even.signals.shape[1])
    weight = [w.usable.astype(float)] * 2
    for _ in range(rounds):
        even, odd = w.even.signals[:, :count], w.odd.signals[:, :count]
        halves = ((w.even, odd, weight[0]), (w.odd, even, weight[1]))
        slope = sum(z.T @ (k[:, None] * half.signals[:, :count]) for half, z, k in halves)
        constant = sum(z.T @ (k * half.measured) for half, z, k in halves)
        found[:count] = np.linalg.lstsq(slope, constant, rcond=1e-10)[0]
        weight = [_weights(half, found, w.usable) for half in (w.even, w.odd)]
    return found


def _weights(half: HalfSignals, coefficients: np.ndarray, usable: np.ndarray) -> np.ndarray:
    residual = half.measured - half.signals @ coefficients
    return np.asarray(
        usable * (DEGREES + 1) / (DEGREES + (residual / _scale(residual[usable])) ** 2)
    )


def _scale(residual: np.ndarray) -> float:
    """Return a robust std, at least rounding errors of numbers of order one."""
    return max(1.4826 * float(np.median(np.abs(residual))) if len(residual) else 1.0, 1e-9)


def celled(
    each: Float[np.ndarray, "window moment"], w: BenchWindows, length: float
) -> Float[np.ndarray, "cell moment"]:
    """Return sums over cells of time of a given length [s], record by record."""
    place = np.floor(w.time / length).astype(int)
    ends = [int(place[w.record == k].max(initial=-1)) + 1 for k in range(int(w.record.max()) + 1)]
    place = place + np.concatenate([[0], np.cumsum(ends)])[w.record]
    total = np.zeros((int(place.max(initial=-1)) + 1, each.shape[1]))
    np.add.at(total, place, each)
    return total


def cell_length(windows: Sequence[BenchWindows]) -> float:
    """Return the length of cells that hold some windows each [s]."""
    strides = [float(np.median(np.diff(w.time))) for w in windows if len(w.time) > 1]
    return max(CELL_S, *(2 * s for s in strides))


def correlation_cells(x: Float[np.ndarray, " cell"]) -> int:
    """Return the correlation time of a signal [cell]: 1 + 2 sum of its autocorrelations."""
    most = len(x) // FEWEST
    size = 1 << (2 * len(x)).bit_length()
    power = np.abs(np.fft.rfft(x - x.mean(), size)) ** 2
    correlation = np.fft.irfft(power, size)[: most + 1]
    if len(correlation) < 2 or correlation[0] <= 0:
        return 1
    correlation = correlation / correlation[0]
    low = np.flatnonzero(correlation < FORGOTTEN)
    end = int(low[0]) if len(low) else most + 1
    return int(np.ceil(1 + 2 * correlation[1:end].sum()))


def scatter(g: Float[np.ndarray, "cell moment"], lags: int) -> Square:
    """Return the covariance of the sum of cells whose correlation time is about half of `lags`."""
    s = g.T @ g
    for k in range(1, min(lags, len(g))):
        c = g[:-k].T @ g[k:]
        s = s + (1 - k / lags) * (c + c.T)
    lengths, count = len(g) / lags, g.shape[1]
    return np.asarray(s * (lengths / max(lengths - count, lengths / 2)))


def widened(s: Square, groups: Float[np.ndarray, "group moment"]) -> Square:
    """Return the scatter, at least that between groups of windows of similar speed and current.

    Noise scatters as much between groups as between cells of time, up to chance; a misfit scatters
    more between groups. Along each direction the larger scatter counts.
    """
    root = np.linalg.cholesky(s + 1e-12 * np.diag(np.diag(s) + 1e-300))
    white = np.linalg.solve(root, groups.T)
    value, vector = np.linalg.eigh(white @ white.T)
    chance = (1 + np.sqrt(len(s) / max(len(groups), 1))) ** 2
    axes = root @ vector
    return np.asarray(axes * np.maximum(value / chance, 1.0) @ axes.T)


def grouped(s: MomentSums, w: BenchWindows) -> Float[np.ndarray, "group moment"]:
    """Return sums over windows of similar speed, and among these of similar current.

    Groups have about equal sizes. The rows that a residual is not computed from determine the
    group of its window, or its own noise would sort residuals.
    """
    total = np.zeros((SPEEDS * CURRENTS, s.even.moments.shape[1]))
    for half, other in ((s.even, w.odd), (s.odd, w.even)):
        group = np.zeros(len(w.time), int)
        for k, some in enumerate(np.array_split(np.argsort(other.speed, kind="stable"), SPEEDS)):
            within = some[np.argsort(other.current[some], kind="stable")]
            for j, few in enumerate(np.array_split(within, CURRENTS)):
                group[few] = k * CURRENTS + j
        np.add.at(total, group, half.moments)
    return total
