"""What the runs of one session share beyond the model, and how much less they then tell.

Runs driven on one floor at one time slip a little more or less than the model says, all of them
together: a slip model of the comparison is fitted as if they were independent. After its fit the
effects that are left in its runs,

    a_i = (E_i^T W_i E_i)^-1 E_i^T W_i r_i     along, across, yaw

have a part that is common to the session (E_i moves the residuals by an effect, W_i weighs
without the run effects). Its variance v is found per floor and axis by restricted
likelihood, the run effects' own held, in turn with the Student-t weights of the runs, which are
outliers only for what their session does not share; the covariance C of the fitted numbers grows to

    C + C (sum_s v u_s u_s^T) C,    u_s = sum_{i in s} J_i^T V_i^-1 E_i
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from slipid.data.windows import Windows
from slipid.fit.shared_effects import AXES
from slipid.fit.variances import DEGREES

SPREAD = 3.0
"""Std of the prior of a log variance, around that of the run effects."""
TURNS = 4
"""Of weights and variances, each given the other."""


@dataclass(frozen=True, eq=False)
class LinearModel:
    """A fitted model made linear at its fit, on all pieces of a problem.

    Gap is predicted less measured; `wide` the covariance of the numbers as they were before a
    floor's own runs were seen; scale the noise covariance, the run's own effect included; effect
    what one unit along, across and in yaw moves; run the variance of these effects.
    """

    gap: Float[np.ndarray, "piece m"]
    slope: Float[np.ndarray, "piece m number"]
    covariance: Float[np.ndarray, "number number"]
    wide: Float[np.ndarray, "number number"]
    scale: Float[np.ndarray, "piece m m"]
    effect: Float[np.ndarray, "piece m 3"]
    run: Float[np.ndarray, "piece 3"]


def with_session_effects(
    model: LinearModel, w: Windows, keep: Float[np.ndarray, " piece"]
) -> tuple[dict[str, float], Float[np.ndarray, "number number"]]:
    """Variances `session.<floor>.<axis>`, and the covariance of the numbers with them.

    A floor that was driven in one session only has none: what it shares is in the floor's numbers.
    """
    variance: dict[str, float] = {}
    for _ in range(TURNS):
        variance = _variances(model, w, keep, _weights(model, by_axis(variance, "session", w)))
    weighted = np.swapaxes(model.effect, 1, 2) @ np.linalg.solve(model.scale, model.slope)
    pulls = weighted * (_weights(model, np.zeros_like(model.run)) * keep)[:, None, None]
    of_session = by_axis(variance, "session", w)
    meat = np.zeros_like(model.covariance)
    of_segment = floors_and_sessions(w)
    for pair in dict.fromkeys(of_segment):
        mine = np.array([other == pair for other in of_segment]) & (keep > 0)
        if mine.any():
            u = pulls[mine].sum(axis=0)
            meat += u.T @ (of_session[mine][0][:, None] * u)
    return variance, model.covariance + model.covariance @ meat @ model.covariance


def floors_and_sessions(w: Windows) -> list[tuple[str, str]]:
    """Floor and session of every piece; what is shared is shared by these."""
    return list(zip(w.surface, w.session, strict=True))


def by_axis(variance: Mapping[str, float], kind: str, w: Windows) -> Float[np.ndarray, "piece 3"]:
    """Variances of an effect of every piece, zero where there is none."""
    return np.array([[variance.get(f"{kind}.{f}.{axis}", 0.0) for axis in AXES] for f in w.surface])


def _variances(
    model: LinearModel, w: Windows, keep: np.ndarray, weight: np.ndarray
) -> dict[str, float]:
    session, floor = np.asarray(w.session), np.asarray(w.surface)
    left, noise, slope = _remaining_effects(model)
    variance: dict[str, float] = {}
    for name in dict.fromkeys(floor[keep > 0].tolist()):
        mine = (floor == name) & (keep > 0)
        if len(set(session[mine].tolist())) < 2:
            continue
        member = (session[mine][:, None] == np.unique(session[mine])).astype(float)
        for k, axis in enumerate(AXES):
            run = model.run[mine, k]
            own = np.diag((noise[mine, k] + run) / weight[mine])
            own += slope[mine, k] @ model.wide @ slope[mine, k].T
            found = _variance(left[mine, k], own, member, float(np.log(run.mean())))
            variance[f"session.{name}.{axis}"] = found
    return variance


def _weights(model: LinearModel, more: np.ndarray) -> np.ndarray:
    """Student-t weight of every piece, given the variances of effects beyond its scale."""
    e = model.effect
    scale = model.scale + np.einsum("nma,na,nla->nml", e, more, e)
    white = np.linalg.solve(scale, model.gap[..., None])[..., 0]
    q, m = np.sum(model.gap * white, axis=1), model.gap.shape[1]
    return np.asarray((DEGREES + m) / (DEGREES + q))


def _remaining_effects(model: LinearModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Effects left in each run (piece, 3), their variance by camera and process, their slope."""
    e = model.effect
    plain = model.scale - np.einsum("nma,na,nla->nml", e, model.run, e)
    by_noise = np.linalg.solve(plain, e)
    cov = np.linalg.inv(np.swapaxes(e, 1, 2) @ by_noise)
    take = cov @ np.swapaxes(by_noise, 1, 2)
    left = np.einsum("nam,nm->na", take, model.gap)
    return left, np.diagonal(cov, axis1=1, axis2=2), take @ model.slope


def _variance(left: np.ndarray, own: np.ndarray, member: np.ndarray, centre: float) -> float:
    """Most likely variance of what the members of each session share (run, session), each 1 or 0.

    `own` is the covariance of the effects left without it, `centre` that of the log variance's
    prior.
    """
    root = np.linalg.cholesky(own)
    white = np.linalg.solve(root, np.concatenate([left[:, None], member], axis=1))
    scale, turn = np.linalg.eigh(white[:, 1:].T @ white[:, 1:])
    along = turn.T @ (white[:, 1:].T @ white[:, 0])

    def loss(log_v: float) -> float:
        grown = 1.0 + np.exp(log_v) * scale
        told = np.exp(log_v) * np.sum(along**2 / grown)
        pull = (log_v - centre) / SPREAD
        return float(0.5 * (np.log(grown).sum() - told + pull**2))

    span = (centre - 4 * SPREAD, centre + 4 * SPREAD)
    return float(np.exp(minimize_scalar(loss, bounds=span, method="bounded").x))
