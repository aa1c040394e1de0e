"""What any model of the ladder says of runs it has not seen, and how sure it may be.

Every model gets the same predictive distribution: a Student t around what it predicts, with scale

    V + E diag(v) E^T + J C J^T

V of its own camera, process and run variances, found by restricted likelihood from its own
residuals; v what runs of a session share (`slipid.identify.fit.sessions`), E what that moves; J the
slope by its own numbers and the camera's, C their covariance. All models share the fitted camera;
a rung's numbers follow it.
"""

import abc
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.data.windows import Windows
from slipid.identify.compare import open_loop as replay
from slipid.identify.compare.slip_models import Rung
from slipid.identify.fit import likelihood as lk
from slipid.identify.fit.noise import effects
from slipid.identify.fit.problem import DEGREES, Problem, State
from slipid.identify.fit.sessions import Linear, by_axis, shared
from slipid.identify.fit.variances import Vector, scored_given
from slipid.model.robot import Robot
from slipid.search_space import Space

Gaps = Float[np.ndarray, "piece m"]
Slopes = Float[np.ndarray, "piece m number"]
MOST_TURNS, SCORING, SETTLED = 15, 4, 0.02
"""Turns of a rung's covariance and so many steps of its log variances, and what counts as rest."""
VAGUE = 1e-2
"""Precision of a rung's number before any data: of slips below one, a std of 10 says nothing."""
STEP = 1e-4
"""Of the difference quotients by a rung's numbers."""


@dataclass(frozen=True, eq=False)
class Predictive(abc.ABC):
    """A fitted model with noise of its own.

    Attributes:
        robot: whose camera sees what the model predicts.
        log_variance: of every noise component of the problem.
        variance: the same by name, not as logarithms, and what sessions share.
        covariance: of the model's numbers and the camera's.
    """

    robot: Robot
    log_variance: Float[np.ndarray, " variance"]
    variance: dict[str, float]
    covariance: Float[np.ndarray, "number number"]

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Of the model."""

    @property
    @abc.abstractmethod
    def numbers(self) -> dict[str, int]:
        """How many were fitted: of every floor, and `shared` by all, the camera's not counted."""

    @abc.abstractmethod
    def linear(self, problem: Problem) -> tuple[Gaps, Slopes]:
        """Predicted less measured increments of every piece, and their slope."""

    @abc.abstractmethod
    def ends(self, w: Windows) -> tuple[replay.Tracks, Float[np.ndarray, "piece 2 2"]]:
        """Tracks of whole runs, and the covariance of their ends, scale matrix of a Student t."""

    def scale(self, problem: Problem) -> tuple[Gaps, Float[np.ndarray, "piece m m"]]:
        """Gaps of every piece, and the scale matrix of their distribution."""
        gap, slope = self.linear(problem)
        noise = np.asarray(problem.covariance("motion", jnp.asarray(self.log_variance)))
        e = effects(problem.windows, problem.robot)
        v = by_axis(self.variance, "session", problem.windows)
        return gap, noise + np.einsum("nma,na,nla->nml", e, v, e) + _around(slope, self.covariance)

    def log_density(self, problem: Problem) -> Float[np.ndarray, " piece"]:
        """Log density of every piece's logged poses but the first, in logged units."""
        return log_student(*self.scale(problem)) + np.asarray(
            _camera_log_jacobian(self.robot, problem.batch.pose)
        )


def log_student(
    gap: Gaps, scale: Float[np.ndarray, "piece m m"] | Float[np.ndarray, "m m"]
) -> Float[np.ndarray, " piece"]:
    """Log density of a multivariate Student t around zero with `DEGREES` degrees of freedom.

    Source: Kotz and Nadarajah 2004, Multivariate t Distributions, eq. 1.1.
    """
    from scipy.special import gammaln

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
    """The force balance where a fit has left it.

    Attributes:
        problem: that was fitted.
        z: search vector.
    """

    problem: Problem
    z: Float[np.ndarray, " free"]

    @property
    def name(self) -> str:
        return "identified"

    @property
    def numbers(self) -> dict[str, int]:
        out = dict.fromkeys([*self.robot.surfaces.labels, "shared"], 0)
        for e in self.problem.space.free:
            if not e.declaration.electric and e.part != "camera":
                out[e.surface or "shared"] += e.coordinates
        return out

    @cached_property
    def camera(self) -> np.ndarray:
        """Coordinates of the search vector that belong to the camera."""
        return np.flatnonzero(self.problem.space.where(lambda e: e.part == "camera"))

    def linear(self, problem: Problem) -> tuple[Gaps, Slopes]:
        blocks, jac = problem.linear(jnp.asarray(self.z), problem.volt(self.log_variance))
        return np.asarray(blocks["motion"]), np.asarray(jac["motion"])

    def ends(self, w: Windows) -> tuple[replay.Tracks, Float[np.ndarray, "piece 2 2"]]:
        step = replay.contact_increments(self.robot, lk.batch(w, self.robot))
        tracks = replay.follow(self.robot, w, np.asarray(step))
        space = self.problem.space
        own = replay.parameter_covariance(space, self.z, self.covariance, w, tracks)
        return tracks, replay.end_covariance(self.robot, w, tracks, self.variance, own)


@dataclass(frozen=True, eq=False)
class Noisy(Predictive):
    """A rung with noise of its own; its numbers come first, then the camera's.

    Attributes:
        rung: fitted.
        contact: whose camera it shares.
    """

    rung: Rung
    contact: Contact

    @property
    def name(self) -> str:
        return self.rung.name

    @property
    def numbers(self) -> dict[str, int]:
        sizes = dict.fromkeys(self.robot.surfaces.labels, 0)
        for key, value in self.rung.state.items():
            sizes[next(f for f in sizes if key == f or key.startswith(f"{f}@"))] += value.size
        return sizes | {"shared": 0}

    def linear(self, problem: Problem) -> tuple[Gaps, Slopes]:
        return _linear(self.rung, self.contact, problem)

    def ends(self, w: Windows) -> tuple[replay.Tracks, Float[np.ndarray, "piece 2 2"]]:
        robot, contact = self.robot, self.contact

        def end(rung: Rung) -> np.ndarray:
            return replay.follow(robot, w, rung.increments(w, robot)).predicted[:, -1, :2]

        tracks = replay.follow(robot, w, self.rung.increments(w, robot))
        camera = replay.twist_end_jacobian(
            contact.problem.space,
            jnp.asarray(contact.z),
            jnp.asarray(self.rung.twist(w, robot)),
            lk.batch(w, robot),
            jnp.asarray(tracks.predicted[:, 0]),
        )
        jac = np.concatenate(
            [slopes(self.rung, w, end), np.asarray(camera)[..., contact.camera]], axis=-1
        )
        own = _around(jac, self.covariance)
        return tracks, replay.end_covariance(robot, w, tracks, self.variance, own)


Fitted = TypeVar("Fitted", bound=Predictive)


def contact_of(
    problem: Problem,
    state: State,
    covariance: Float[np.ndarray, "free free"],
    keep: Float[np.ndarray, " piece"] | None = None,
) -> Contact:
    """The force balance at the end of a fit.

    Args:
        keep: of the pieces that were fitted; None leaves out what sessions share.
    """
    plain = Contact(
        robot=problem.space.tree(jnp.asarray(state.z)),
        log_variance=np.asarray(state.log_variance),
        variance=_by_name(problem, state.log_variance),
        covariance=np.asarray(covariance),
        problem=problem,
        z=np.asarray(state.z),
    )
    if keep is None:
        return plain
    of_floor = problem.space.where(lambda e: e.surface is not None)
    wide = np.where(of_floor[:, None] | of_floor, 0.0, plain.covariance)
    wide[of_floor, of_floor] = problem.space.prior_std[of_floor] ** 2
    return _with_sessions(plain, problem, wide, keep)


def with_noise(rung: Rung, contact: Contact, keep: Float[np.ndarray, " piece"]) -> Noisy:
    """A rung fitted to the kept pieces of a problem, and its noise found from what it leaves there.

    Variances by Fisher scoring of the restricted likelihood, as for the force balance; the degrees
    of freedom of the rung's own numbers are taken off.
    """
    problem, robot = contact.problem, contact.robot
    lag = float(robot.camera.lag)
    seen = problem.windows.at_lag(lag).pieces(np.flatnonzero(keep > 0))
    rung = rung.fit(seen, robot)
    before = _before(rung, seen, robot)
    gap, slope = _linear(rung, contact, problem)
    common = contact.covariance[np.ix_(contact.camera, contact.camera)]
    log_v, count = jnp.asarray(contact.log_variance), jnp.asarray(keep, float)
    for _ in range(MOST_TURNS):
        last = log_v
        scale = np.asarray(problem.covariance("motion", log_v))
        covariance = _numbers(before, common, scale, slope, keep)
        spread = jnp.asarray(_around(slope, covariance))
        blocks = {"motion": jnp.asarray(gap)}, {"motion": spread}
        for _ in range(SCORING):
            log_v = scored_given(problem.target, *blocks, log_v, count, {})
        if float(jnp.abs(log_v - last).max()) < SETTLED:
            break
    plain = Noisy(
        robot=robot,
        log_variance=np.asarray(log_v),
        variance=_by_name(problem, log_v),
        covariance=covariance,
        rung=rung,
        contact=contact,
    )
    own = len(before)
    wide = np.zeros_like(covariance)
    wide[:own, :own], wide[own:, own:] = np.linalg.inv(before), common
    return _with_sessions(plain, problem, wide, keep)


def _with_sessions(plain: Fitted, problem: Problem, wide: np.ndarray, keep: np.ndarray) -> Fitted:
    """The model with what runs of a session share in its variances and in its covariance."""
    gap, slope = plain.linear(problem)
    model = Linear(
        gap=gap,
        slope=slope,
        covariance=plain.covariance,
        wide=wide,
        scale=np.asarray(problem.covariance("motion", jnp.asarray(plain.log_variance))),
        effect=effects(problem.windows, problem.robot),
        run=by_axis(plain.variance, "run", problem.windows),
    )
    variance, covariance = shared(model, problem.windows, np.asarray(keep, float))
    return replace(plain, variance=plain.variance | variance, covariance=covariance)


def _before(rung: Rung, w: Windows, robot: Robot) -> np.ndarray:
    """Precision of a rung's numbers without the data."""
    held, at = rung.stiffness(w, robot), _places(rung)
    out = VAGUE * np.eye(sum(v.size for v in rung.state.values()))
    for key, precision in held.items():
        out[at[key], at[key]] += precision
    return out


def _numbers(
    before: np.ndarray,
    common: np.ndarray,
    scale: np.ndarray,
    slope: Slopes,
    keep: np.ndarray,
) -> np.ndarray:
    """Covariance of a rung's numbers and the camera's; the former follow the latter."""
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


def _linear(rung: Rung, contact: Contact, problem: Problem) -> tuple[Gaps, Slopes]:
    """Gaps of all pieces of a problem, and their slope by the rung's numbers and the camera's."""
    robot, b, z = contact.robot, problem.batch, jnp.asarray(contact.z)
    w = problem.windows.at_lag(float(robot.camera.lag))

    def gap(some: Rung) -> np.ndarray:
        return np.asarray(_gap(problem.space, z, jnp.asarray(some.twist(w, robot)), b))

    camera = _gap_jacobian(problem.space, z, jnp.asarray(rung.twist(w, robot)), b)
    by_camera = np.asarray(camera)[..., contact.camera]
    return gap(rung), np.concatenate([slopes(rung, w, gap), by_camera], axis=-1)


@eqx.filter_jit
def _gap(space: Space, z: Array, twist: Array, b: lk.Batch) -> Array:
    robot = space.tree(z)
    gap = lk.seen(robot, twist, b.dt, b.session) - lk.measured(robot, b.pose)
    return gap.reshape(gap.shape[0], -1)


@eqx.filter_jit
def _gap_jacobian(space: Space, z: Array, twist: Array, b: lk.Batch) -> Array:
    return jax.jacfwd(lambda x: _gap(space, x, twist, b))(z)


def slopes(rung: Rung, w: Windows, of: Callable[[Rung], np.ndarray]) -> np.ndarray:
    """Slope of a function of a rung by its numbers, key after key (piece, ..., number).

    Keys share no piece, so one number of each is moved at once.
    """
    at = _places(rung)
    now = of(rung)
    out = np.zeros((*now.shape, sum(v.size for v in rung.state.values())))
    keys = np.array([rung.series(s, load) for s, load in zip(w.surface, w.load, strict=True)])
    for k in range(max((v.size for v in rung.state.values()), default=0)):
        quotient = (of(_moved(rung, k, STEP)) - now) / STEP
        for key, place in at.items():
            if place.start + k < place.stop:
                out[keys == key, ..., place.start + k] = quotient[keys == key]
    return out


def _moved(rung: Rung, k: int, by: float) -> Rung:
    """The rung with the k-th number of every key moved."""
    state = {}
    for key, value in rung.state.items():
        flat = np.array(value, float).ravel()
        flat[k : k + 1] += by
        state[key] = flat.reshape(value.shape)
    return rung.with_state(state)


def _places(rung: Rung) -> dict[str, slice]:
    """Where the numbers of each key lie in the vector of all."""
    ends = np.cumsum([0, *(v.size for v in rung.state.values())])
    return {key: slice(int(ends[i]), int(ends[i + 1])) for i, key in enumerate(rung.state)}


def _around(jac: Slopes, cov: np.ndarray) -> np.ndarray:
    """J C J^T of every piece, without the columns that are zero for it."""
    used = (jac != 0.0).any(axis=1)
    patterns, which = np.unique(used, axis=0, return_inverse=True)
    out = np.zeros((len(jac), jac.shape[1], jac.shape[1]))
    for k, columns in enumerate(patterns):
        mine = which.ravel() == k
        some = jac[mine][..., columns]
        out[mine] = (some @ cov[np.ix_(columns, columns)]) @ np.swapaxes(some, -1, -2)
    return out


def _by_name(problem: Problem, log_v: Vector) -> dict[str, float]:
    return dict(zip(problem.noise.names, np.exp(np.asarray(log_v)).tolist(), strict=True))
