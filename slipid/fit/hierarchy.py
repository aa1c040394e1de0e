"""Variances of what runs share, and of how floors differ, each by restricted likelihood.

The effects left in the runs on a floor, one axis at a time,

    a_i = (E_i^T W_i E_i)^-1 E_i^T W_i r_i

(E_i moves the residuals r_i by an effect, W_i weighs them without the run effects) have the
covariance

    N + v_own D + v_near K + v_session M + T C T^T

N of camera and process noise, D of the Student-t weights, K the kernel over conditions, M 1 within
a session, T the slope by the model's numbers and C their covariance before the floor's own runs
were seen.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.optimize import brentq
from scipy.stats import f as fisher

from slipid.fit.shared_effects import AXES, SharedEffects
from slipid.fit.variances import DEGREES, VARIANCE_SPREAD, Objective, Search, Square

_STEPS, _SETTLED = 20, 1e-5
"""Most scoring steps in a turn, and a step of a log variance that counts as rest."""
_SECTORS = 6
"""Parts of the circle of directions, each of which is left out in turn."""
LEAST_RUNS = 30
"""Runs below which a tenth of them says too little of the tail."""
_MOST_GROWTH = 10.0
"""Largest factor of variances that is believed."""
_GRID = np.geomspace(0.1, 4.0, 60)
"""Stds of the load biases that are weighed, over the typical one."""


class _AxisEffects(NamedTuple):
    """The effects of the runs on a floor along one axis.

    Attributes:
        number: of the axis; pieces: numbers of the runs.
        left: effects left; fixed: their covariance but for the variances asked for.
        noise: part of its diagonal that is noise of the camera and of the process.
        numbers: of these variances; bases: what each makes of the covariance.
    """

    number: int
    segments: Int[np.ndarray, " run"]
    left: Float[np.ndarray, " run"]
    fixed: Float[np.ndarray, "run run"]
    noise: Float[np.ndarray, " run"]
    numbers: list[int]
    bases: list[np.ndarray]


def effect_variances(
    objective: Objective,
    motion: tuple[Array, Array],
    weight: Array,
    covariance: Square,
    log_v: Float[np.ndarray, " variance"],
) -> Float[np.ndarray, " variance"]:
    """Log variances after scoring steps of those of the effects of runs.

    Args:
        motion: residuals and their slope, all pieces.
        weight: Student-t weight of every piece, 0 for one that does not count.
        covariance: of the search vector.
    """
    out = np.array(log_v)
    for axis in _axes(objective, motion, weight, covariance, log_v):
        typical = np.asarray(objective.typical)[axis.numbers]
        out[axis.numbers] = _scoring_steps(axis, out[axis.numbers], typical)
    return out


def effect_information(
    objective: Objective,
    motion: tuple[Array, Array],
    weight: Array,
    covariance: Square,
    log_v: Float[np.ndarray, " variance"],
) -> Float[np.ndarray, "variance variance"]:
    """Expected information of the same log variances, zero for the others."""
    out = np.zeros((len(log_v), len(log_v)))
    for axis in _axes(objective, motion, weight, covariance, log_v):
        v = np.exp(log_v)[axis.numbers]
        inverse = np.linalg.inv(_covariance(axis, v))
        grown = [k * (inverse @ b) for k, b in zip(v, axis.bases, strict=True)]
        out[np.ix_(axis.numbers, axis.numbers)] += _information(grown)
    return out


class TravelDirections(NamedTuple):
    """Direction of travel of every piece [rad], nan on the spot, its way [m], and its set-up."""

    direction: Float[np.ndarray, " piece"]
    far: Float[np.ndarray, " piece"]
    setup: Sequence[str]


def extrapolation(
    objective: Objective,
    motion: tuple[Array, Array],
    keep: Float[np.ndarray, " piece"],
    covariance: Square,
    log_v: Float[np.ndarray, " variance"],
    courses: TravelDirections,
) -> dict[str, float]:
    """By what variances are too small where nothing near was seen, by set-up of a piece.

    Every sector of directions is predicted from the others, with the numbers of the floor learnt
    anew (to first order). What runs share and the numbers have variances that are too small by so
    much that 90 % of the ends lie in their regions once they have grown; the run's own effects and
    noise stay, which neighbours do not tell. It is 1 where enough lie there, and where there are
    fewer than three sectors or `LEAST_RUNS` runs. A likelihood finds the variances that are best
    between the runs it has, which are too small where the model is wrong in the large, and weighs
    outliers away that a forecast meets again.

    Sources: Sundararajan and Keerthi 2001, Neural Computation 13(5), eq. for leaving out; Bachoc
    2013, Computational Statistics and Data Analysis 66, on wrong models.
    """
    axes = _axes(objective, motion, jnp.asarray(keep), covariance, log_v)
    left = _held_out_effects(axes, log_v, courses.direction)
    names = np.asarray(courses.setup)
    return {
        name: _variance_growth(left, courses.far, names == name) for name in dict.fromkeys(names)
    }


class _HeldOutEffects(NamedTuple):
    """Effects of pieces along, across and in yaw as others predict them; nan where none do.

    Attributes:
        gap: of the effect from its prediction.
        spread: variance of the gap; own: the part of it that others cannot tell.
    """

    gap: Float[np.ndarray, "piece 3"]
    spread: Float[np.ndarray, "piece 3"]
    own: Float[np.ndarray, "piece 3"]


def _held_out_effects(
    axes: Iterable[_AxisEffects],
    log_v: Float[np.ndarray, " variance"],
    direction: Float[np.ndarray, " piece"],
) -> _HeldOutEffects:
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
    left: _HeldOutEffects, far: Float[np.ndarray, " piece"], mine: Bool[np.ndarray, " piece"]
) -> float:
    """Of what a region of ends is made of beside own effects, to hold 90 % of those left out."""
    mine = mine & np.isfinite(left.gap).all(axis=1)
    if mine.sum() < LEAST_RUNS:
        return 1.0
    way = far[mine]
    gap, spread, own = (x[mine] for x in left)
    # a yaw that grows along the way moves the end across by half of it
    along, across = gap[:, 0], gap[:, 1] + 0.5 * way * gap[:, 2]

    def too_far(log_growth: float) -> float:
        v = own + np.exp(log_growth) * (spread - own)
        square = along**2 / v[:, 0] + across**2 / (v[:, 1] + 0.25 * way**2 * v[:, 2])
        return float(np.quantile(square, 0.9) - 2 * fisher.ppf(0.9, 2, DEGREES))

    most = np.log(_MOST_GROWTH)
    if too_far(0.0) <= 0:
        return 1.0
    return _MOST_GROWTH if too_far(most) >= 0 else float(np.exp(brentq(too_far, 0.0, most)))


def _sectors(direction: Float[np.ndarray, " run"]) -> list[Int[np.ndarray, " _"]]:
    """Runs whose directions lie in each sector; sectors without runs are left out.

    Their edges are where the fewest runs are cut from others in nearly the same direction: in the
    middle of the widest gap between directions, taken modulo a sector.
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


def _axes(
    objective: Objective,
    motion: tuple[Array, Array],
    weight: Array,
    covariance: Square,
    log_v: Float[np.ndarray, " variance"],
) -> Iterator[_AxisEffects]:
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
        run, effect = np.exp(log_v)[np.asarray(floor.numbers)[0]], np.asarray(floor.effect)[kept]
        left, noise, by = _remaining_effects(gap[mine], slope[mine], scale[mine], effect, run)
        for k in range(len(AXES)):
            alone = noise[:, k] / counted[mine]
            fixed = np.diag(alone) + by[:, k] @ wide @ by[:, k].T
            segments = _variance_bases(floor, k, kept, counted[mine])
            numbers, bases = [n for n, _ in segments], [c for _, c in segments]
            yield _AxisEffects(k, mine, left[:, k], fixed, alone, numbers, bases)


def _variance_bases(
    floor: SharedEffects, axis: int, kept: Bool[np.ndarray, " run"], weight: np.ndarray
) -> list[tuple[int, np.ndarray]]:
    """Variance numbers, and what each makes of the covariance of the effects along an axis."""
    own, near, session = np.asarray(floor.numbers)[:, axis].tolist()
    root, member = np.asarray(floor.near)[axis, kept], np.asarray(floor.session)[kept]
    found = [(own, np.diag(1 / weight)), (near, root @ root.T), (session, member @ member.T)]
    return [(number, matrix) for number, matrix in found if number >= 0]


def _remaining_effects(
    gap: np.ndarray, slope: np.ndarray, scale: np.ndarray, effect: np.ndarray, run: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Effects left in each run (run, 3), their variance by camera and process, their slope."""
    plain = scale - np.einsum("nma,a,nla->nml", effect, run, effect)
    by_noise = np.linalg.solve(plain, effect)
    cov = np.linalg.inv(np.swapaxes(effect, 1, 2) @ by_noise)
    take = cov @ np.swapaxes(by_noise, 1, 2)
    left = np.einsum("nam,nm->na", take, gap)
    return left, np.diagonal(cov, axis1=1, axis2=2), take @ slope


def _covariance(axis: _AxisEffects, v: np.ndarray) -> Float[np.ndarray, "run run"]:
    """Covariance of the effects at some variances."""
    return np.asarray(axis.fixed + sum(k * b for k, b in zip(v, axis.bases, strict=True)))


def _information(grown: list[np.ndarray]) -> np.ndarray:
    return np.array([[0.5 * np.sum(a * b.T) for b in grown] for a in grown])


def _scoring_steps(axis: _AxisEffects, log_v: np.ndarray, typical: np.ndarray) -> np.ndarray:
    """Log variances after Fisher scoring steps of the restricted likelihood.

    A step that makes it smaller is halved.
    """

    def loss(at: np.ndarray) -> float:
        root = np.linalg.cholesky(_covariance(axis, np.exp(at)))
        white = np.linalg.solve(root, axis.left)
        pull = (at - typical) / VARIANCE_SPREAD
        return float(np.log(np.diag(root)).sum() + 0.5 * white @ white + 0.5 * pull @ pull)

    before = loss(log_v)
    for _ in range(_STEPS):
        v = np.exp(log_v)
        inverse = np.linalg.inv(_covariance(axis, v))
        white = inverse @ axis.left
        grown = [k * (inverse @ b) for k, b in zip(v, axis.bases, strict=True)]
        told = [k * white @ b @ white for k, b in zip(v, axis.bases, strict=True)]
        score = 0.5 * (np.array(told) - [np.trace(g) for g in grown])
        score -= (log_v - typical) / VARIANCE_SPREAD**2
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


def pooled(
    precision: Square, z: Search, objective: Objective, log_v: Float[np.ndarray, " variance"]
) -> float:
    """Log of the mean variance of the load biases of floors; arguments as of `pooled_stds`."""
    found = pooled_stds(precision, z, objective, log_v)
    return float(np.log(found.weight @ found.std**2))


class PooledStds(NamedTuple):
    """Stds that the load biases of floors may have, and how likely each is; these sum to one."""

    std: Float[np.ndarray, " grid"]
    weight: Float[np.ndarray, " grid"]


def pooled_stds(
    precision: Square, z: Search, objective: Objective, log_v: Float[np.ndarray, " variance"]
) -> PooledStds:
    """Stds of the load biases with a half-normal prior, on a grid.

    The fit is a Gaussian of that precision around z; its evidence for every std is known.

    Source: Gelman 2006, Bayesian Analysis 1(3), on half-normal priors of group stds.
    """
    at = np.flatnonzero(objective.space.pooled)
    now = np.exp(-log_v[objective.pooled])
    told = np.asarray(precision).copy()
    away = np.zeros(len(told))
    away[at] = (z - objective.space.prior_mean)[at]
    pull = told @ away
    told[at, at] -= now
    typical = np.exp(0.5 * float(objective.typical[objective.pooled]))
    log = []
    for part in _GRID:
        with_prior = told.copy()
        with_prior[at, at] += 1 / (part * typical) ** 2
        root = np.linalg.cholesky(with_prior)
        half = np.linalg.solve(root, pull)
        log.append(
            0.5 * half @ half
            - np.log(np.diag(root)).sum()
            - len(at) * np.log(part * typical)
            - 0.5 * part**2
            + np.log(part)  # of the grid's steps
        )
    weight = np.exp(np.array(log) - max(log))
    return PooledStds(_GRID * typical, weight / weight.sum())
