"""What any model of the ladder says of runs it has not seen, and how sure it may be.

Every model gets the same predictive distribution: a Student t around what it predicts, with scale

    V + J C J^T + A S A^T,    A = G - J C sum_n J_n^T V_n^-1 G_n

V of its own camera, process and run variances, found by restricted likelihood from its own
residuals; J the slope by its own numbers and C their covariance; G the slope by the camera that all
models share, S the camera's covariance, and A the slope by the camera once the model's numbers have
followed it. The force balance has its camera in J and C.
"""

import abc
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.data.dataset import Windows
from slipid.identify import likelihood as lk
from slipid.identify import replay
from slipid.identify.ladder import Rung
from slipid.identify.problem import DEGREES, Problem, State
from slipid.model.robot import Robot

Gaps = Float[np.ndarray, "piece m"]
Covariances = Float[np.ndarray, "piece m m"]
MOST_SCORING, SETTLED = 40, 0.01
"""Steps of a rung's log variances, and the largest that counts as rest."""
VAGUE = 1e-2
"""Precision of a rung's number before any data: of slips below one, a std of 10 says nothing."""
STEP = 1e-4
"""Of the difference quotients by a rung's numbers."""


class Predictive(abc.ABC):
    """A fitted model with noise of its own.

    Attributes:
        name: of the model.
        robot: whose camera sees what the model predicts.
        log_variance: of every noise component of the problem.
        variance: the same by name, not as logarithms.
    """

    name: str
    robot: Robot
    log_variance: Float[np.ndarray, " variance"]
    variance: dict[str, float]

    @property
    @abc.abstractmethod
    def numbers(self) -> dict[str, int]:
        """How many were fitted: of every floor, and `shared` by all, the camera's not counted."""

    @abc.abstractmethod
    def gaps(self, problem: Problem) -> tuple[Gaps, Covariances]:
        """Predicted less measured increments of every piece, and their covariance from what was
        fitted."""

    @abc.abstractmethod
    def ends(self, w: Windows) -> tuple[replay.Tracks, Float[np.ndarray, "piece 2 2"]]:
        """Tracks of whole runs, and the covariance of their ends, scale matrix of a Student t."""

    def log_density(self, problem: Problem) -> Float[np.ndarray, " piece"]:
        """Log density of every piece's logged poses but the first, in logged units."""
        gap, spread = self.gaps(problem)
        scale = np.asarray(problem.covariance("motion", jnp.asarray(self.log_variance))) + spread
        camera = jax.jit(lk.camera_log_jacobian)(self.robot, problem.batch.pose)
        return log_student(gap, scale) + np.asarray(camera)


def log_student(gap: Gaps, scale: Covariances) -> Float[np.ndarray, " piece"]:
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


@dataclass(frozen=True, eq=False)
class Contact(Predictive):
    """The force balance where a fit has left it.

    Attributes:
        problem: that was fitted.
        z, covariance: search vector, and its covariance.
    """

    robot: Robot
    problem: Problem
    z: Float[np.ndarray, " free"]
    covariance: Float[np.ndarray, "free free"]
    log_variance: Float[np.ndarray, " variance"]
    variance: dict[str, float]
    name: str = "identified"

    @property
    def numbers(self) -> dict[str, int]:
        names, electric = self.problem.space.names, self.problem.electric
        own = [n for n, e in zip(names, electric, strict=True) if not e and "camera." not in n]
        starts = {floor: f"surface.{floor}." for floor in self.robot.surfaces.labels}
        out = {floor: sum(n.startswith(start) for n in own) for floor, start in starts.items()}
        return out | {"shared": sum(not n.startswith("surface.") for n in own)}

    def gaps(self, problem: Problem) -> tuple[Gaps, Covariances]:
        volt = problem.volt(self.log_variance)
        blocks, jacobian = problem.linear(jnp.asarray(self.z), volt)
        jac = np.asarray(jacobian["motion"])
        return np.asarray(blocks["motion"]), _quadratic(jac, self.covariance)

    def ends(self, w: Windows) -> tuple[replay.Tracks, Float[np.ndarray, "piece 2 2"]]:
        step = replay.contact_increments(self.robot, lk.batch(w, self.robot))
        tracks = replay.follow(self.robot, w, np.asarray(step))
        space = self.problem.space
        own = replay.parameter_covariance(space, self.z, self.covariance, w, tracks)
        return tracks, replay.end_covariance(self.robot, w, tracks, self.variance, own)


@dataclass(frozen=True, eq=False)
class Noisy(Predictive):
    """A rung with noise of its own and the camera of the force balance.

    Attributes:
        rung: fitted.
        contact: whose camera it shares.
        own: covariance of the rung's numbers of each key of its state (number, number).
        follows: how they move with the camera's (number, coordinate).
    """

    robot: Robot
    rung: Rung
    contact: Contact
    log_variance: Float[np.ndarray, " variance"]
    variance: dict[str, float]
    own: dict[str, np.ndarray]
    follows: dict[str, np.ndarray]

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.rung.name

    @property
    def numbers(self) -> dict[str, int]:
        sizes = {floor: 0 for floor in self.robot.surfaces.labels}
        for key, value in self.rung.state.items():
            sizes[next(f for f in sizes if key == f or key.startswith(f"{f}@"))] += value.size
        return sizes | {"shared": 0}

    def gaps(self, problem: Problem) -> tuple[Gaps, Covariances]:
        gap, slope, camera = _linear(self.rung, self.contact, problem)
        keys = _keys(self.rung, problem.windows)
        return gap, self._spread(keys, slope, camera)

    def ends(self, w: Windows) -> tuple[replay.Tracks, Float[np.ndarray, "piece 2 2"]]:
        robot, contact = self.robot, self.contact

        def end(rung: Rung) -> np.ndarray:
            step = rung.increments(w, robot)
            return replay.follow(robot, w, step).predicted[:, -1, :2]

        twist = self.rung.twist(w, robot)
        tracks = replay.follow(robot, w, self.rung.increments(w, robot))
        camera = replay.twist_end_jacobian(
            contact.problem.space,
            jnp.asarray(contact.z),
            jnp.asarray(twist),
            lk.batch(w, robot),
            jnp.asarray(tracks.predicted[:, 0]),
        )
        at = _camera(contact)
        own = self._spread(_keys(self.rung, w), slopes(self.rung, end), np.asarray(camera)[..., at])
        return tracks, replay.end_covariance(robot, w, tracks, self.variance, own)

    def _spread(self, keys: list[str], slope: np.ndarray, camera: np.ndarray) -> np.ndarray:
        at = _camera(self.contact)
        common = self.contact.covariance[np.ix_(at, at)]
        return spread_of(keys, slope, camera, common, self.own, self.follows)


def contact_of(problem: Problem, state: State, covariance: np.ndarray) -> Contact:
    """The force balance at the end of a fit."""
    return Contact(
        robot=problem.space.tree(jnp.asarray(state.z)),
        problem=problem,
        z=np.asarray(state.z),
        covariance=np.asarray(covariance),
        log_variance=np.asarray(state.log_variance),
        variance=_by_name(problem, state.log_variance),
    )


def with_noise(rung: Rung, contact: Contact, keep: Float[np.ndarray, " piece"]) -> Noisy:
    """A rung fitted to the kept pieces of a problem, and its noise found from what it leaves there.

    Variances by Fisher scoring of the restricted likelihood, as for the force balance; the degrees
    of freedom of the rung's own numbers are taken off.
    """
    problem, robot = contact.problem, contact.robot
    seen = problem.windows.at_lag(float(robot.camera.lag)).pieces(np.flatnonzero(keep > 0))
    rung = rung.fit(seen, robot)
    held = rung.stiffness(seen, robot)
    gap, slope, camera = _linear(rung, contact, problem)
    keys = _keys(rung, problem.windows)
    at = _camera(contact)
    common = contact.covariance[np.ix_(at, at)]
    typical = jnp.asarray(2 * np.log(problem.noise.typical))
    log_v, count = jnp.asarray(contact.log_variance), jnp.asarray(keep, float)
    for _ in range(MOST_SCORING):
        before = log_v
        scale = np.asarray(problem.covariance("motion", log_v))
        own, follows = _numbers(rung, keys, scale, slope, camera, keep, held)
        spread = spread_of(keys, slope, camera, common, own, follows)
        blocks = {"motion": jnp.asarray(gap)}, {"motion": jnp.asarray(spread)}
        log_v = problem.scored_given(*blocks, log_v, count, typical)
        if float(jnp.abs(log_v - before).max()) < SETTLED:
            break
    return Noisy(
        robot=robot,
        rung=rung,
        contact=contact,
        log_variance=np.asarray(log_v),
        variance=_by_name(problem, log_v),
        own=own,
        follows=follows,
    )


def slopes(rung: Rung, of: Any) -> np.ndarray:
    """Slope of a function of a rung by the numbers of each piece's own key (piece, ..., number).

    Keys share no number, so all are moved at once.
    """
    width = max((v.size for v in rung.state.values()), default=0)

    def moved(k: int, by: float) -> Rung:
        state = {}
        for key, value in rung.state.items():
            flat = np.array(value, float).ravel()
            flat[k : k + 1] += by
            state[key] = flat.reshape(value.shape)
        return replace(rung, state=state)  # type: ignore[type-var]

    if not width:
        return np.zeros((*of(rung).shape, 0))
    quotients = [(of(moved(k, STEP)) - of(moved(k, -STEP))) / (2 * STEP) for k in range(width)]
    return np.stack(quotients, axis=-1)


def spread_of(
    keys: list[str],
    slope: Float[np.ndarray, "piece m number"],
    camera: Float[np.ndarray, "piece m coordinate"],
    common: Float[np.ndarray, "coordinate coordinate"],
    own: dict[str, np.ndarray],
    follows: dict[str, np.ndarray],
) -> Covariances:
    """J C J^T + A S A^T of every piece."""
    out = np.zeros((len(slope), slope.shape[1], slope.shape[1]))
    for key in dict.fromkeys(keys):
        mine = np.array([k == key for k in keys])
        jac = slope[mine][..., : len(own[key])]
        both = camera[mine] + jac @ follows[key]
        out[mine] = _quadratic(jac, own[key]) + _quadratic(both, common)
    return out


def _numbers(
    rung: Rung,
    keys: list[str],
    scale: Covariances,
    slope: np.ndarray,
    camera: np.ndarray,
    keep: np.ndarray,
    held: dict[str, np.ndarray],
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Covariance of a rung's numbers of each key, and how they follow the camera."""
    m, own, follows = slope.shape[1], {}, {}
    inverse = np.linalg.inv(scale) * (keep * (DEGREES + m) / (DEGREES + m + 2))[:, None, None]
    for key in dict.fromkeys(keys):
        mine = np.array([k == key for k in keys])
        size = rung.state[key].size if rung.state else 0
        jac = slope[mine][..., :size]
        weighted = np.einsum("nij,njp->nip", inverse[mine], jac)
        info = np.einsum("nip,niq->pq", weighted, jac) + VAGUE * np.eye(size)
        own[key] = np.linalg.inv(info + held.get(key, 0.0))
        follows[key] = -own[key] @ np.einsum("nip,nic->pc", weighted, camera[mine])
    return own, follows


def _linear(
    rung: Rung, contact: Contact, problem: Problem
) -> tuple[Gaps, np.ndarray, np.ndarray]:
    """Gaps of all pieces of a problem, their slopes by the rung's numbers and by the camera's."""
    robot, b = contact.robot, problem.batch
    w = problem.windows.at_lag(float(robot.camera.lag))

    def gap(some: Rung) -> np.ndarray:
        twist = jnp.asarray(some.twist(w, robot))
        return np.asarray(_gap(problem.space, jnp.asarray(contact.z), twist, b))

    twist = jnp.asarray(rung.twist(w, robot))
    camera = _gap_jacobian(problem.space, jnp.asarray(contact.z), twist, b)
    return gap(rung), slopes(rung, gap), np.asarray(camera)[..., _camera(contact)]


@partial(jax.jit, static_argnums=0)
def _gap(space: Any, z: Array, twist: Array, b: lk.Batch) -> Array:
    robot = space.tree(z)
    gap = lk.seen(robot, b, twist) - lk.measured(robot, b.pose)
    return gap.reshape(gap.shape[0], -1)


@partial(jax.jit, static_argnums=0)
def _gap_jacobian(space: Any, z: Array, twist: Array, b: lk.Batch) -> Array:
    return jax.jacfwd(lambda x: _gap(space, x, twist, b))(z)


def _keys(rung: Rung, w: Windows) -> list[str]:
    return [rung.series(s, load) for s, load in zip(w.surface, w.load, strict=True)]


def _camera(contact: Contact) -> np.ndarray:
    """Coordinates of the search vector that belong to the camera."""
    names = contact.problem.space.names
    return np.flatnonzero([name.startswith("camera.") for name in names])


def _quadratic(jac: np.ndarray, cov: np.ndarray) -> np.ndarray:
    return np.asarray((jac @ cov) @ np.swapaxes(jac, -1, -2))


def _by_name(problem: Problem, log_v: Any) -> dict[str, float]:
    return dict(zip(problem.noise.names, np.exp(np.asarray(log_v)).tolist(), strict=True))
