"""Variances of run, shared and session effects, and of load biases, by restricted likelihood.

After a fit, every run i on a floor has a remaining effect along, across and in yaw,

    a_i = (E_i^T W_i E_i)^-1 E_i^T W_i r_i

where r_i are the run's residuals, E_i is their change per unit of an effect, and W_i is the inverse
of the covariance that r_i has without run effects. On one axis, the remaining effects of all runs
on the floor have the covariance

    N + v_own D + v_near K + v_session M + T C T^T

N is the variance from camera and process noise, D the diagonal matrix of inverse Student-t weights,
K the kernel over driving conditions, and M is 1 for two runs of the same session and 0 otherwise. T
is the derivative of the effects with respect to the model's fitted parameters, and C the covariance
of these parameters before the floor's own runs were used.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.optimize import brentq
from scipy.special import fdtri

from slipid.fitting.session_effects import remaining_effects
from slipid.fitting.shared_effects import AXES, SharedEffects
from slipid.fitting.variances import DEGREES, VARIANCE_SPREAD, Objective, Search, Square, Variances

_STEPS, _SETTLED = 20, 1e-5
"""Largest number of scoring steps per round, and the change of every log variance below which the
steps stop."""
_SECTORS = 6
"""Number of equal sectors of travel directions; each is held out in turn."""
LEAST_RUNS = 30
"""Smallest number of runs from which the 90 % coverage of end points is estimated.

With fewer runs, fewer than three end points are expected outside their 90 % regions."""
_MOST_GROWTH = 10.0
"""Largest factor by which `extrapolation` multiplies variances."""
POOLED_RANGE = (0.1, 4.0)
"""Range of the std of the floors' load biases, in units of its typical size.

At its lower end, loads of two floors differ by less than a percent."""
_GRID = np.geomspace(*POOLED_RANGE, 60)
"""Candidate stds of the load biases, as multiples of the typical std."""


class AxisEffects(NamedTuple):
    """The effects of the runs on a floor along one axis.

    Attributes:
        number: index of the axis in `AXES`.
        segments: indices of the segments.
        left: remaining effect of each segment.
        fixed: part of the covariance of `left` that does not depend on the estimated variances.
        noise: part of the diagonal of `fixed` that comes from camera and process noise.
        numbers: indices of the estimated variances among all variances.
        bases: derivative of the covariance of `left` with respect to each estimated variance.
        typical: centre of the prior of each estimated log variance.
    """

    number: int
    segments: Int[np.ndarray, " run"]
    left: Float[np.ndarray, " run"]
    fixed: Float[np.ndarray, "run run"]
    noise: Float[np.ndarray, " run"]
    numbers: list[int]
    bases: list[np.ndarray]
    typical: Float[np.ndarray, " variance"]


def effect_variances(axes: Iterable[AxisEffects], log_v: Variances) -> Variances:
    """Return all log variances; scoring steps update those of run, shared and session effects."""
    out = np.array(log_v)
    for axis in axes:
        out[axis.numbers] = _scoring_steps(axis, out[axis.numbers])
    return out


def extrapolation(
    axes: Iterable[AxisEffects],
    log_v: Variances,
    direction: Float[np.ndarray, " segment"],
    distance: Float[np.ndarray, " segment"],
    setup: Sequence[str],
) -> dict[str, float]:
    """Return the factor, keyed by set-up, that enlarges variances in directions without runs.

    The runs of each sector of directions are predicted from the other sectors, with the parameters
    of the floor estimated without that sector (to first order). The variances of shared effects and
    of the parameters are multiplied by the factor that puts 90 % of the end points into their 90 %
    regions; the variances of individual run effects and of the noise, which other runs do not
    predict, are kept. The factor is 1 if at least 90 % of the end points already lie in their
    regions, or if there are fewer than three sectors or fewer than `LEAST_RUNS` runs. The factor is
    needed for two reasons: maximum likelihood fits the variances to differences between runs in
    neighbouring directions, so that the variances are too small if the model is wrong over a wider
    range of directions; and the fit down-weights outliers, which occur in forecast runs as well.

    Args:
        axes: results of `axis_effects`.
        log_v: all log variances.
        direction: direction of travel relative to the body [rad], nan for turns on the spot.
        distance: distance driven in every segment [m].
        setup: label of the floor and load set-up of every segment.

    Sources: Sundararajan and Keerthi 2001, Neural Computation 13(5), equations for left-out data;
    Bachoc 2013, Computational Statistics and Data Analysis 66, on wrong models.
    """
    held_out, names = _held_out_effects(axes, log_v, direction), np.asarray(setup)
    return {
        name: _variance_growth(held_out, distance, names == name) for name in dict.fromkeys(names)
    }


class _HeldOutEffects(NamedTuple):
    """Errors of predicting each segment's effects from the other sectors; nan if not predicted.

    Attributes:
        gap: effect less its prediction, on each axis.
        spread: variance of `gap`.
        own: part of `spread` due to the individual effect and noise of the run, which other runs
            cannot predict.
    """

    gap: Float[np.ndarray, "segment 3"]
    spread: Float[np.ndarray, "segment 3"]
    own: Float[np.ndarray, "segment 3"]


def _held_out_effects(
    axes: Iterable[AxisEffects], log_v: Variances, direction: Float[np.ndarray, " segment"]
) -> _HeldOutEffects:
    """Return every effect less its prediction from the other sectors, and the error's variance."""
    found = _HeldOutEffects(*(np.full((len(direction), len(AXES)), np.nan) for _ in range(3)))
    for axis in axes:
        v = np.exp(log_v)[axis.numbers]
        inverse, groups = np.linalg.inv(_covariance(axis, v)), _sectors(direction[axis.segments])
        if len(groups) < 3:
            continue
        white = inverse @ axis.left
        own = axis.noise + v[0] * np.diag(axis.bases[0])
        for mine in groups:
            spread = np.linalg.inv(inverse[np.ix_(mine, mine)])
            at = axis.segments[mine], axis.number
            found.gap[at], found.spread[at] = spread @ white[mine], np.diag(spread)
            found.own[at] = np.minimum(own[mine], np.diag(spread))
    return found


def _variance_growth(
    held_out: _HeldOutEffects,
    distance: Float[np.ndarray, " segment"],
    mine: Bool[np.ndarray, " segment"],
) -> float:
    """Return the factor of one set-up's variances that puts 90 % of end points in 90 % regions.

    `mine` marks the segments of the set-up. The factor does not multiply the variances of
    individual run effects and of the noise.
    """
    mine = mine & np.isfinite(held_out.gap).all(axis=1)
    if mine.sum() < LEAST_RUNS:
        return 1.0
    d = distance[mine]
    gap, spread, own = (x[mine] for x in held_out)
    # Yaw grows linearly along the run, so the end point moves sideways by half the yaw times
    # distance.
    along, across = gap[:, 0], gap[:, 1] + 0.5 * d * gap[:, 2]

    def excess(log_growth: float) -> float:
        v = own + np.exp(log_growth) * (spread - own)
        square = along**2 / v[:, 0] + across**2 / (v[:, 1] + 0.25 * d**2 * v[:, 2])
        return float(np.quantile(square, 0.9) - 2 * fdtri(2, DEGREES, 0.9))

    most = np.log(_MOST_GROWTH)
    if excess(0.0) <= 0:
        return 1.0
    return _MOST_GROWTH if excess(most) >= 0 else float(np.exp(brentq(excess, 0.0, most)))


def _sectors(direction: Float[np.ndarray, " run"]) -> list[Int[np.ndarray, " _"]]:
    """Return the indices of the runs in each sector of directions, without empty sectors.

    The sector edges lie in the middle of the widest gap between directions, taken modulo the width
    of a sector, so that few runs in nearly the same direction are separated.
    """
    moves = np.flatnonzero(np.isfinite(direction))
    if not len(moves):
        return []
    width = 2 * np.pi / _SECTORS
    along = np.sort(direction[moves] % width)
    gap = np.diff(along, append=along[0] + width)
    edge = along[gap.argmax()] + 0.5 * gap.max()
    sector = np.floor((direction[moves] - edge) % (2 * np.pi) / width).astype(int) % _SECTORS
    return [moves[sector == k] for k in np.unique(sector)]


def axis_effects(
    objective: Objective,
    motion: tuple[Array, Array],
    weight: Array,
    covariance: Square,
    log_v: Variances,
) -> Iterator[AxisEffects]:
    """Yield the remaining effects of every floor and axis.

    Args:
        motion: motion residuals of all segments, and their derivative with respect to the search
            vector.
        weight: Student-t weight of every segment, 0 for a segment that is left out of the fit.
        covariance: covariance of the search vector.
        log_v: all log variances.
    """
    space = objective.space
    of_floor = space.where(lambda e: e.surface is not None)
    wide = np.where(of_floor[:, None] | of_floor, 0.0, covariance)
    wide[of_floor, of_floor] = np.asarray(objective.prior_std(log_v))[of_floor] ** 2
    scale = np.asarray(objective.blocks["motion"].covariance(jnp.asarray(log_v)))
    gap, slope, counted = np.asarray(motion[0]), np.asarray(motion[1]), np.asarray(weight)
    for floor in objective.shared:
        kept = counted[np.asarray(floor.segments)] > 0
        mine = np.asarray(floor.segments)[kept]
        if len(mine) < 2:
            continue
        effect = np.asarray(floor.effect)[kept]
        run = np.broadcast_to(np.exp(log_v)[np.asarray(floor.numbers)[0]], (len(mine), len(AXES)))
        left, noise, by = remaining_effects(gap[mine], slope[mine], scale[mine], effect, run)
        for k in range(len(AXES)):
            alone = noise[:, k] / counted[mine]
            fixed = np.diag(alone) + by[:, k] @ wide @ by[:, k].T
            variances = _variance_bases(floor, k, kept, counted[mine])
            numbers, bases = [n for n, _ in variances], [c for _, c in variances]
            typical = np.asarray(objective.typical)[numbers]
            yield AxisEffects(k, mine, left[:, k], fixed, alone, numbers, bases, typical)


def _variance_bases(
    floor: SharedEffects, axis: int, kept: Bool[np.ndarray, " run"], weight: np.ndarray
) -> list[tuple[int, np.ndarray]]:
    """Return pairs of a variance's index and its derivative matrix, for the effects on one axis.

    The matrix is the covariance of the effects per unit of the variance. There is one pair for each
    variance that the floor has: of run, neighbours' and session effects.
    """
    own, near, session = np.asarray(floor.numbers)[:, axis].tolist()
    root, member = np.asarray(floor.near)[axis, kept], np.asarray(floor.session)[kept]
    found = [(own, np.diag(1 / weight)), (near, root @ root.T), (session, member @ member.T)]
    return [(number, matrix) for number, matrix in found if number >= 0]


def _covariance(axis: AxisEffects, v: np.ndarray) -> Float[np.ndarray, "run run"]:
    """Return the covariance of the effects on an axis at given values of the variances."""
    return np.asarray(axis.fixed + sum(k * b for k, b in zip(v, axis.bases, strict=True)))


def _information(grown: list[np.ndarray]) -> np.ndarray:
    """Return the expected Fisher information of the log variances.

    `grown` holds, for each variance v, the matrix v V^-1 dV/dv, where V is the covariance.
    """
    return np.array([[0.5 * np.sum(a * b.T) for b in grown] for a in grown])


def _scoring_steps(axis: AxisEffects, log_v: np.ndarray) -> np.ndarray:
    """Return the log variances after Fisher scoring steps of the restricted likelihood.

    A step that decreases the likelihood is halved.
    """

    def loss(at: np.ndarray) -> float:
        root = np.linalg.cholesky(_covariance(axis, np.exp(at)))
        white = np.linalg.solve(root, axis.left)
        deviation = (at - axis.typical) / VARIANCE_SPREAD
        return float(
            np.log(np.diag(root)).sum() + 0.5 * white @ white + 0.5 * deviation @ deviation
        )

    before = loss(log_v)
    for _ in range(_STEPS):
        v = np.exp(log_v)
        inverse = np.linalg.inv(_covariance(axis, v))
        white = inverse @ axis.left
        grown = [k * (inverse @ b) for k, b in zip(v, axis.bases, strict=True)]
        quadratic = [k * white @ b @ white for k, b in zip(v, axis.bases, strict=True)]
        score = 0.5 * (np.array(quadratic) - [np.trace(g) for g in grown])
        score -= (log_v - axis.typical) / VARIANCE_SPREAD**2
        info = _information(grown) + np.eye(len(v)) / VARIANCE_SPREAD**2
        step = np.clip(np.linalg.solve(info, score), -1.5, 1.5)
        while (after := loss(log_v + step)) > before and np.abs(step).max() > _SETTLED:
            step = step / 2
        if after > before:
            break
        log_v, before = log_v + step, after
        if np.abs(step).max() < _SETTLED:
            break
    return log_v


def pooled(precision: Square, z: Search, objective: Objective, log_v: Variances) -> float:
    """Return the log of the posterior mean variance of the floors' load biases.

    Arguments are those of `pooled_stds`.
    """
    found = pooled_stds(precision, z, objective, log_v)
    return float(np.log(found.weight @ found.std**2))


class PooledStds(NamedTuple):
    """Posterior of the std of the floors' load biases, on a grid.

    Attributes:
        std: candidate stds.
        weight: probability of each candidate; the sum is one.
    """

    std: Float[np.ndarray, " grid"]
    weight: Float[np.ndarray, " grid"]


def pooled_stds(precision: Square, z: Search, objective: Objective, log_v: Variances) -> PooledStds:
    """Return the posterior of the std of the load biases, on a grid; its prior is half-normal.

    The posterior of the search vector is taken as a Gaussian with mean z and the given precision,
    so that the evidence for every candidate std has a closed form.

    Source: Gelman 2006, Bayesian Analysis 1(3), on half-normal priors of group stds.
    """
    at = np.flatnonzero(objective.space.pooled)
    deviation = np.zeros(len(precision))
    deviation[at] = (z - objective.space.prior_mean)[at]
    of_data = np.asarray(precision).copy()
    of_data[at, at] -= np.exp(-log_v[objective.pooled])
    typical = np.exp(0.5 * float(objective.typical[objective.pooled]))
    return stds_given(of_data, np.asarray(precision) @ deviation, at, typical)


def stds_given(
    precision: Square, pull: Search, at: Int[np.ndarray, " bias"], typical: float
) -> PooledStds:
    """Return the posterior of the common std of some coordinates, all coordinates integrated out.

    The likelihood of the coordinates x is a Gaussian, exp(-x^T precision x / 2 + pull^T x). Those
    `at` have a normal prior with mean zero and this std, whose own prior is half-normal within
    `POOLED_RANGE`.
    """
    rest = np.setdiff1d(np.arange(len(pull)), at)
    by_rest = np.linalg.solve(precision[np.ix_(rest, rest)], precision[np.ix_(rest, at)])
    alone = precision[np.ix_(at, at)] - precision[np.ix_(at, rest)] @ by_rest
    value, vector = np.linalg.eigh(alone)
    along = vector.T @ (pull[at] - by_rest.T @ pull[rest])
    std = _GRID * typical
    with_prior = value + std[:, None] ** -2
    log = (
        0.5 * (along**2 / with_prior - np.log(with_prior)).sum(axis=1)
        - len(at) * np.log(std)
        - 0.5 * _GRID**2
        # The grid is geometric: the interval around a candidate is proportional to its std.
        + np.log(_GRID)
    )
    weight = np.exp(log - log.max())
    return PooledStds(std, weight / weight.sum())
