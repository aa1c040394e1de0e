"""What any slip model predicts of runs it has not seen, and how sure it may be.

Every model gets a predictive distribution of the same form: a Student t around what it predicts,
with scale

    V + E diag(v) E^T + J C J^T

V of its own camera, process and run variances, found by restricted likelihood from its own
residuals; v what runs share, E what that moves; J the slope by its own numbers and the camera's, C
their covariance. Simpler models have v of sessions (`slipid.fit.session_effects`); the force
balance has what its fit found of sessions and neighbours (`slipid.fit.shared_effects`), and v
grows where leaving out sectors asks for it. All models share the fitted camera;
the numbers of a simpler model follow it.
"""

import abc
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.special import gammaln

from slipid.data.windows import Windows
from slipid.fit import likelihood as lk
from slipid.fit.hierarchy import TravelDirections, extrapolation
from slipid.fit.noise import SHARED, effects, travel
from slipid.fit.problem import FitState, Problem
from slipid.fit.session_effects import LinearModel, by_axis, with_session_effects
from slipid.fit.shared_effects import (
    AXES,
    EffectForecast,
    EffectTable,
    TravelConditions,
    forecast_effects,
)
from slipid.fit.variances import DEGREES, Search, Square, Vector, expected_posteriors, whitened
from slipid.model.robot import Robot
from slipid.predict import open_loop as replay
from slipid.search_space import Space

Gaps = Float[np.ndarray, "piece m"]
Slopes = Float[np.ndarray, "piece m number"]
Fitted = TypeVar("Fitted", bound="PredictiveModel")


@dataclass(frozen=True, eq=False)
class PredictiveModel(abc.ABC):
    """A fitted model with noise of its own, seen by the camera of its robot.

    Variances are of every noise component by name, and of what sessions share, where they do. The
    covariance is of the model's numbers and the camera's.
    """

    robot: Robot
    variance: Mapping[str, float]
    covariance: Float[np.ndarray, "number number"]

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Of the model."""

    @property
    @abc.abstractmethod
    def numbers(self) -> dict[str, int]:
        """How many were fitted: of every floor, and `shared` by all, the camera's not counted."""

    def log_variance(self, problem: Problem) -> Float[np.ndarray, " variance"]:
        """Of every noise component of a problem."""
        return np.log([self.variance[name] for name in problem.noise.names])

    @abc.abstractmethod
    def linear(self, problem: Problem) -> tuple[Gaps, Slopes]:
        """Predicted less measured increments of every piece, and their slope."""

    @abc.abstractmethod
    def ends(self, w: Windows) -> tuple[replay.Tracks, Float[np.ndarray, "piece 2 2"]]:
        """Tracks of whole runs, and the covariance of their ends, scale matrix of a Student t."""

    def scale(self, problem: Problem) -> tuple[Gaps, Float[np.ndarray, "piece m m"]]:
        """Gaps of every piece, and the scale matrix of their distribution."""
        gap, slope = self.linear(problem)
        noise = np.asarray(problem.covariance("motion", self.log_variance(problem)))
        e = effects(problem.windows, problem.robot)
        v = self.effect_covariance(problem.windows)
        numbers = self.growth(problem.windows)[:, None, None] * parameter_covariance(
            slope, self.covariance
        )
        return gap, noise + np.einsum("nma,nab,nlb->nml", e, v, e) + numbers

    def growth(self, w: Windows) -> Float[np.ndarray, " piece"]:
        """Factor of the variances of numbers and shared effects, of runs it has not seen."""
        return np.ones(len(w))

    def effect_covariance(self, w: Windows) -> Float[np.ndarray, "piece 3 3"]:
        """Of what a run shares with others, in a session that was not seen."""
        return by_axis(self.variance, "session", w)[:, :, None] * np.eye(len(AXES))

    def log_density(self, problem: Problem) -> Float[np.ndarray, " piece"]:
        """Log density of every piece's logged poses but the first, in logged units."""
        return log_student(*self.scale(problem)) + np.asarray(
            _camera_log_jacobian(self.robot, problem.batch.pose)
        )

    def with_sessions(
        self: Fitted,
        problem: Problem,
        linear: tuple[Gaps, Slopes],
        wide: np.ndarray,
        keep: np.ndarray,
    ) -> Fitted:
        """The model with what runs of a session share in its variances and in its covariance."""
        model = LinearModel(
            *linear,
            covariance=self.covariance,
            wide=wide,
            scale=np.asarray(problem.covariance("motion", self.log_variance(problem))),
            effect=effects(problem.windows, problem.robot),
            run=by_axis(self.variance, "run", problem.windows),
        )
        variance, covariance = with_session_effects(model, problem.windows, np.asarray(keep, float))
        return replace(self, variance={**self.variance, **variance}, covariance=covariance)


def log_student(
    gap: Gaps, scale: Float[np.ndarray, "piece m m"] | Float[np.ndarray, "m m"]
) -> Float[np.ndarray, " piece"]:
    """Log density of a multivariate Student t around zero with `DEGREES` degrees of freedom.

    Source: Kotz and Nadarajah 2004, Multivariate t Distributions, eq. 1.1.
    """
    m = gap.shape[-1]
    root = np.linalg.cholesky(scale)
    white = np.linalg.solve(root, gap[..., None])[..., 0]
    log_det = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(-1)
    norm = gammaln((DEGREES + m) / 2) - gammaln(DEGREES / 2) - 0.5 * m * np.log(DEGREES * np.pi)
    tail = 0.5 * (DEGREES + m) * np.log1p((white**2).sum(-1) / DEGREES)
    return np.asarray(norm - log_det - tail)


_camera_log_jacobian = jax.jit(lk.camera_log_jacobian)


@dataclass(frozen=True, eq=False)
class ForceBalance(PredictiveModel):
    """The force balance where a fit has left it, at the search vector z.

    Variances of numbers and of shared effects are too small for runs it has not seen, by the factor
    `extrapolation` of their floor and load.
    """

    space: Space
    z: Search
    shared: Mapping[str, EffectTable]
    extrapolation: Mapping[str, float]

    @property
    def name(self) -> str:
        return "identified"

    @property
    def forecast(self) -> dict[str, float]:
        """Variances of runs it has not seen, with the load of each floor that is the least sure."""
        out = dict(self.variance)
        for name in out:
            kind, _, rest = name.partition(".")
            if kind in SHARED:
                floor = f"{rest.rpartition('.')[0]}@"
                grown = [x for k, x in self.extrapolation.items() if k.startswith(floor)]
                out[name] *= max(grown, default=1.0)
        return out

    def expected_effects(self, w: Windows) -> EffectForecast:
        """What neighbours among the fitted runs tell of runs."""
        return forecast_effects(self.shared, w, self.robot, self.space.size)

    def effect_covariance(self, w: Windows) -> Float[np.ndarray, "piece 3 3"]:
        shared = super().effect_covariance(w) + self.expected_effects(w).covariance
        return self.growth(w)[:, None, None] * shared

    def growth(self, w: Windows) -> Float[np.ndarray, " piece"]:
        return np.array([self.extrapolation.get(name, 1.0) for name in setups(w)])

    @property
    def numbers(self) -> dict[str, int]:
        out = dict.fromkeys([*self.robot.surfaces.labels, "shared"], 0)
        for e in self.space.free:
            if not e.declaration.electric and e.part != "camera":
                out[e.surface or "shared"] += e.coordinates
        return out

    @cached_property
    def camera(self) -> np.ndarray:
        """Coordinates of the search vector that belong to the camera."""
        return np.flatnonzero(self.space.where(lambda e: e.part == "camera"))

    def linear(self, problem: Problem) -> tuple[Gaps, Slopes]:
        electric = problem.electric(self.z, self.log_variance(problem))
        blocks, jac = problem.linear(self.z, electric)
        told, e = self.expected_effects(problem.windows), effects(problem.windows, problem.robot)
        gap = np.asarray(blocks["motion"]) - np.einsum("nma,na->nm", e, told.mean)
        slope = np.asarray(jac["motion"]) - np.einsum("nma,nap->nmp", e, told.slope)
        return gap, slope

    def tracks(self, w: Windows) -> replay.Tracks:
        """Of whole runs, as the force balance and what neighbours tell have them."""
        return self._tracks(w, self._moved(w, self.expected_effects(w)))

    def _moved(self, w: Windows, told: EffectForecast) -> Float[np.ndarray, "piece window 3"]:
        """By what neighbours tell that the force balance moves too far."""
        moved = np.einsum("nma,na->nm", effects(w, self.robot), told.mean)
        return moved.reshape(*w.dt.shape, 3)

    def _tracks(self, w: Windows, moved: Float[np.ndarray, "piece window 3"]) -> replay.Tracks:
        b = lk.batch(w, self.robot)
        increments = np.asarray(replay.contact_increments(self.robot, b)) - moved
        return replay.tracks_from_increments(self.robot, w, increments)

    def ends(self, w: Windows) -> tuple[replay.Tracks, Float[np.ndarray, "piece 2 2"]]:
        b, told, e = lk.batch(w, self.robot), self.expected_effects(w), effects(w, self.robot)
        moved = self._moved(w, told)
        tracks = self._tracks(w, moved)
        by_number = np.einsum("nma,nap->nmp", e, told.slope).reshape(*moved.shape, -1)
        more = replay.IncrementCorrection(jnp.asarray(moved), jnp.asarray(by_number))
        start = tracks.predicted[:, 0]
        jac = np.asarray(replay.end_jacobian(self.space, self.z, b, start, corrected=more))
        own = np.einsum("nip,pq,njq->nij", jac, self.covariance, jac)
        own *= self.growth(w)[:, None, None]
        effect = self.effect_covariance(w)
        return tracks, replay.end_covariance(self.robot, w, tracks, self.variance, effect, own)


def force_balance_of(
    problem: Problem, state: FitState, covariance: Square, keep: Float[np.ndarray, " piece"]
) -> ForceBalance:
    """The force balance at the end of a fit of the kept pieces, with what sessions share."""
    robot, variance = problem.space.tree(state.z), by_name(problem, state.log_variance)
    z, log_v = np.asarray(state.z), np.asarray(state.log_variance)
    blocks, jacobian = problem.linear(z, problem.electric(z, log_v))
    motion = blocks["motion"], jacobian["motion"]
    w = problem.windows
    direction = TravelConditions.of(w, problem.robot).direction
    courses = TravelDirections(direction, travel(w, problem.robot)[0].sum(axis=1), setups(w))
    grown = extrapolation(problem.objective, motion, keep[: len(w)], covariance, log_v, courses)
    return ForceBalance(
        robot,
        variance,
        np.asarray(covariance),
        problem.space,
        z,
        shared=effect_tables(problem, state, keep),
        extrapolation=grown,
    )


def effect_tables(
    problem: Problem, state: FitState, keep: Float[np.ndarray, " piece"]
) -> dict[str, EffectTable]:
    """What neighbouring runs on every floor share, by a fit of the kept pieces."""
    log_v, free = jnp.asarray(state.log_variance), problem.space.size
    residual, jacobian = problem.linear(state.z, problem.electric(state.z, log_v))
    seen = problem.weighed(residual, log_v, keep, state.shared(len(problem.windows)))
    white = jnp.einsum("nij,nj->ni", seen.whitening.root["motion"], residual["motion"])
    half = whitened(problem.objective.blocks, jacobian, log_v, jnp.asarray(keep))["motion"]
    expected = expected_posteriors(problem.objective, log_v, jnp.asarray(keep))
    std = np.exp(0.5 * np.asarray(log_v))
    out = {}
    for floor, of, tie, to in zip(
        problem.robot.surfaces.labels, problem.objective.shared, seen.effects, expected, strict=True
    ):
        near = of.near.shape[-1]
        count = near + of.session.shape[1]
        inverse = np.linalg.inv(np.asarray(to.factor))
        covariance = (inverse.T @ inverse).reshape(3, count, 3, count)
        slope = jax.vmap(to.coefs, in_axes=-1, out_axes=-1)(half)
        out[floor] = EffectTable(
            speeds_and_loads=problem.speeds_and_loads[floor],
            std=std[np.asarray(of.numbers)[1]],
            coefs=np.asarray(tie.coefs(white)).reshape(3, count)[:, :near],
            by_number=np.asarray(slope).reshape(3, count, free)[:, :near],
            covariance=covariance[:, :near, :, :near],
        )
    return out


def parameter_covariance(jac: Slopes, cov: np.ndarray) -> np.ndarray:
    """J C J^T of every piece, without the columns that are zero for it."""
    used = (jac != 0.0).any(axis=1)
    patterns, which = np.unique(used, axis=0, return_inverse=True)
    out = np.zeros((len(jac), jac.shape[1], jac.shape[1]))
    for k, columns in enumerate(patterns):
        mine = which.ravel() == k
        some = jac[mine][..., columns]
        out[mine] = (some @ cov[np.ix_(columns, columns)]) @ np.swapaxes(some, -1, -2)
    return out


def setups(w: Windows) -> list[str]:
    """Floor and load of every piece, `floor@load`."""
    return [f"{floor}@{load}" for floor, load in zip(w.surface, w.load, strict=True)]


def by_name(problem: Problem, log_v: Vector) -> dict[str, float]:
    """Variances by the names of their components."""
    return dict(zip(problem.noise.names, np.exp(np.asarray(log_v)).tolist(), strict=True))
