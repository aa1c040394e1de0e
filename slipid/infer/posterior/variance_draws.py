"""Draws of the noise variances from their restricted likelihood, by Gibbs sampling.

Near a fit, the residuals of segment i are those at the fit, r_i, plus changes that are linear in
the change d of the search vector and in the coefficients u of the effects that runs share:

    r_i + J_i d - E_i S_i u ~ N(0, V_i / w_i),    w_i ~ Gamma(DEGREES / 2, DEGREES / 2)

The weights w_i make the residuals Student t, as in the fit. d has its Gaussian prior, and u has
unit variance. The restricted likelihood of the variances is the likelihood with d, u and w
integrated out (Patterson and Thompson 1971, Biometrika 58(3)). A sweep draws all of them, so that
draws of the variances have the restricted likelihood times their prior as density:

1. the variance of the load biases, on a grid with d and u integrated out, then d and u together
   from their Gaussian;
2. the variances of shared effects by slice sampling, first given u and the residuals, then given
   the effects S u: the two forms together mix whether a variance is small or large (Yu and Meng
   2011, Journal of Computational and Graphical Statistics 20(3));
3. the variances of V by a Hamiltonian move of all of them, with w integrated out;
4. w from its Gamma distributions.

A Gaussian around the fit would not do: the likelihood of a log variance is flat towards minus
infinity if other variances can explain the residuals.
"""

import math
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import partial
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_solve, solve_triangular

from slipid.fitting.hierarchy import stds_given
from slipid.fitting.problem import Problem
from slipid.fitting.variances import (
    VARIANCE_SPREAD,
    Search,
    Square,
    Variances,
    information,
)
from slipid.infer.posterior.coordinates import Anchor, Fitted
from slipid.infer.posterior.moves import Chains, hamiltonian, sliced
from slipid.infer.posterior.variance_likelihood import (
    LinearPart,
    PooledPrior,
    Residuals,
    Rows,
    SegmentNoise,
    divided,
    linear_parts,
    target,
)

_LEAST_SWEEPS, _STATES, _WORK = 100, 600, 7e6
"""Least number of sweeps of each chain from which draws are taken; largest number of those of all
chains together, unless there are more than six; and number of elements of the segments' covariances
in the sweeps of a chain, if their number is between these."""
_WARM_UP = 0.4
"""Number of sweeps before the first draw, per sweep from which draws are taken."""
_PSEUDO = 20
"""Number of states that the Gaussian around the fit counts for in a learned covariance."""
_FIRST_STEP, _FASTER, _ACCEPTED = 0.1, 0.15, 0.75
"""First length of leapfrog steps; change of its logarithm per sweep of the warm-up and per unit of
the share of accepted moves that exceeds the third number."""
_PATH, _MOST_LEAPS = (1.0, 4.0), 16
"""Range of lengths of Hamiltonian moves, in units of a root of the covariance of the target, and
the largest number of leapfrog steps of a move."""
_STEP = 2.0
"""Width of a step outwards in the log variance of a shared effect."""
CONDITIONED = 120
"""Number of draws of the variances given which covariances are computed."""
_LEAST_EIGENVALUE = 1e-9
"""Part of the largest eigenvalue of the kernel over driving conditions below which others are 0."""


def drawn_variances(
    problem: Problem,
    fitted: Fitted,
    shape: tuple[int, int],
    seed: int,
    stop: threading.Event | None = None,
) -> Float[np.ndarray, "ensemble draw variance"]:
    """Return draws of the log variances, from a chain for each ensemble.

    Draws are spread evenly over the sweeps of a chain; if there are more draws than sweeps, some
    sweeps count several times.

    Raises:
        CancelledError: `stop` was set by another thread.
    """
    rng, log_v = np.random.default_rng([seed, 1]), fitted.log_variance
    out = np.broadcast_to(log_v, (*shape, len(log_v))).copy()
    spread = (np.arange(shape[1]) + 0.5) / shape[1]
    most = max(_LEAST_SWEEPS, _STATES // shape[0])
    for part in linear_parts(problem, fitted):
        number = int(np.clip(_WORK / part.elements, _LEAST_SWEEPS, most))
        first = int(_WARM_UP * number)
        walked = []
        for at in islice(sweeps(part, log_v, shape[0], first, rng), first + number):
            if stop is not None and stop.is_set():
                raise CancelledError
            walked.append(at.log_variance)
        chain = np.stack(walked[first:], axis=1)[..., part.numbers]
        out[..., part.numbers] = chain[:, (spread * number).astype(int)]
    return out


def widened(
    x: Float[np.ndarray, "ensemble draw size"], added: Square, rng: np.random.Generator
) -> Float[np.ndarray, "ensemble draw size"]:
    """Return draws at fitted variances, to which the covariance is added that these add."""
    mean = np.zeros(x.shape[-1])
    return x + rng.multivariate_normal(mean, added, x.shape[:2], method="eigh")


def added_covariance(
    problem: Problem, fitted: Fitted, draws: Float[np.ndarray, "ensemble draw variance"]
) -> Square:
    """Return the covariance that uncertain variances add to that of the parameters.

    It is that of the parameters of the motion, and that of electric parameters given the motion.
    With runs over several floors, the friction that moves them is a parameter of the motion.
    With variances v that are drawn, the covariance is E[cov | v] + Cov(mean | v); the covariance at
    the fitted variances is subtracted. Negative eigenvalues of the difference, relative to that
    covariance, are set to zero.
    Source: Kass and Steffey 1989, Journal of the American Statistical Association 84(407).
    """
    some = draws.reshape(-1, draws.shape[-1])
    some = some[np.linspace(0, len(some) - 1, CONDITIONED).astype(int)]
    at, of_motion = weights_at(problem, fitted), ~problem.space.electric | problem.objective.joint
    if fitted.multi_floor is not None:
        of_motion[np.asarray(fitted.multi_floor.friction)] = True
    out = np.zeros_like(fitted.covariance)
    for part, drawn in zip(linear_parts(problem, fitted), (of_motion, ~of_motion), strict=False):
        floors, mine = floor_runs(part), np.flatnonzero(drawn)
        if not mine.size:  # no parameter is drawn from these residuals
            continue
        before = conditional(part, floors, at, fitted.log_variance, mine).covariance
        found = [conditional(part, floors, at, log_v, mine) for log_v in some]
        between = np.cov([x.mean for x in found], rowvar=False)
        excess = np.mean([x.covariance for x in found], axis=0) + between - before
        root = np.linalg.cholesky(before)
        value, vector = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, excess).T))
        out[np.ix_(mine, mine)] = (root @ vector * np.maximum(value, 0.0)) @ (root @ vector).T
    return out


def weights_at(problem: Problem, fitted: Fitted) -> dict[str, np.ndarray]:
    """Return the weight of every segment in the posterior around a fit, keyed by block."""
    return {k: np.asarray(x) ** 2 for k, x in Anchor.at(problem, fitted).scale.items()}


class Conditional(NamedTuple):
    """Distribution of changes of coordinates, given variances and weights of segments."""

    mean: Float[np.ndarray, " some"]
    covariance: Float[np.ndarray, "some some"]


def conditional(
    part: LinearPart,
    floors: Sequence["FloorRuns"],
    weight: dict[str, np.ndarray],
    log_v: Variances,
    some: Int[np.ndarray, " some"],
) -> Conditional:
    """Return the distribution of some coordinates' changes, shared effects integrated out.

    All other coordinates stay at the fit.

    Args:
        part: residuals that are linear in the search vector.
        floors: runs of each floor, from `floor_runs`.
        weight: weight of every segment, keyed by block.
        log_v: log variances.
        some: indices of the coordinates in the search vector.
    """
    precision, pull = part.precision.copy(), part.pull.copy()
    if part.pooled is not None:
        part.pooled.add(precision, pull, log_v)
    inverse = {
        k: np.linalg.inv(SegmentNoise.of(noise, part.degrees).covariance(log_v[None]))[:, 0]
        * weight[k][:, None, None]
        for k, noise in part.noises.items()
    }
    whole = part.rows_at(log_v)
    for floor in floors:
        rows = floor_information(floor, whole, inverse, log_v).rows
        precision[np.ix_(floor.columns, floor.columns)] += rows[:-1, :-1]
        pull[floor.columns] -= rows[:-1, -1]
    covariance = np.linalg.inv(precision[np.ix_(some, some)])
    return Conditional(covariance @ pull[some], covariance)


class Sweep(NamedTuple):
    """State of all chains after a sweep.

    Attributes:
        log_variance: log variances; those that the part does not draw stay at the fit.
        change: change of the search vector.
    """

    log_variance: Chains
    change: Float[np.ndarray, "chain free"]


def sweeps(
    part: LinearPart, log_v: Variances, chains: int, warm_up: int, rng: np.random.Generator
) -> Iterator[Sweep]:
    """Yield the states of `chains` chains that start at the log variances of a fit.

    In the first `warm_up` sweeps, Hamiltonian moves learn their step and the covariance.
    """
    floors, moved = floor_runs(part), np.asarray(part.member.any(axis=1))
    noises = {k: SegmentNoise.of(noise, part.degrees) for k, noise in part.noises.items()}
    expected = information(part.noises, log_v, np.ones(part.member.shape[1]), None)
    about = Gaussian(log_v, np.linalg.inv(np.asarray(expected)))
    root, step, history = about.root(moved), _FIRST_STEP, list[Chains]()
    log_vs = np.tile(log_v, (chains, 1))
    weight = {k: np.ones((chains, len(r))) for k, r in part.rows.items()}
    inverse = {k: np.linalg.inv(v.covariance(log_vs)) for k, v in noises.items()}
    while True:
        drawn = []
        for c in range(chains):
            weighted = {k: v[:, c] * weight[k][c][:, None, None] for k, v in inverse.items()}
            drawn.append(_linear_draw(part, floors, weighted, log_vs[c], rng))
        log_vs = np.array([d.log_variance for d in drawn])
        at = _residuals(part, floors, drawn)
        leaps = min(math.ceil(rng.uniform(*_PATH) / step), _MOST_LEAPS)
        this_step, density = step * rng.uniform(0.8, 1.0), target(part, noises, at)
        log_vs, accepted = hamiltonian(density, log_vs, root, this_step, leaps, rng)
        for k, r in divided(part, at, log_vs).items():
            inverse[k] = np.linalg.inv(noises[k].covariance(log_vs))
            square = np.einsum("cni,ncij,cnj->cn", r, inverse[k], r, optimize=True)
            weight[k] = _drawn_weights(part.degrees, noises[k].count, square, rng)
        if len(history) < warm_up:
            step *= np.exp(_FASTER * (accepted.mean() - _ACCEPTED))
            history.append(log_vs)
            if len(history) in (warm_up // 4, warm_up // 2, warm_up):
                root = about.learned(history[len(history) // 3 :]).root(moved)
        yield Sweep(log_vs, np.array([d.change for d in drawn]))


def _residuals(
    part: LinearPart, floors: tuple["FloorRuns", ...], drawn: Sequence["LinearDraw"]
) -> Residuals:
    """Return the residuals of every chain after the changes that were drawn."""
    extended = np.array([np.append(d.change, 1.0) for d in drawn]).T
    blocks = {k: np.moveaxis(r @ extended, -1, 0) for k, r in part.rows.items()}
    if part.shared:
        for r, d in zip(blocks["motion"], drawn, strict=True):
            for floor, effect in zip(floors, d.effects, strict=True):
                r[floor.segments] -= np.einsum("nma,na->nm", floor.effect, effect)
    if part.voltages is None:
        return Residuals(blocks, None)
    return Residuals(blocks, np.moveaxis(np.asarray(part.voltages.more) @ extended, -1, 0))


@dataclass(frozen=True, eq=False)
class FloorRuns:
    """The runs on one floor, with what their residuals depend on.

    Attributes:
        segments: indices of the runs' segments.
        columns: indices of the coordinates of the search vector that change their residuals.
        effect: change of the residuals per unit of an effect on each axis; no axes without effects.
        roots: root of the covariance of the effects per unit variance, of neighbours and of
            sessions for each axis in turn.
        numbers: indices of the variances of these effects, in the same order; -1 for no variance.
    """

    segments: Int[np.ndarray, " run"]
    columns: Int[np.ndarray, " column"]
    effect: Float[np.ndarray, "run m axis"]
    roots: tuple[np.ndarray, ...]
    numbers: tuple[int, ...]


def floor_runs(part: LinearPart) -> tuple[FloorRuns, ...]:
    """Return the runs of each floor; all runs together if they share no effects."""
    if not part.shared:
        first = next(iter(part.rows.values()))
        none, columns = np.zeros((*first.shape[:2], 0)), np.flatnonzero(~part.given.any(axis=1))
        return (FloorRuns(np.arange(len(first)), columns, none, (), ()),)
    out = []
    for of in part.shared:
        mine = np.asarray(of.segments)
        moved = np.any([r[mine, :, :-1].any(axis=(0, 1)) for r in part.rows.values()], axis=0)
        session = np.asarray(of.session)
        roots = tuple(r for near in np.asarray(of.near) for r in (_compressed(near), session))
        numbers = np.asarray(of.numbers)[1:].T.ravel().tolist()
        effect = np.asarray(of.effect)
        out.append(FloorRuns(mine, np.flatnonzero(moved), effect, roots, tuple(numbers)))
    return tuple(out)


def _compressed(root: np.ndarray) -> np.ndarray:
    """Return a matrix with fewer columns and the same product with its transpose."""
    value, vector = np.linalg.eigh(root @ root.T)
    kept = value > _LEAST_EIGENVALUE * value.max(initial=0.0)
    return np.asarray(vector[:, kept] * np.sqrt(value[kept]))


class LinearDraw(NamedTuple):
    """A draw of what residuals are linear in, given weights, with the variances of its effects.

    Attributes:
        log_variance: all log variances, those of shared effects and of load biases drawn anew.
        change: change of the search vector.
        effects: shared effects of the runs on each floor.
    """

    log_variance: Variances
    change: Search
    effects: list[np.ndarray]


class FloorInformation(NamedTuple):
    """Information that the residuals on one floor contain, given their covariance.

    Attributes:
        of_effects: information about the effects of every run.
        pull: information times estimate of these effects, per unit of each column of the search
            vector, and at the fit.
        factor: Cholesky factor of the posterior precision of the effects' coefficients.
        half: inverse factor times the coefficients' information times estimate, as in `pull`.
        rows: product of rows; that of the effects' estimates is subtracted.
    """

    of_effects: Float[np.ndarray, "run axis axis"]
    pull: Float[np.ndarray, "run axis column"]
    factor: Float[np.ndarray, "coef coef"]
    half: Float[np.ndarray, "coef column"]
    rows: Float[np.ndarray, "column column"]


def floor_information(
    floor: FloorRuns, rows: Rows, inverse: dict[str, np.ndarray], log_v: Variances
) -> FloorInformation:
    """Return the information of a floor's residuals.

    `inverse` holds the weighted inverse of every segment's covariance, keyed by block.
    """
    mine = np.append(floor.columns, -1)
    product = np.zeros((len(mine), len(mine)))
    axes = floor.effect.shape[-1]
    of_effects, pull = np.zeros((0, axes, axes)), np.zeros((0, axes, len(mine)))
    for k, whole in rows.items():
        part, by = whole[floor.segments][..., mine], inverse[k][floor.segments]
        white = by @ part
        product += part.reshape(-1, len(mine)).T @ white.reshape(-1, len(mine))
        if axes:
            turned = np.swapaxes(floor.effect, 1, 2)
            of_effects, pull = turned @ by @ floor.effect, turned @ white
    if not axes:
        none = np.zeros((0, len(mine)))
        return FloorInformation(of_effects, pull, np.zeros((0, 0)), none, product)
    basis = _basis(floor, log_v)
    start = np.cumsum([0, *(b.shape[1] for b in basis)])
    at = [slice(*ends) for ends in pairwise(start)]
    inner = np.eye(start[-1])  # only its lower triangle is used
    for i, j in zip(*np.tril_indices(axes), strict=True):
        inner[at[i], at[j]] += basis[i].T @ (of_effects[:, i, j, None] * basis[j])
    factor = np.linalg.cholesky(inner)
    of_coefs = np.concatenate([a.T @ pull[:, i] for i, a in enumerate(basis)])
    half = solve_triangular(factor, of_coefs, lower=True, check_finite=False)
    return FloorInformation(of_effects, pull, factor, half, product - half.T @ half)


def _stds(floor: FloorRuns, log_v: Variances) -> np.ndarray:
    return np.array([np.exp(0.5 * log_v[n]) if n >= 0 else 0.0 for n in floor.numbers])


def _basis(floor: FloorRuns, log_v: Variances) -> list[np.ndarray]:
    """Return the effects of runs on each axis per unit coefficient."""
    scaled = [s * r for s, r in zip(_stds(floor, log_v), floor.roots, strict=True)]
    return [np.concatenate(scaled[k : k + 2], axis=1) for k in range(0, len(scaled), 2)]


def _linear_draw(
    part: LinearPart,
    floors: tuple[FloorRuns, ...],
    inverse: dict[str, np.ndarray],
    log_v: Variances,
    rng: np.random.Generator,
) -> LinearDraw:
    """Return draws of steps 1 and 2 of a sweep, that of the load biases' variance included."""
    first = part.given @ rng.standard_normal(len(part.pull))
    rows = {k: r.copy() for k, r in part.rows_at(log_v).items()}
    for r in rows.values():
        r[..., -1] += r[..., :-1] @ first
    found = [floor_information(floor, rows, inverse, log_v) for floor in floors]
    precision, pull = part.precision.copy(), part.pull.copy()
    for floor, info in zip(floors, found, strict=True):
        precision[np.ix_(floor.columns, floor.columns)] += info.rows[:-1, :-1]
        pull[floor.columns] -= info.rows[:-1, -1]
    log_v = log_v.copy()
    if part.pooled is not None:
        log_v[part.pooled.number] = _pooled_draw(part.pooled, precision, pull, rng)
        part.pooled.add(precision, pull, log_v)
    root = np.linalg.cholesky(precision)
    noise = solve_triangular(root, rng.standard_normal(len(pull)), lower=True, trans=1)
    change = np.where(part.given.any(axis=1), 0.0, cho_solve((root, True), pull) + noise)
    effects = []
    for floor, info in zip(floors, found, strict=True):
        whole = np.append(change[floor.columns], 1.0)
        mean = info.half @ whole + rng.standard_normal(len(info.half))
        coefs = solve_triangular(info.factor, mean, lower=True, trans=1, check_finite=False)
        known = info.of_effects, info.pull @ whole
        effects.append(_effect_draws(part, floor, known, coefs, log_v, rng))
    return LinearDraw(log_v, first + change, effects)


def _pooled_draw(
    of: PooledPrior, precision: Square, pull: Search, rng: np.random.Generator
) -> float:
    """Return a draw of the log variance of the load biases, all changes integrated out.

    The precision and the pull of the changes of the search vector lack the prior of load biases.
    """
    found = stds_given(precision, pull - precision[:, of.at] @ of.change, of.at, of.typical)
    return float(2 * np.log(rng.choice(found.std, p=found.weight)))


def _effect_draws(
    part: LinearPart,
    floor: FloorRuns,
    known: tuple[np.ndarray, np.ndarray],
    coefs: Float[np.ndarray, " coef"],
    log_v: Variances,
    rng: np.random.Generator,
) -> Float[np.ndarray, "run axis"]:
    """Return the effects of all runs, and draw their variances in place.

    Args:
        known: information about every run's effects, and information times estimate.
        coefs: coefficients of the effects.
        log_v: all log variances; those of the floor's shared effects are overwritten.
    """
    information, pull = known
    split = np.cumsum([r.shape[1] for r in floor.roots])[:-1]
    if not floor.roots:
        return np.zeros_like(pull)
    units = [r @ u for r, u in zip(floor.roots, np.split(coefs, split), strict=True)]
    squares = [float(u @ u) for u in np.split(coefs, split)]
    effects = np.zeros_like(pull)
    for k, (std, unit) in enumerate(zip(_stds(floor, log_v), units, strict=True)):
        effects[:, k // 2] += std * unit
    for k, (n, unit) in enumerate(zip(floor.numbers, units, strict=True)):
        size = floor.roots[k].shape[1]
        if n < 0:
            continue
        if not size:  # residuals do not depend on it
            log_v[n] = rng.normal(float(part.typical[n]), VARIANCE_SPREAD)
            continue
        axis, before, typical = k // 2, float(log_v[n]), float(part.typical[n])
        std = np.exp(0.5 * before)
        curvature = float(unit**2 @ information[:, axis, axis])
        rest = pull[:, axis] - np.einsum("na,na->n", information[:, axis], effects)
        slope = float(unit @ rest) + curvature * std
        now = sliced(partial(_given_coefs, slope, curvature, typical), before, _STEP, rng)
        effects[:, axis] += (np.exp(0.5 * now) - std) * unit
        square = squares[k] * math.exp(now)
        log_v[n] = sliced(partial(_given_effects, size, square, typical), now, _STEP, rng)
    return effects


def _given_coefs(slope: float, curvature: float, typical: float, log_v: float) -> float:
    """Return the log density of an effect's log variance, given the effect's coefficients.

    `slope` and `curvature` are those of the log likelihood with respect to the std of the effect.
    """
    std, deviation = math.exp(0.5 * log_v), (log_v - typical) / VARIANCE_SPREAD
    return slope * std - 0.5 * curvature * std**2 - 0.5 * deviation**2


def _given_effects(size: int, square: float, typical: float, log_v: float) -> float:
    """Return the log density of an effect's log variance, given the effects themselves.

    `square` is the sum of the squares of the `size` coefficients, times the variance.
    """
    deviation = (log_v - typical) / VARIANCE_SPREAD
    return -0.5 * (size * log_v + square * math.exp(-log_v) + deviation**2)


def _drawn_weights(
    degrees: float,
    count: Float[np.ndarray, " segment"],
    square: Float[np.ndarray, "chain segment"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "chain segment"]:
    """Return weights of segments, drawn given the squared norms of their whitened residuals.

    `count` is the number of residuals of each segment.
    """
    return rng.gamma(0.5 * (degrees + count), size=square.shape) / (0.5 * (degrees + square))


class Gaussian(NamedTuple):
    """Mean and covariance of log variances."""

    mean: Variances
    covariance: Float[np.ndarray, "variance variance"]

    def learned(self, states: Sequence[Chains]) -> "Gaussian":
        """Return the moments of states of chains, blended with those of this Gaussian."""
        x = np.concatenate(states)
        share = len(x) / (len(x) + _PSEUDO)
        mean = share * x.mean(axis=0) + (1 - share) * self.mean
        off = x - mean
        return Gaussian(mean, share * off.T @ off / len(x) + (1 - share) * self.covariance)

    def root(self, moved: Bool[np.ndarray, " variance"]) -> np.ndarray:
        """Return a root of the covariance; variances that are not moved have zeros."""
        out, mine = np.zeros_like(self.covariance), np.ix_(moved, moved)
        out[mine] = np.linalg.cholesky(self.covariance[mine])
        return out
