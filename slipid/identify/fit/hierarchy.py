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

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.identify.fit.shared import AXES, FloorShared
from slipid.identify.fit.variances import VARIANCE_SPREAD, Search, Square, Target

_STEPS = 3
"""Scoring steps in a turn."""
_GRID = np.geomspace(0.1, 4.0, 60)
"""Stds of the load biases that are weighed, over the typical one."""


def effect_variances(
    target: Target,
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
    space, out = target.space, np.array(log_v)
    of_floor = space.where(lambda e: e.surface is not None)
    wide = np.where(of_floor[:, None] | of_floor, 0.0, covariance)
    wide[of_floor, of_floor] = space.prior_std[of_floor] ** 2
    scale = np.asarray(target.blocks["motion"].covariance(jnp.asarray(log_v)))
    gap, slope, counted = np.asarray(motion[0]), np.asarray(motion[1]), np.asarray(weight)
    for floor in target.shared:
        kept = counted[np.asarray(floor.pieces)] > 0
        mine = np.asarray(floor.pieces)[kept]
        if len(mine) < 2:
            continue
        run = np.exp(log_v)[np.asarray(floor.numbers)[0]]
        left, noise, by = _left(
            gap[mine], slope[mine], scale[mine], np.asarray(floor.effect)[kept], run
        )
        for k in range(len(AXES)):
            base = noise[:, k] / counted[mine]
            fixed = np.diag(base) + by[:, k] @ wide @ by[:, k].T
            pieces = _pieces(floor, k, kept, counted[mine])
            number = [n for n, _ in pieces]
            out[number] = _scored(
                left[:, k],
                fixed,
                [c for _, c in pieces],
                out[number],
                np.asarray(target.typical)[number],
            )
    return out


def _pieces(
    floor: FloorShared, axis: int, kept: Bool[np.ndarray, " run"], weight: np.ndarray
) -> list[tuple[int, np.ndarray]]:
    """Variance numbers, and what each makes of the covariance of the effects along an axis."""
    own, near, session = np.asarray(floor.numbers)[:, axis].tolist()
    root, member = np.asarray(floor.near)[kept], np.asarray(floor.session)[kept]
    found = [(own, np.diag(1 / weight)), (near, root @ root.T), (session, member @ member.T)]
    return [(number, matrix) for number, matrix in found if number >= 0]


def _left(
    gap: np.ndarray, slope: np.ndarray, scale: np.ndarray, effect: np.ndarray, run: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Effects left in each run (run, 3), their variance by camera and process, their slope."""
    plain = scale - np.einsum("nma,a,nla->nml", effect, run, effect)
    by_noise = np.linalg.solve(plain, effect)
    cov = np.linalg.inv(np.swapaxes(effect, 1, 2) @ by_noise)
    take = cov @ np.swapaxes(by_noise, 1, 2)
    left = np.einsum("nam,nm->na", take, gap)
    return left, np.diagonal(cov, axis1=1, axis2=2), take @ slope


def _scored(
    left: np.ndarray,
    fixed: np.ndarray,
    bases: list[np.ndarray],
    log_v: np.ndarray,
    typical: np.ndarray,
) -> Float[np.ndarray, " component"]:
    """Log variances after Fisher scoring steps of the restricted likelihood.

    A step that makes it smaller is halved.
    """

    def loss(at: np.ndarray) -> float:
        root = np.linalg.cholesky(
            fixed + sum(k * b for k, b in zip(np.exp(at), bases, strict=True))
        )
        white = np.linalg.solve(root, left)
        pull = (at - typical) / VARIANCE_SPREAD
        return float(np.log(np.diag(root)).sum() + 0.5 * white @ white + 0.5 * pull @ pull)

    before = loss(log_v)
    for _ in range(_STEPS):
        v = np.exp(log_v)
        inverse = np.linalg.inv(fixed + sum(k * b for k, b in zip(v, bases, strict=True)))
        white = inverse @ left
        grown = [k * (inverse @ b) for k, b in zip(v, bases, strict=True)]
        score = [
            0.5 * (k * white @ b @ white - np.trace(g))
            for k, b, g in zip(v, bases, grown, strict=True)
        ]
        info = [[0.5 * np.sum(a * b.T) for b in grown] for a in grown]
        pull = (log_v - typical) / VARIANCE_SPREAD**2
        whole = np.array(info) + np.eye(len(v)) / VARIANCE_SPREAD**2
        step = np.clip(np.linalg.solve(whole, np.array(score) - pull), -1.5, 1.5)
        while (after := loss(log_v + step)) > before and np.abs(step).max() > 1e-3:
            step = step / 2
        if after <= before:
            log_v, before = log_v + step, after
    return np.asarray(log_v)


def pooled(
    precision: Square, z: Search, target: Target, log_v: Float[np.ndarray, " variance"]
) -> float:
    """Log of the mean variance of the load biases of floors, with a half-normal prior of its root.

    The fit is a Gaussian of that precision around z; its evidence for every std is known.

    Source: Gelman 2006, Bayesian Analysis 1(3), on half-normal priors of group stds.
    """
    at = np.flatnonzero(target.space.where(lambda e: e.declaration.deviation))
    now = np.exp(-log_v[target.pooled])
    told = np.asarray(precision).copy()
    away = np.zeros(len(told))
    away[at] = z[at]
    pull = told @ away
    told[at, at] -= now
    typical = np.exp(0.5 * float(target.typical[target.pooled]))
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
    return float(np.log(np.sum(weight * (_GRID * typical) ** 2) / weight.sum()))
