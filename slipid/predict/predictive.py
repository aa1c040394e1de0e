"""Predictive distributions of fitted models for runs that were not fitted.

Every model gets a predictive distribution of the same form: a Student t around its prediction, with
the scale matrix

    V + E diag(v) E^T + J C J^T

V is the noise covariance, with camera, process and run variances estimated from the model's own
residuals by restricted likelihood. v are the variances of shared effects, and E is the derivative
of the increments with respect to these effects. J is the derivative of the increments with respect
to the parameters of the model and of the camera, and C is the covariance of these parameters.
Simpler models have session effects only (`slipid.fitting.session_effects`). The force balance has
the session and neighbours' effects of its fit (`slipid.fitting.shared_effects`); the variances of
shared effects and of parameters are multiplied by a factor from held-out sectors
(`hierarchy.extrapolation`). All models use the camera fitted with the force balance, and errors of
the camera propagate to the coefficients of the simpler models.
"""

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.special import gammaln

from slipid.data.windows import Windows
from slipid.fitting import likelihood as lk
from slipid.fitting.hierarchy import axis_effects, extrapolation
from slipid.fitting.noise import SHARED, effects, travel
from slipid.fitting.problem import FitState, Problem
from slipid.fitting.session_effects import by_axis
from slipid.fitting.shared_effects import (
    AXES,
    EffectForecast,
    FittedEffects,
    TravelConditions,
    forecast_effects,
)
from slipid.fitting.variances import (
    DEGREES,
    Blocks,
    Search,
    Square,
    Vector,
    expected_posteriors,
    whitened,
)
from slipid.model.robot import Robot
from slipid.predict import open_loop as replay
from slipid.predict.slip_model import body_poses, setups, turned_left
from slipid.search_space import Space

Residuals = Float[np.ndarray, "segment m"]
Slopes = Float[np.ndarray, "segment m number"]


@dataclass(frozen=True, eq=False)
class PredictiveModel(abc.ABC):
    """A fitted model with its noise variances, so that it predicts distributions.

    Attributes:
        robot: the fitted robot, of which the camera and the geometry are used.
        variance: variances, keyed by name, of every noise component and of any session effects.
        covariance: covariance of the model's parameters, followed by those of the camera.
    """

    robot: Robot
    variance: Mapping[str, float]
    covariance: Float[np.ndarray, "number number"]

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Name of the model."""

    @property
    @abc.abstractmethod
    def numbers(self) -> dict[str, int]:
        """Number of fitted parameters, keyed by floor, or `shared` for those of all floors.

        Parameters of the camera are not counted.
        """

    def log_variance(self, problem: Problem) -> Float[np.ndarray, " variance"]:
        """Return the log variance of every noise component of a problem."""
        return np.log([self.variance[name] for name in problem.noise.names])

    @abc.abstractmethod
    def linear(self, problem: Problem) -> tuple[Residuals, Slopes]:
        """Return predicted less measured increments, and their derivative (segment, m, number).

        The derivative is with respect to the parameters of `covariance`.
        """

    @abc.abstractmethod
    def tracks_and_slopes(self, w: Windows) -> tuple[replay.Tracks, Slopes]:
        """Return tracks of whole runs and the derivatives of end points (segment, 2, number)."""

    def ends(self, w: Windows) -> tuple[replay.Tracks, Float[np.ndarray, "segment 2 2"]]:
        """Return tracks of whole runs and the scale matrices [m^2] of their end points."""
        tracks, slope = self.tracks_and_slopes(w)
        numbers, effect = self._number_covariance(w, slope), self.effect_covariance(w)
        return tracks, replay.end_covariance(self.robot, w, tracks, self.variance, effect, numbers)

    def scale(self, problem: Problem) -> tuple[Residuals, Float[np.ndarray, "segment m m"]]:
        """Return every segment's residuals, and the scale matrix of their Student t."""
        residual, slope = self.linear(problem)
        noise = np.asarray(problem.covariance("motion", self.log_variance(problem)))
        e = effects(problem.windows, problem.robot)
        v = self.effect_covariance(problem.windows)
        numbers = self._number_covariance(problem.windows, slope)
        return residual, noise + np.einsum("nma,nab,nlb->nml", e, v, e) + numbers

    def _number_covariance(self, w: Windows, slope: Slopes) -> Float[np.ndarray, "segment m m"]:
        """Return the covariance of predictions due to uncertain parameters, times `growth`."""
        return self.growth(w)[:, None, None] * parameter_covariance(slope, self.covariance)

    def growth(self, w: Windows) -> Float[np.ndarray, " segment"]:
        """Return each segment's factor on the variances of parameters and of shared effects.

        A factor above one accounts for runs unlike those that were fitted.
        """
        return np.ones(len(w))

    def effect_covariance(self, w: Windows) -> Float[np.ndarray, "segment 3 3"]:
        """Return the covariance of the shared effects of runs whose session was not fitted."""
        return by_axis(self.variance, "session", w)[:, :, None] * np.eye(len(AXES))

    def log_density(self, problem: Problem) -> Float[np.ndarray, " segment"]:
        """Return the predictive log density of each segment's logged poses, given its first pose.

        The density is per unit of the logged position and heading, before the camera corrects them.
        """
        return log_student(*self.scale(problem)) + np.asarray(
            lk.camera_log_jacobian(self.robot, problem.batch.pose)
        )


def log_student(
    residual: Residuals, scale: Float[np.ndarray, "segment m m"] | Float[np.ndarray, "m m"]
) -> Float[np.ndarray, " segment"]:
    """Return the log density of a Student t around zero with `DEGREES` degrees of freedom.

    Source: Kotz and Nadarajah 2004, Multivariate t Distributions, eq. 1.1.
    """
    m = residual.shape[-1]
    root = np.linalg.cholesky(scale)
    white = np.linalg.solve(root, residual[..., None])[..., 0]
    log_det = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(-1)
    norm = gammaln((DEGREES + m) / 2) - gammaln(DEGREES / 2) - 0.5 * m * np.log(DEGREES * np.pi)
    tail = 0.5 * (DEGREES + m) * np.log1p((white**2).sum(-1) / DEGREES)
    return np.asarray(norm - log_det - tail)


@dataclass(frozen=True, eq=False)
class ForceBalance(PredictiveModel):
    """The fitted force balance, at the search vector z.

    Attributes:
        space: free parameters and their prior.
        z: search vector of the fit.
        shared: fitted effects that runs in similar directions share, keyed by floor.
        extrapolation: factors, keyed by `floor@load`, that multiply the variances of parameters and
            shared effects for runs that were not fitted.
    """

    space: Space
    z: Search
    shared: Mapping[str, FittedEffects]
    extrapolation: Mapping[str, float]

    @property
    def name(self) -> str:
        return "identified"

    @property
    def forecast(self) -> dict[str, float]:
        """Variances, keyed by name, for runs that were not fitted.

        The variances of shared effects are multiplied by the largest extrapolation factor of the
        floor's load set-ups.
        """
        out = dict(self.variance)
        for name in out:
            kind, _, rest = name.partition(".")
            if kind in SHARED:
                floor = f"{rest.rpartition('.')[0]}@"
                grown = [x for k, x in self.extrapolation.items() if k.startswith(floor)]
                out[name] *= max(grown, default=1.0)
        return out

    def expected_effects(self, w: Windows) -> EffectForecast:
        """Return the shared effects that fitted neighbours predict for runs."""
        return forecast_effects(self.shared, w, self.robot, self.space.size)

    def effect_covariance(self, w: Windows) -> Float[np.ndarray, "segment 3 3"]:
        shared = super().effect_covariance(w) + self.expected_effects(w).covariance
        return self.growth(w)[:, None, None] * shared

    def growth(self, w: Windows) -> Float[np.ndarray, " segment"]:
        return np.array([self.extrapolation.get(name, 1.0) for name in setups(w)])

    @property
    def numbers(self) -> dict[str, int]:
        out = dict.fromkeys([*self.robot.surfaces.labels, "shared"], 0)
        held = self.space.held
        for e in self.space.free:
            if not e.declaration.electric and e.part != "camera":
                free = int(np.count_nonzero(~held[self.space.slices[e.path]]))
                out[e.surface or "shared"] += free
        return out

    @cached_property
    def camera(self) -> np.ndarray:
        """Indices of the search vector's elements that belong to the camera."""
        return np.flatnonzero(self.space.where(lambda e: e.part == "camera"))

    def linear(self, problem: Problem) -> tuple[Residuals, Slopes]:
        electric = problem.electric(self.z, self.log_variance(problem))
        blocks, jac = problem.linear(self.z, electric)
        residual, slope = self._correction(problem.windows)
        return np.asarray(blocks["motion"]) - residual, np.asarray(jac["motion"]) - slope

    def _correction(self, w: Windows) -> tuple[Residuals, Slopes]:
        """Return the part of residuals that expected shared effects explain, and its derivative.

        The derivative is with respect to the search vector. Residuals are predicted less measured
        increments: both results are therefore subtracted from the contact law's predictions.
        """
        expected, e = self.expected_effects(w), effects(w, self.robot)
        mean = np.einsum("nma,na->nm", e, expected.mean)
        return mean, np.einsum("nma,nap->nmp", e, expected.slope)

    def tracks(self, w: Windows) -> replay.Tracks:
        """Return tracks of whole runs, from the force balance and the expected shared effects."""
        increments = np.asarray(replay.contact_increments(self.robot, lk.batch(w, self.robot)))
        mean = self._correction(w)[0].reshape(increments.shape)
        return replay.tracks_from_increments(self.robot, w, increments - mean)

    def tracks_and_slopes(self, w: Windows) -> tuple[replay.Tracks, Slopes]:
        tracks, b = self.tracks(w), lk.batch(w, self.robot)
        start, expected = tracks.predicted[:, 0], self._expected_increments(w)
        by_z = replay.end_jacobian(self.space, self.z, b, start, effects=expected)
        return tracks, np.asarray(by_z)

    def body_paths(
        self, w: Windows
    ) -> tuple[Float[np.ndarray, "segment edge 3"], Float[np.ndarray, "segment edge 2 2"]]:
        """Return predicted poses of the body in whole runs, and the scale matrices of positions.

        The scale matrices [m^2] are those of predicted less measured positions of the body at each
        edge between measured poses; the last one is that of `ends` if the marker is at the body's
        middle.
        """
        p, b = self.tracks(w).predicted, lk.batch(w, self.robot)
        body, picked = body_poses(self.robot, w.session, p), np.arange(0, p.shape[1], w.parts)
        expected = self._expected_increments(w)
        jacobian = replay.path_jacobian(self.space, self.z, b, p[:, 0], expected)
        by_z = np.asarray(jacobian)[:, picked]
        # the body turns about the marker
        lever = turned_left(body[:, picked, :2] - p[:, picked, :2])
        by_z = by_z[:, :, :2] + lever[..., None] * by_z[:, :, 2:]
        of_numbers = [self._number_covariance(w, by_z[:, k]) for k in range(len(picked))]
        shared, point = self.effect_covariance(w), body[:, picked, :2]
        cov = replay.path_covariance(self.robot, w, p, self.variance, shared, picked, point)
        return body[:, picked], cov + np.stack(of_numbers, axis=1)

    def _expected_increments(self, w: Windows) -> tuple[np.ndarray, np.ndarray]:
        """Return the increments (segment, window, 3) of expected effects, and their derivative."""
        mean, slope = self._correction(w)
        return mean.reshape(*w.dt.shape, 3), slope.reshape(*w.dt.shape, 3, -1)


def force_balance_of(
    problem: Problem, state: FitState, covariance: Square, keep: Float[np.ndarray, " segment"]
) -> ForceBalance:
    """Return the force balance that was fitted to the segments `keep`, with its shared effects."""
    z, log_v, w = np.asarray(state.z), np.asarray(state.log_variance), problem.windows
    residual, jacobian = problem.linear(z, problem.electric(z, log_v))
    motion = residual["motion"], jacobian["motion"]
    direction = TravelConditions.of(w, problem.robot).direction
    distance = travel(w, problem.robot)[0].sum(axis=1)
    counted = jnp.asarray(keep[: len(w)])
    axes = axis_effects(problem.objective, motion, counted, covariance, log_v)
    return ForceBalance(
        problem.space.tree(state.z),
        by_name(problem, log_v),
        np.asarray(covariance),
        problem.space,
        z,
        shared=_fitted_effects(problem, state, keep, residual, jacobian),
        extrapolation=extrapolation(axes, log_v, direction, distance, setups(w)),
    )


def _fitted_effects(
    problem: Problem,
    state: FitState,
    keep: Float[np.ndarray, " segment"],
    residual: Blocks,
    jacobian: Blocks,
) -> dict[str, FittedEffects]:
    """Return fitted effects of neighbouring runs, keyed by floor; `keep` marks fitted segments."""
    log_v, free = jnp.asarray(state.log_variance), problem.space.size
    weighed = problem.weighed(residual, log_v, keep, state.shared(len(problem.windows)))
    white = jnp.einsum("nij,nj->ni", weighed.whitening.root["motion"], residual["motion"])
    half = whitened(problem.objective.blocks, jacobian, log_v, jnp.asarray(keep))["motion"]
    expected = expected_posteriors(problem.objective, log_v, jnp.asarray(keep))
    std = np.exp(0.5 * np.asarray(log_v))
    out = {}
    floors, shared = problem.robot.surfaces.labels, problem.objective.shared
    for floor, of, fitted, to in zip(floors, shared, weighed.effects, expected, strict=True):
        near = of.near.shape[-1]
        count = near + of.session.shape[1]
        inverse = np.linalg.inv(np.asarray(to.factor))
        covariance = (inverse.T @ inverse).reshape(3, count, 3, count)
        slope = jax.vmap(to.coefs, in_axes=-1, out_axes=-1)(half)
        out[floor] = FittedEffects(
            speeds_and_loads=problem.speeds_and_loads[floor],
            std=std[np.asarray(of.numbers)[1]],
            coefs=np.asarray(fitted.coefs(white)).reshape(3, count)[:, :near],
            by_number=np.asarray(slope).reshape(3, count, free)[:, :near],
            covariance=covariance[:, :near, :, :near],
        )
    return out


def parameter_covariance(jac: Slopes, cov: np.ndarray) -> np.ndarray:
    """Return the covariance J C J^T of every segment's predictions due to uncertain parameters.

    `jac` is the derivative J of the predictions with respect to the parameters, and `cov` is the
    covariance C of the parameters. Columns of J that are zero in a segment are skipped there.
    """
    used = (jac != 0.0).any(axis=1)
    patterns, which = np.unique(used, axis=0, return_inverse=True)
    out = np.zeros((len(jac), jac.shape[1], jac.shape[1]))
    for k, columns in enumerate(patterns):
        mine = which.ravel() == k
        some = jac[mine][..., columns]
        out[mine] = (some @ cov[np.ix_(columns, columns)]) @ np.swapaxes(some, -1, -2)
    return out


def by_name(problem: Problem, log_v: Vector) -> dict[str, float]:
    """Return variances, keyed by the names of their noise components."""
    return dict(zip(problem.noise.names, np.exp(np.asarray(log_v)).tolist(), strict=True))
