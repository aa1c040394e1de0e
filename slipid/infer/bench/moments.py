"""Moments: sums of residuals times signals with independent noise, and the covariance of the sums.

Let r be the residual of a window, and z the signals that the coefficients of its equation multiply,
in its even (e) and its odd (o) rows. At the true parameters p

    E g = 0,    g(p) = sum over windows of (w_e z_o r_e(p) + w_o z_e r_o(p)) / 2,

whatever the noise of voltage, current and speed, since r and z come from different rows. (The
normal equations of least squares have E sum z r = -n R sigma_I^2 instead of 0, and their R is too
small.)
As r is linear in the coefficients k(p),

    g(p) = h - G k(p).

Weights w of Student's t with 4 degrees of freedom reduce the effect of outliers. A weight depends
on the residual r only and not on the signals z that multiply r: the noise of z would otherwise
correlate with the weight. The uncertainty of k depends on G with d(w r)/dr in place of w.

The covariance of the sum is S = sum_k (1 - |k| / K) sum_c g_c g_c+k^T over cells c of time (Newey
and West 1987), where K is longer than the correlation time of residuals. Quantisation and a lasting
misfit make S larger. A misfit over speed and current makes S larger, too: see `widened`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.infer.bench.motor import VOLTS
from slipid.infer.bench.windows import BenchWindows

DEGREES = 4.0
"""Degrees of freedom of Student's t in the weights."""
UNCORRELATED = 0.05
"""Autocorrelation below which residuals count as uncorrelated."""
CELL_S = 0.01
"""Smallest length of the cells of time, over which moments are summed [s]."""
FEWEST_TIMES = 12
"""Smallest ratio of a record's length to the estimated correlation time.

Longer correlation times are not considered, since the covariance could not be estimated then."""
SPEEDS, CURRENTS = 6, 4
"""Numbers of bins over speed, and over current within each bin of speed, for the detection of
misfits."""

Moments = Float[np.ndarray, " moment"]
Square = Float[np.ndarray, "moment moment"]


@dataclass(frozen=True, eq=False)
class Equation:
    """One of the two equations of a motor at given coefficients k: its moments g = h - G k.

    Attributes:
        windows: windows of the records, with the signals of the equation.
        constant: vector h.
        slope: matrix G.
        tangent: -dg / dk, including the change of weights; it determines the uncertainty of k.
        residual: residual of every window [V] or [A], from its even and from its odd rows.
        weight: weight of every residual.
        terms: summand of every residual in g.
        scale: robust std of the residuals, averaged over even and odd rows.
    """

    windows: BenchWindows
    constant: Moments
    slope: Float[np.ndarray, "moment column"]
    tangent: Float[np.ndarray, "moment column"]
    residual: Float[np.ndarray, "half window"]
    weight: Float[np.ndarray, "half window"]
    terms: Float[np.ndarray, "half window moment"]
    scale: float

    @property
    def channel(self) -> str:
        """Channel on the left side of the equation: `voltage` or `current`."""
        return "voltage" if self.windows.signals.shape[-1] == len(VOLTS) else "current"

    @property
    def unit(self) -> str:
        """Unit of the channel."""
        return {"voltage": "V", "current": "A"}[self.channel]

    @property
    def moments(self) -> Float[np.ndarray, "window moment"]:
        return self.terms.sum(axis=0)

    @property
    def weighted_residual(self) -> Float[np.ndarray, " window"]:
        """Weighted residual of each window, averaged over even and odd rows."""
        return (self.weight * self.residual).sum(axis=0) / 2


def equation(w: BenchWindows, coefficients: Float[np.ndarray, " column"], signals: int) -> Equation:
    """Return an equation at given coefficients.

    The first `signals` signals are the instruments, by which residuals are multiplied.
    """
    totals, halves = [], []
    for half in (0, 1):
        residual, scale, weight = _weighted(w, half, coefficients)
        square = (residual / scale) ** 2
        z = w.signals[1 - half, :, :signals] * (weight / 2)[:, None]
        bent = z * ((DEGREES - square) / (DEGREES + square))[:, None]
        measured, mine = w.measured[half], w.signals[half]
        totals.append((z.T @ measured, z.T @ mine, bent.T @ mine, scale / 2))
        halves.append((residual, weight, z * residual[:, None]))
    constant, slope, tangent, scale = (a + b for a, b in zip(*totals, strict=True))
    residuals, weights, terms = map(np.stack, zip(*halves, strict=True))
    return Equation(w, constant, slope, tangent, residuals, weights, terms, scale)


def start(w: BenchWindows, count: int, rounds: int = 12) -> np.ndarray:
    """Return coefficients for which the first `count` moments vanish; all others are 0."""
    found = np.zeros(w.signals.shape[-1])
    weights = [w.usable.astype(float)] * 2
    for _ in range(rounds):
        slope, constant = np.zeros((count, count)), np.zeros(count)
        for half, weight in enumerate(weights):
            z = w.signals[1 - half, :, :count]
            slope += z.T @ (weight[:, None] * w.signals[half, :, :count])
            constant += z.T @ (weight * w.measured[half])
        found[:count] = np.linalg.lstsq(slope, constant, rcond=1e-10)[0]
        weights = [_weighted(w, half, found)[2] for half in (0, 1)]
    return found


def _weighted(
    w: BenchWindows, half: int, coefficients: Float[np.ndarray, " column"]
) -> tuple[Float[np.ndarray, " window"], float, Float[np.ndarray, " window"]]:
    """Return residuals from the even (`half` 0) or odd rows (1), their robust std and weights.

    The std is at least 1e-9, the size of rounding errors in sums.
    """
    residual = w.measured[half] - w.signals[half] @ coefficients
    usable = np.abs(residual[w.usable])
    scale = max(1.4826 * float(np.median(usable)) if len(usable) else 1.0, 1e-9)
    return residual, scale, w.usable * (DEGREES + 1) / (DEGREES + (residual / scale) ** 2)


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
    """Return the length of the cells of time [s], at least twice the time between windows."""
    strides = [float(np.median(np.diff(w.time))) for w in windows if len(w.time) > 1]
    return max(CELL_S, *(2 * s for s in strides))


def correlation_cells(x: Float[np.ndarray, " cell"]) -> int:
    """Return the correlation time of a signal [cell]: 1 + 2 sum of its autocorrelations."""
    most = len(x) // FEWEST_TIMES
    size = 1 << (2 * len(x)).bit_length()
    power = np.abs(np.fft.rfft(x - x.mean(), size)) ** 2
    correlation = np.fft.irfft(power, size)[: most + 1]
    if len(correlation) < 2 or correlation[0] <= 0:
        return 1
    correlation = correlation / correlation[0]
    low = np.flatnonzero(correlation < UNCORRELATED)
    end = int(low[0]) if len(low) else most + 1
    return int(np.ceil(1 + 2 * correlation[1:end].sum()))


def scatter(g: Float[np.ndarray, "cell moment"], lags: int) -> Square:
    """Return the covariance of the sum over cells; `lags` is about twice the correlation time."""
    s = g.T @ g
    for k in range(1, min(lags, len(g))):
        c = g[:-k].T @ g[k:]
        s = s + (1 - k / lags) * (c + c.T)
    lengths, count = len(g) / lags, g.shape[1]
    return np.asarray(s * (lengths / max(lengths - count, lengths / 2)))


def widened(s: Square, groups: Float[np.ndarray, "group moment"]) -> Square:
    """Return the larger of two covariances of a sum, along every direction.

    One is `s`, estimated from cells of time; the other is estimated from sums over groups of
    windows with similar speed and current, divided by the largest excess that chance explains. For
    pure noise, the first one is larger; a misfit over speed or current makes the second one larger.
    """
    root = np.linalg.cholesky(s + 1e-12 * np.diag(np.diag(s) + 1e-300))
    white = np.linalg.solve(root, groups.T)
    value, vector = np.linalg.eigh(white @ white.T)
    chance = (1 + np.sqrt(len(s) / max(len(groups), 1))) ** 2
    axes = root @ vector
    return np.asarray(axes * np.maximum(value / chance, 1.0) @ axes.T)


def grouped(equation: Equation) -> Float[np.ndarray, "group moment"]:
    """Return sums of moments over groups of windows with similar speed and similar current.

    Groups have about equal sizes. A residual from even rows is grouped by the speed and current of
    odd rows, and vice versa, so that a residual's own noise does not determine its group.
    """
    w, total = equation.windows, np.zeros((SPEEDS * CURRENTS, equation.terms.shape[-1]))
    for half, terms in enumerate(equation.terms):
        speed, current = w.speed[1 - half], w.current[1 - half]
        group = np.zeros(len(w.time), int)
        for k, some in enumerate(np.array_split(np.argsort(speed, kind="stable"), SPEEDS)):
            within = some[np.argsort(current[some], kind="stable")]
            for j, few in enumerate(np.array_split(within, CURRENTS)):
                group[few] = k * CURRENTS + j
        np.add.at(total, group, terms)
    return total
