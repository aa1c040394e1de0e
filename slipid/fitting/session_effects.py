"""Effects that the runs of one session share beyond the model, and the covariance they enlarge.

Runs driven on one floor in one session all slip a little more, or all a little less, than the model
predicts. The slip models of the comparison are fitted as if runs were independent. After such a
fit, run i has the remaining effects

    a_i = (E_i^T W_i E_i)^-1 E_i^T W_i r_i     along, across, yaw

where r_i are its residuals, E_i is their change per unit of an effect, and W_i is the inverse of
the covariance that r_i has without run effects. A part of a_i is common to the session. Its
variance v is estimated per floor and axis by restricted likelihood, at fixed variances of the run
effects. This estimate alternates with the Student-t weights of the runs, so that a run is not
down-weighted for an effect that its whole session shares. The covariance C of the fitted parameters
grows to

    C + C (sum_s v u_s u_s^T) C,    u_s = sum_{i in s} J_i^T V_i^-1 E_i

with the derivative J_i of r_i with respect to the parameters, and the covariance V_i of r_i.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from slipid.data.windows import Windows
from slipid.fitting.shared_effects import AXES
from slipid.fitting.variances import DEGREES

LOG_VARIANCE_STD = 3.0
"""Prior std of a session effect's log variance; the prior mean is that of the run effects."""
ROUNDS = 4
"""Number of alternations between weights and variances."""


@dataclass(frozen=True, eq=False)
class LinearModel:
    """A fitted model linearised at its fit, on all segments of a problem.

    Attributes:
        gap: predicted less measured increments.
        slope: derivative of the increments with respect to the fitted parameters.
        covariance: covariance of the fitted parameters.
        wide: covariance of the fitted parameters before the floor's own runs were used.
        scale: noise covariance of `gap`, including the individual effect of the run.
        effect: change of the increments per unit of an effect along, across and in yaw.
        run: variance of the individual effects of runs along, across and in yaw.
    """

    gap: Float[np.ndarray, "segment m"]
    slope: Float[np.ndarray, "segment m number"]
    covariance: Float[np.ndarray, "number number"]
    wide: Float[np.ndarray, "number number"]
    scale: Float[np.ndarray, "segment m m"]
    effect: Float[np.ndarray, "segment m 3"]
    run: Float[np.ndarray, "segment 3"]


def with_session_effects(
    model: LinearModel, w: Windows, keep: Float[np.ndarray, " segment"]
) -> tuple[dict[str, float], Float[np.ndarray, "number number"]]:
    """Return variances keyed `session.<floor>.<axis>`, and the covariance that includes them.

    The covariance is that of the fitted parameters, enlarged as in the module docstring.
    A floor driven in only one session has no such variances: the common effect of its runs is then
    part of the floor's fitted parameters.
    """
    variance: dict[str, float] = {}
    for _ in range(ROUNDS):
        variance = _variances(model, w, keep, _weights(model, by_axis(variance, "session", w)))
    weighted = np.swapaxes(model.effect, 1, 2) @ np.linalg.solve(model.scale, model.slope)
    scores = weighted * _weights(model, np.zeros_like(model.run))[:, None, None]
    of_session = by_axis(variance, "session", w)
    meat = np.zeros_like(model.covariance)
    of_segment = list(zip(w.surface, w.session, strict=True))
    for pair in dict.fromkeys(of_segment):
        mine = np.array([other == pair for other in of_segment]) & (keep > 0)
        if mine.any():
            u = scores[mine].sum(axis=0)
            meat += u.T @ (of_session[mine][0][:, None] * u)
    return variance, model.covariance + model.covariance @ meat @ model.covariance


def by_axis(variance: Mapping[str, float], kind: str, w: Windows) -> Float[np.ndarray, "segment 3"]:
    """Return the variances of one kind of effect along, across and in yaw, for every segment.

    A variance is zero if `variance` has no key `<kind>.<floor>.<axis>`.
    """
    return np.array([on_floor(variance, kind, floor) for floor in w.surface])


def on_floor(
    values: Mapping[str, float],
    kind: str,
    floor: str,
    default: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Float[np.ndarray, "3"]:
    """Return the values keyed `<kind>.<floor>.<axis>` along, across and in yaw, or `default`."""
    names = [f"{kind}.{floor}.{axis}" for axis in AXES]
    return np.array([values.get(name, usual) for name, usual in zip(names, default, strict=True)])


def _variances(
    model: LinearModel, w: Windows, keep: np.ndarray, weight: np.ndarray
) -> dict[str, float]:
    """Return the variances of session effects, keyed by name, at given weights of the segments."""
    session, floor = np.asarray(w.session), np.asarray(w.surface)
    left, noise, slope = remaining_effects(
        model.gap, model.slope, model.scale, model.effect, model.run
    )
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
    """Return the Student-t weight of every segment.

    `more` holds variances of effects (segment, 3) that are added to the noise covariance.
    """
    e = model.effect
    scale = model.scale + np.einsum("nma,na,nla->nml", e, more, e)
    white = np.linalg.solve(scale, model.gap[..., None])[..., 0]
    q, m = np.sum(model.gap * white, axis=1), model.gap.shape[1]
    return np.asarray((DEGREES + m) / (DEGREES + q))


def remaining_effects(
    gap: np.ndarray, slope: np.ndarray, scale: np.ndarray, effect: np.ndarray, run: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return remaining effects of each run (run, 3), their noise variances, and their derivative.

    The derivative (run, 3, number) is with respect to the fitted parameters. The arguments are
    attributes of `LinearModel`.
    """
    plain = scale - np.einsum("nma,na,nla->nml", effect, run, effect)
    by_noise = np.linalg.solve(plain, effect)
    cov = np.linalg.inv(np.swapaxes(effect, 1, 2) @ by_noise)
    take = cov @ np.swapaxes(by_noise, 1, 2)
    left = np.einsum("nam,nm->na", take, gap)
    return left, np.diagonal(cov, axis1=1, axis2=2), take @ slope


def _variance(left: np.ndarray, own: np.ndarray, member: np.ndarray, centre: float) -> float:
    """Return the most likely variance of effects shared by the members of each session.

    Args:
        left: remaining effects of the runs.
        own: covariance of `left` without shared effects.
        member: 1 if a run belongs to a session, else 0 (run, session).
        centre: centre of the prior of the log variance.
    """
    root = np.linalg.cholesky(own)
    white = np.linalg.solve(root, np.concatenate([left[:, None], member], axis=1))
    scale, turn = np.linalg.eigh(white[:, 1:].T @ white[:, 1:])
    along = turn.T @ (white[:, 1:].T @ white[:, 0])

    def loss(log_v: float) -> float:
        grown = 1.0 + np.exp(log_v) * scale
        explained = np.exp(log_v) * np.sum(along**2 / grown)
        deviation = (log_v - centre) / LOG_VARIANCE_STD
        return float(0.5 * (np.log(grown).sum() - explained + deviation**2))

    span = (centre - 4 * LOG_VARIANCE_STD, centre + 4 * LOG_VARIANCE_STD)
    return float(np.exp(minimize_scalar(loss, bounds=span, method="bounded").x))
