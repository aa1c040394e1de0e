"""Uncertainty of a motor's parameters: correlated residuals, and disagreement between operations.

The covariance is A^-1 S A^-1 with the information A and the covariance S of the scores' sum. S is
summed over lags of cells of time (Newey and West 1987), so that it is right for correlated
residuals such as those of a voltmeter's noise, cogging or quantisation.

A model that is right has the same parameters at small and at large currents, at low and at high
speeds, early and late. For each of these preferences, one Gauss-Newton step from the optimum
estimates what a fit would give in which the other rows have little weight. If it differs by more
than chance explains, the excess is an error of the model, which is added to the variance. So is the
error of the gains of the meters.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtr

from slipid.infer.bench.open_loop import DEGREES, OpenLoopFit, RowWeights

MOST_CELLS = 2000
"""Approximate number of cells of time in which scores are summed."""
UNCORRELATED = 0.05
"""Autocorrelation below which residuals count as uncorrelated."""
FEWEST_TIMES = 12
"""Smallest ratio of the records' length to the estimated correlation time.

Longer correlation times are not considered, since the covariance could not be estimated then."""
METER_STD = 3e-3
"""Relative std of the gain of a meter, which no log shows [1]."""
METER_GAINS = {
    "motor.resistance": np.sqrt(2.0),
    "motor.back_emf": 1.0,
    "motor.inductance": np.sqrt(2.0),
    "motor.brush_drop": 1.0,
    "motor.coulomb_friction": np.sqrt(2.0),
    "motor.viscous_friction": np.sqrt(2.0),
    "motor.rotor_inertia": np.sqrt(2.0),
}
"""Powers of the gains of voltmeter and ammeter in parameters, added as squares, by path."""
OTHERS = 0.2
"""Weight of the other rows in a weighting that prefers some rows."""
LEAST_CURVATURE = 0.3
"""Smallest mean derivative of a weighted residual by the residual, which outliers decrease."""

Square = Float[np.ndarray, "free free"]


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertainty of the search vector.

    Attributes:
        covariance: covariance from correlated residuals, disagreeing weightings and meters.
        chance: covariance from correlated residuals only.
        spread: estimate of each weighting less that of all rows, keyed by its name.
        correlation_time: time over which residuals are correlated [s].
        independent_times: number of independent times, twice as long, in the records.
    """

    covariance: Square
    chance: Square
    spread: dict[str, Float[np.ndarray, " free"]]
    correlation_time: float
    independent_times: float


def uncertainty(fit: OpenLoopFit) -> Uncertainty:
    """Return the uncertainty of a fit."""
    at = _Scores(fit, fit.slopes, np.diag(1 / fit.space.prior_std**2))
    chance = at.scatter(at.influence(at.use)) + at.of_prior
    excess, spread = np.zeros(len(fit.z)), {}
    pull = (fit.space.prior_mean - fit.z) / fit.space.prior_std**2
    for name, weight in _weightings(fit, at.used).items():
        off = at.step(weight, pull)
        expected = np.diag(at.scatter(at.influence(weight) - at.influence(at.use)))
        excess = np.maximum(excess, off**2 - expected)
        spread[name] = off
    gains = np.array([METER_GAINS.get(e.path, 0.0) for e in fit.space.free]) * METER_STD
    wider = np.sqrt(1 + (excess + gains**2) / np.diag(chance))
    return Uncertainty(
        covariance=chance * wider * wider[:, None],
        chance=chance,
        spread=spread,
        correlation_time=at.lags * at.cell * fit.rows.period / 2,
        independent_times=float(at.used.sum()) / at.cell / at.lags,
    )


def _weightings(fit: OpenLoopFit, used: Bool[np.ndarray, "segment step"]) -> dict[str, RowWeights]:
    """Return the weights of the rows in each weighting, keyed by its name."""
    current, speed = np.abs(fit.at.states[..., 0]), np.abs(fit.at.states[..., 1])
    out = {}
    for names, x in (
        (("small currents", "large currents"), current),
        (("low speeds", "high speeds"), speed),
        (("early rows", "late rows"), fit.rows.time),
    ):
        is_low = x <= float(np.median(x[used]))
        for name, some in zip(names, (is_low, ~is_low), strict=True):
            out[name] = used * np.where(some, 1.0, OTHERS)
    return out


def significance(fit: OpenLoopFit, name: str) -> float:
    """Return the estimate of a fixed parameter over its std, after one step from its present value.

    The free parameters move with it; the parameter has no prior.
    """
    # In a unit that gives the normal equations numbers of similar size.
    own = fit.slope(name) / fit.scales[:, None, None]
    unit = 1 / max(float(np.sqrt((own[:, fit.rows.used] ** 2).sum())), 1e-300)
    jacobian = np.concatenate([fit.slopes, unit * fit.slope(name)[None]])
    at = _Scores(fit, jacobian, np.diag(np.append(1 / fit.space.prior_std**2, 1e-12)))
    pull = np.append((fit.space.prior_mean - fit.z) / fit.space.prior_std**2, 0.0)
    variance = at.scatter(at.influence(at.use))[-1, -1]
    return float(at.step(at.use, pull)[-1] / np.sqrt(max(variance, 1e-300)))


def advantage(one: OpenLoopFit, other: OpenLoopFit) -> float:
    """Return the log-likelihood of a fit less that of another one, over its std (Vuong 1989)."""
    used = one.rows.used & (one.weights[1] > 0)
    cell = max(1, int(used.sum()) // MOST_CELLS)
    gain = _celled((other.terms - one.terms)[..., None], used, cell)
    lags = 2 * _correlation(gain[:, 0]) + 2
    variance = _scatter(gain - gain.mean(axis=0), lags)[0, 0]
    return float(gain.sum() / np.sqrt(max(variance, 1e-300)))


def mixture_quantiles(
    centres: Float[np.ndarray, " fit"],
    stds: Float[np.ndarray, " fit"],
    weights: Float[np.ndarray, " fit"],
) -> Float[np.ndarray, "2"]:
    """Return the 5 and 95 % quantiles of a weighted mixture of normal distributions."""
    x = np.sort((centres + np.outer(np.linspace(-6.0, 6.0, 2001), stds)).ravel())
    below = ndtr((x[:, None] - centres) / stds) @ (weights / weights.sum())
    return np.interp([0.05, 0.95], below, x)


class _Scores:
    """Scores of a fit in cells of time, and steps of Gauss-Newton from subsets of its rows.

    Attributes:
        used: rows that were used.
        use: weight 1 for these rows.
        cell: number of rows of a cell.
        lags: number of cells over which scores are correlated.
    """

    def __init__(self, fit: OpenLoopFit, jacobian: np.ndarray, prior: np.ndarray):
        self._fit, self._jacobian, self._prior = fit, jacobian, prior
        self.used = fit.rows.used & (fit.weights[1] > 0)
        self.use = self.used.astype(float)
        self.cell = max(1, int(self.used.sum()) // MOST_CELLS)
        residuals = fit.weights * fit.residuals / fit.scales[:, None, None] ** 2
        self._scores = np.einsum("csn,pcsn->snp", residuals, jacobian)
        each = (residuals * fit.scales[:, None, None])[..., None]
        self.lags = 2 * max(_correlation(_celled(r, self.used, self.cell)[:, 0]) for r in each) + 2

    @property
    def of_prior(self) -> Float[np.ndarray, "n n"]:
        """Covariance of the optimum due to the error of the prior means."""
        inverse = np.linalg.inv(self._information(self.use))
        return np.asarray(inverse @ self._prior @ inverse)

    def step(self, weight: RowWeights, pull: np.ndarray) -> np.ndarray:
        """Return the step from the optimum to that with other weights of the rows.

        `pull` is the gradient of the log-prior.
        """
        gradient = np.tensordot(weight, self._scores, 2) + pull
        return np.linalg.solve(self._information(weight), gradient)

    def influence(self, weight: RowWeights) -> Float[np.ndarray, "cell n"]:
        """Return the contribution of each cell to the step to other weights."""
        cells = _celled(weight[..., None] * self._scores, self.used, self.cell)
        return np.linalg.solve(self._information(weight), cells.T).T

    def scatter(self, influence: Float[np.ndarray, "cell n"]) -> Float[np.ndarray, "n n"]:
        """Return the covariance of the sum of influences."""
        return _scatter(influence, self.lags)

    def _information(self, weight: RowWeights) -> Float[np.ndarray, "n n"]:
        """Return the information of weighted rows and the prior, with Student's mean curvature."""
        out = self._prior.copy()
        for k, s in enumerate(self._fit.scales):
            some = self.used & (self._fit.weights[k] > 0)
            if some.any():
                squares = (self._fit.residuals[k][some] / s) ** 2
                curvature = (DEGREES + 1) * (DEGREES - squares) / (DEGREES + squares) ** 2
                j = self._jacobian[:, k][:, some] / s
                mean = max(float(curvature.mean()), LEAST_CURVATURE)
                out += mean * (j * weight[some]) @ j.T
        return out


def _celled(
    each: Float[np.ndarray, "segment step n"], used: Bool[np.ndarray, "segment step"], cell: int
) -> Float[np.ndarray, "cell n"]:
    """Return sums over cells of consecutive rows."""
    rows = each[used]
    return np.add.reduceat(rows, np.arange(0, len(rows), cell), axis=0)


def _correlation(x: Float[np.ndarray, " cell"]) -> int:
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


def _scatter(g: Float[np.ndarray, "cell n"], lags: int) -> Float[np.ndarray, "n n"]:
    """Return the covariance of the sum over cells; `lags` is about twice the correlation time."""
    s = g.T @ g
    for k in range(1, min(lags, len(g))):
        c = g[:-k].T @ g[k:]
        s = s + (1 - k / lags) * (c + c.T)
    lengths, count = len(g) / lags, g.shape[1]
    return np.asarray(s * (lengths / max(lengths - count, lengths / 2)))
