"""Slip models with estimated noise variances, so that they can forecast distributions of runs."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import block_diag

from slipid.data.windows import Windows
from slipid.fitting import likelihood as lk
from slipid.fitting.noise import effects
from slipid.fitting.problem import Problem
from slipid.fitting.session_effects import LinearModel, by_axis, with_session_effects
from slipid.fitting.variances import DEGREES, scoring_step
from slipid.model.robot import Robot
from slipid.predict import open_loop as replay
from slipid.predict.predictive import (
    ForceBalance,
    PredictiveModel,
    Residuals,
    Slopes,
    by_name,
    parameter_covariance,
)
from slipid.predict.slip_models import FloorModels
from slipid.search_space import Space

MOST_ROUNDS, SCORING_STEPS, SETTLED_CHANGE = 15, 4, 0.02
"""Limits of the fit of variances: largest number of rounds, scoring steps per round, and the change
of every log variance below which rounds stop.

The covariance of the model's coefficients is computed once per round.
"""
VAGUE_PRECISION = 1e-2
"""Prior precision of a model's coefficients: a std of 10 is uninformative for slips below one."""
STEP = 1e-4
"""Step of a coefficient in the difference quotients that differentiate a model."""


@dataclass(frozen=True, eq=False)
class FittedSlipModel(PredictiveModel):
    """A fitted slip model with its noise variances and the camera of the force balance.

    The model is fitted to poses that this camera corrects; errors of the camera's parameters
    propagate to the model's coefficients.

    Attributes:
        model: the slip model, fitted floor by floor.
        contact: fitted force balance, from which the camera is taken.
    """

    model: FloorModels
    contact: ForceBalance

    @property
    def name(self) -> str:
        return self.model.name

    @property
    def numbers(self) -> dict[str, int]:
        sizes = dict.fromkeys(self.robot.surfaces.labels, 0)
        for key, value in self.model.state.items():
            sizes[next(f for f in sizes if key == f or key.startswith(f"{f}@"))] += value.size
        return sizes | {"shared": 0}

    def linear(self, problem: Problem) -> tuple[Residuals, Slopes]:
        model, z, b = self.model, self.contact.z, problem.batch
        w = problem.windows.at_lag(float(self.robot.camera.lag))

        def residual(model: FloorModels) -> np.ndarray:
            return np.asarray(_residual(problem.space, z, model.twist(w, self.robot), b))

        by_z = np.asarray(_residual_jacobian(problem.space, z, model.twist(w, self.robot), b))
        by_camera = by_z[..., self.contact.camera]
        return residual(model), np.concatenate([slopes(model, w, residual), by_camera], axis=-1)

    def tracks_and_slopes(self, w: Windows) -> tuple[replay.Tracks, Slopes]:
        robot, contact = self.robot, self.contact

        def tracks_of(model: FloorModels) -> replay.Tracks:
            return replay.tracks_from_increments(robot, w, model.increments(w, robot))

        tracks = tracks_of(self.model)
        twist, start = self.model.twist(w, robot), tracks.predicted[:, 0]
        camera = replay.end_jacobian(contact.space, contact.z, lk.batch(w, robot), start, twist)
        own = slopes(self.model, w, lambda model: tracks_of(model).predicted[:, -1, :2])
        return tracks, np.concatenate([own, np.asarray(camera)[..., contact.camera]], axis=-1)


def fit_with_noise(
    model: FloorModels, contact: ForceBalance, problem: Problem, keep: Float[np.ndarray, " segment"]
) -> FittedSlipModel:
    """Return a slip model fitted to the kept segments of a problem, with noise from its residuals.

    Variances are estimated by Fisher scoring of the restricted likelihood, as for the force
    balance. This likelihood accounts for the degrees of freedom of the model's coefficients.
    """
    robot = contact.robot
    w = problem.windows.at_lag(float(robot.camera.lag)).segments(np.flatnonzero(keep > 0))
    model = model.fit(w, robot)
    before = _prior_precision(model, w, robot)
    common = contact.covariance[np.ix_(contact.camera, contact.camera)]
    plain = FittedSlipModel(robot, contact.variance, common, model, contact)
    residual, slope = plain.linear(problem)
    log_v, count = jnp.asarray(contact.log_variance(problem)), jnp.asarray(keep, float)
    own_effects = np.array([c.kind == "run" for c in problem.noise.components])
    objective = replace(problem.objective, scored=problem.objective.scored | own_effects)
    for _ in range(MOST_ROUNDS):
        last = log_v
        scale = np.asarray(problem.covariance("motion", log_v))
        covariance = _number_covariance(before, common, scale, slope, keep)
        spread = jnp.asarray(parameter_covariance(slope, covariance))
        blocks = {"motion": jnp.asarray(residual)}, {"motion": spread}
        for _ in range(SCORING_STEPS):
            log_v = scoring_step(objective, *blocks, log_v, count, None)
        if float(jnp.abs(log_v - last).max()) < SETTLED_CHANGE:
            break
    variance, w = by_name(problem, log_v), problem.windows
    fitted = LinearModel(
        residual,
        slope,
        covariance=covariance,
        wide=block_diag(np.linalg.inv(before), common),
        scale=np.asarray(problem.covariance("motion", log_v)),
        effect=effects(w, robot),
        run=by_axis(variance, "run", w),
    )
    of_sessions, covariance = with_session_effects(fitted, w, np.asarray(keep, float))
    return replace(plain, variance=variance | of_sessions, covariance=covariance)


def _prior_precision(model: FloorModels, w: Windows, robot: Robot) -> np.ndarray:
    """Return the precision matrix of the prior of a model's coefficients.

    It is the sum of a vague prior, of the ridge penalties, and of a large precision for each
    coefficient that the fit left at its bound.
    """
    held = model.stiffness(w, robot)
    parts = [
        VAGUE_PRECISION * np.eye(v.size) + held.get(key, 0.0) for key, v in model.state.items()
    ]
    return np.asarray(block_diag(np.zeros((0, 0)), *parts))


def _number_covariance(
    before: np.ndarray, common: np.ndarray, scale: np.ndarray, slope: Slopes, keep: np.ndarray
) -> np.ndarray:
    """Return the joint covariance of a model's coefficients and of the camera's parameters.

    The fitted coefficients shift with the camera's parameters, whose errors are thus part of the
    covariance of the coefficients.

    Args:
        before: prior precision of the model's coefficients.
        common: covariance of the camera's parameters.
        scale: noise covariance of every segment.
        slope: derivative of the residuals with respect to the coefficients, then with respect to
            the camera's parameters.
        keep: 1 for fitted segments, else 0.
    """
    own, m = len(before), slope.shape[1]
    factor = keep * (DEGREES + m) / (DEGREES + m + 2)
    weighted = np.linalg.solve(scale, slope[..., :own]) * factor[:, None, None]
    rows = len(slope) * m
    to_own = weighted.reshape(rows, own).T @ slope.reshape(rows, -1)
    alone = np.linalg.inv(before + to_own[:, :own])
    follows = -alone @ to_own[:, own:]
    both = np.concatenate([follows, np.eye(len(common))])
    out = both @ common @ both.T
    out[:own, :own] += alone
    return np.asarray(0.5 * (out + out.T))


@eqx.filter_jit
def _residual(space: Space, z: replay.Numbers, twist: replay.Numbers, b: lk.Batch) -> Array:
    robot = space.tree(z)
    residual = lk.marker_increments(
        robot, jnp.asarray(twist), b.dt, b.session
    ) - lk.measured_increments(robot, b.pose)
    return residual.reshape(residual.shape[0], -1)


_residual_jacobian = eqx.filter_jit(jax.jacfwd(_residual, argnums=1))


def slopes(model: FloorModels, w: Windows, of: Callable[[FloorModels], np.ndarray]) -> np.ndarray:
    """Return the derivative of `of(model)` with respect to the coefficients (segment, ..., number).

    Coefficients are in the order of the keys of `state`. Each segment depends on the coefficients
    of one key only, so that one coefficient of every key is varied at the same time.
    """
    ends = np.cumsum([0, *(v.size for v in model.state.values())]).tolist()
    now = of(model)
    out, keys = np.zeros((*now.shape, ends[-1])), model.keys(w)
    for k in range(max((v.size for v in model.state.values()), default=0)):
        moved = {key: np.array(value, float) for key, value in model.state.items()}
        for value in moved.values():
            value.flat[k : k + 1] += STEP
        quotient = (of(model.with_state(moved)) - now) / STEP
        for key, first, last in zip(model.state, ends[:-1], ends[1:], strict=True):
            if first + k < last:
                out[keys == key, ..., first + k] = quotient[keys == key]
    return out
