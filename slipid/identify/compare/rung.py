"""The interface of every slip model below the force balance, and the rung without a slip model."""

import abc
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from slipid.data.windows import Windows
from slipid.identify.fit.likelihood import measured, seen
from slipid.model.robot import Robot

Number = TypeVar("Number")
Increments = Float[np.ndarray, "piece window 3"]
Together = Int[np.ndarray, " run"]
"""A number for every run: runs of one number are left out together, those of -1 never are."""
HARMONICS = 6
WEIGHTS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
_seen, _measured = jax.jit(seen), jax.jit(measured)


@dataclass(frozen=True)
class Rung(abc.ABC):
    """A model that turns wheel motion into marker increments, in corrected metres.

    The state is the fitted numbers of each floor, with the name enough to build the rung again.
    """

    name: str
    state: dict[str, np.ndarray] = field(default_factory=dict, kw_only=True)

    @abc.abstractmethod
    def fit(self, w: Windows, robot: Robot) -> "Rung":
        """The rung fitted to these windows, floor by floor."""

    @abc.abstractmethod
    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        """Body twist of every window (piece, window, 3) [m/s, m/s, rad/s]."""

    def increments(self, w: Windows, robot: Robot) -> Increments:
        return as_increments(self.twist(w, robot), w, robot)

    def series(self, surface: str, load: str) -> str:
        """Key in `state` of the numbers that speak of a floor and load set-up."""
        of_floor(self.state, surface)
        return surface

    def stiffness(self, w: Windows, robot: Robot) -> dict[str, np.ndarray]:
        """What holds the fitted numbers besides the data: precision of each key's flat numbers."""
        return {}


def of_floor(floors: Mapping[str, Number], name: str) -> Number:
    """What is kept for a floor."""
    if name not in floors:
        raise ValueError(f"no surface '{name}'; identified: {', '.join(floors)}")
    return floors[name]


def as_increments(twist: np.ndarray, w: Windows, robot: Robot) -> Increments:
    """Marker increments [m, m, rad] of body twists (piece, window, 3)."""
    session = jnp.asarray([robot.session_index(s) for s in w.session])
    return np.asarray(_seen(robot, jnp.asarray(twist), jnp.asarray(w.dt), session))


def body_twist(w: Windows, robot: Robot) -> np.ndarray:
    """Measured body twist of every window: yaw and place of the marker taken out, over dt."""
    moved = np.asarray(_measured(robot, jnp.asarray(w.pose)))
    yaw = moved[..., 2]
    yaws = {s: float(robot.camera.yaw(robot.session_index(s))) for s in set(w.session)}
    psi = np.array([yaws[s] for s in w.session])[:, None]
    chord = turned(psi, moved[..., :2])
    place = np.broadcast_to(np.asarray(robot.camera.marker_place), chord.shape)
    chord -= turned(yaw, place) - place
    # a chord is the arc times sinc, and points half the turn away from its start
    arc = turned(-0.5 * yaw, chord) / np.sinc(yaw / (2 * np.pi))[..., None]
    return np.concatenate([arc, yaw[..., None]], -1) / w.dt[..., None]


def rims(w: Windows, robot: Robot) -> tuple[Float[np.ndarray, "3 wheel"], np.ndarray]:
    """J^+ r, from wheel speeds to the twist without slip, and the wheel speeds [rad/s]."""
    j = np.asarray(robot.geometry.least()) * float(robot.geometry.wheel_radius)
    return j, w.turn / w.dt[..., None]


def turned(angle: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Plane vectors (..., 2), each turned by its angle (...)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], -1)


def sideways(v: np.ndarray) -> np.ndarray:
    """Plane vectors (..., 2), each turned by a quarter to the left."""
    return np.stack([-v[..., 1], v[..., 0]], -1)


@dataclass(frozen=True)
class HeadingLookup(Rung):
    """Encoders corrected by a Fourier series in the direction of travel, per floor.

        (along, across, yaw) = (far, 0, turn) + far sum_k c_k phi_k(angle)

    with far, angle and turn the encoders' displacement, its direction and their yaw. Six harmonics,
    the k-th held down by weight k^4; the weight by cross-validation within the data it is fitted
    to: over runs that are left out `together`, so that the table is made for the question it will
    be asked, else over random runs, which makes it good in between.
    A floor has one series for each load set-up it was driven with.
    """

    name: str = "heading_lookup"
    together: Together | None = None

    def fit(self, w: Windows, robot: Robot) -> "HeadingLookup":
        return replace(
            self, state={t.key: t.ridge(t.best_weight()) for t in self._tables(w, robot)}
        )

    def stiffness(self, w: Windows, robot: Robot) -> dict[str, np.ndarray]:
        """The ridge as a Gaussian prior: its penalty over the mean square of what is left."""
        out = {}
        for t in self._tables(w, robot):
            left = np.mean((t.gap - t.phi @ self.state[t.key]) ** 2, axis=(0, 1))
            out[t.key] = np.kron(t.penalty(t.best_weight()), np.diag(1 / np.maximum(left, 1e-12)))
        return out

    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        angle, out = _encoders(w, robot)
        phi = _fourier(angle, out[..., 0])
        for n, (floor, load) in enumerate(zip(w.surface, w.load, strict=True)):
            out[n] += phi[n] @ self.state[self.series(floor, load)]
        out[..., :2] = turned(angle, out[..., :2])
        return np.asarray(out / w.dt[..., None])

    def series(self, surface: str, load: str) -> str:
        """Of this floor and load set-up, else of the load the floor was first driven with."""
        if (exact := f"{surface}@{load}") in self.state:
            return exact
        return of_floor({key.rsplit("@", 1)[0]: key for key in reversed(self.state)}, surface)

    def _tables(self, w: Windows, robot: Robot) -> Iterator["_Table"]:
        angle, plain = _encoders(w, robot)
        gap = body_twist(w, robot) * w.dt[..., None]
        gap[..., :2] = turned(-angle, gap[..., :2])
        gap -= plain
        phi = _fourier(angle, plain[..., 0])
        series = np.asarray([f"{a}@{b}" for a, b in zip(w.surface, w.load, strict=True)])
        for key in dict.fromkeys(series.tolist()):
            mine = series == key
            yield _Table(key, phi[mine], gap[mine], self._fold(w.run[mine]))

    def _fold(self, run: Int[np.ndarray, " piece"]) -> Int[np.ndarray, " piece"]:
        """Fold of every piece of a series, five of random runs where it has fewer than two."""
        fold = np.full(len(run), -1) if self.together is None else self.together[run]
        if len(set(fold[fold >= 0].tolist())) > 1:
            return fold
        return np.random.default_rng(0).integers(0, 5, run.max() + 1)[run]


class _Table(NamedTuple):
    """Features (piece, window, k) of a floor and load set-up, the gap they explain, and folds."""

    key: str
    phi: np.ndarray
    gap: np.ndarray
    fold: np.ndarray

    def penalty(self, weight: float) -> np.ndarray:
        rough = np.concatenate([[0.0], np.repeat(np.arange(1.0, HARMONICS + 1) ** 4, 2)])
        return np.asarray(weight * np.sum(self.phi[..., 0] ** 2) * np.diag(rough))

    def ridge(self, weight: float) -> np.ndarray:
        a = self.phi.reshape(-1, self.phi.shape[-1])
        gram = a.T @ a + self.penalty(weight)
        return np.asarray(np.linalg.solve(gram, a.T @ self.gap.reshape(-1, 3)))

    def best_weight(self) -> float:
        return min(WEIGHTS, key=self._left_out)

    def _left_out(self, weight: float) -> float:
        """Squared error over the folds."""
        loss = 0.0
        for test in (self.fold == k for k in set(self.fold.tolist()) - {-1}):
            if not test.all():
                rest = self._replace(phi=self.phi[~test], gap=self.gap[~test])
                gap = self.gap[test] - self.phi[test] @ rest.ridge(weight)
                loss += float((gap**2 * np.array([1.0, 1.0, 0.02])).sum())
        return loss


def _encoders(w: Windows, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Direction of travel by the encoders, and (distance, 0, yaw) of every window."""
    step = w.turn @ rims(w, robot)[0].T
    far = np.hypot(step[..., 0], step[..., 1])
    plain = np.stack([far, np.zeros_like(far), step[..., 2]], -1)
    return np.arctan2(step[..., 1], step[..., 0]), plain


def _fourier(angle: np.ndarray, far: np.ndarray) -> np.ndarray:
    waves = [f(k * angle) for k in range(1, HARMONICS + 1) for f in (np.cos, np.sin)]
    return np.stack([np.ones_like(angle), *waves], -1) * far[..., None]
