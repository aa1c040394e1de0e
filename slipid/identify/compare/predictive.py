"""What any model of the ladder says of runs it has not seen, and how sure it may be.

Every model gets the same predictive distribution: a Student t around what it predicts, with scale

    V + E diag(v) E^T + J C J^T

V of its own camera, process and run variances, found by restricted likelihood from its own
residuals; v what runs of a session share (`slipid.identify.fit.sessions`), E what that moves; J the
slope by its own numbers and the camera's, C their covariance. All models share the fitted camera;
a rung's numbers follow it.
"""

import abc
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import jax
import numpy as np
from jaxtyping import Float
from scipy.special import gammaln

from slipid.data.windows import Windows
from slipid.identify.compare import open_loop as replay
from slipid.identify.fit import likelihood as lk
from slipid.identify.fit.noise import effects
from slipid.identify.fit.problem import Problem, State
from slipid.identify.fit.sessions import Linear, by_axis, shared
from slipid.identify.fit.variances import DEGREES, Search, Square, Vector
from slipid.model.robot import Robot
from slipid.search_space import Space

Gaps = Float[np.ndarray, "piece m"]
Slopes = Float[np.ndarray, "piece m number"]
Fitted = TypeVar("Fitted", bound="Predictive")


@dataclass(frozen=True, eq=False)
class Predictive(abc.ABC):
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
        v = by_axis(self.variance, "session", problem.windows)
        return gap, noise + np.einsum("nma,na,nla->nml", e, v, e) + around(slope, self.covariance)

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
        model = Linear(
            *linear,
            covariance=self.covariance,
            wide=wide,
            scale=np.asarray(problem.covariance("motion", self.log_variance(problem))),
            effect=effects(problem.windows, problem.robot),
            run=by_axis(self.variance, "run", problem.windows),
        )
        variance, covariance = shared(model, problem.windows, np.asarray(keep, float))
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
class Contact(Predictive):
    """The force balance where a fit has left it, at the search vector z."""

    space: Space
    z: Search

    @property
    def name(self) -> str:
        return "identified"

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
        return np.asarray(blocks["motion"]), np.asarray(jac["motion"])

    def ends(self, w: Windows) -> tuple[replay.Tracks, Float[np.ndarray, "piece 2 2"]]:
        b = lk.batch(w, self.robot)
        tracks = replay.follow(self.robot, w, np.asarray(replay.contact_increments(self.robot, b)))
        jac = np.asarray(replay.end_jacobian(self.space, self.z, b, tracks.predicted[:, 0]))
        own = np.einsum("nip,pq,njq->nij", jac, self.covariance, jac)
        return tracks, replay.end_covariance(self.robot, w, tracks, self.variance, own)


def contact_of(
    problem: Problem, state: State, covariance: Square, keep: Float[np.ndarray, " piece"]
) -> Contact:
    """The force balance at the end of a fit of the kept pieces, with what sessions share."""
    robot, variance = problem.space.tree(state.z), by_name(problem, state.log_variance)
    plain = Contact(robot, variance, np.asarray(covariance), problem.space, np.asarray(state.z))
    of_floor = problem.space.where(lambda e: e.surface is not None)
    wide = np.where(of_floor[:, None] | of_floor, 0.0, plain.covariance)
    wide[of_floor, of_floor] = problem.space.prior_std[of_floor] ** 2
    return plain.with_sessions(problem, plain.linear(problem), wide, keep)


def around(jac: Slopes, cov: np.ndarray) -> np.ndarray:
    """J C J^T of every piece, without the columns that are zero for it."""
    used = (jac != 0.0).any(axis=1)
    patterns, which = np.unique(used, axis=0, return_inverse=True)
    out = np.zeros((len(jac), jac.shape[1], jac.shape[1]))
    for k, columns in enumerate(patterns):
        mine = which.ravel() == k
        some = jac[mine][..., columns]
        out[mine] = (some @ cov[np.ix_(columns, columns)]) @ np.swapaxes(some, -1, -2)
    return out


def by_name(problem: Problem, log_v: Vector) -> dict[str, float]:
    """Variances by the names of their components."""
    return dict(zip(problem.noise.names, np.exp(np.asarray(log_v)).tolist(), strict=True))
