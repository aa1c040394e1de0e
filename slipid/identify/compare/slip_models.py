"""Rungs below the force balance: encoders, slip curves wheel by wheel, and a lookup by heading.

All share one interface, `fit(windows, robot)` then `increments(windows, robot)`, and are judged in
the same corrected metres as the force balance. Residuals are in displacement,
so nothing is divided by a wheel speed.
"""

import abc
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.optimize import least_squares, linprog, lsq_linear

from slipid.data.windows import Windows
from slipid.identify.fit.likelihood import measured, seen
from slipid.model.motor import signed
from slipid.model.robot import Robot

Increments = Float[np.ndarray, "piece window 3"]
HELD = 1e12
"""Precision of a coefficient that rests on its bound."""


class Rung(abc.ABC):
    """A model that turns wheel motion into marker increments."""

    name: str
    state: dict[str, np.ndarray]
    """Fitted numbers of each floor; with the name enough to build the rung again."""

    @abc.abstractmethod
    def fit(self, w: Windows, robot: Robot) -> "Rung":
        """The rung fitted to these windows, floor by floor."""

    @abc.abstractmethod
    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        """Body twist of every window (piece, window, 3) [m/s, m/s, rad/s]."""

    def with_state(self, state: dict[str, np.ndarray]) -> "Rung":
        """The rung with these numbers."""
        return replace(self, state=state)  # type: ignore[type-var]  # every rung is a dataclass

    def increments(self, w: Windows, robot: Robot) -> Increments:
        """Marker increments of every window [m, m, rad]."""
        return as_increments(self.twist(w, robot), w, robot)

    def series(self, surface: str, load: str) -> str:
        """Key in `state` of the numbers that speak of a floor and load set-up.

        Raises:
            ValueError: no such floor was fitted.
        """
        _need(self.state, surface)
        return surface

    def stiffness(self, w: Windows, robot: Robot) -> dict[str, np.ndarray]:
        """What holds the fitted numbers besides the data: precision of each key's flat numbers."""
        return {}


_seen, _measured = jax.jit(seen), jax.jit(measured)


def as_increments(twist: np.ndarray, w: Windows, robot: Robot) -> Increments:
    """Marker increments of body twists (piece, window, 3)."""
    session = jnp.asarray([robot.session_index(s) for s in w.session])
    return np.asarray(_seen(robot, jnp.asarray(twist), jnp.asarray(w.dt), session))


def body_twist(w: Windows, robot: Robot) -> np.ndarray:
    """Measured body twist of every window: yaw and place of the marker taken out, over dt."""
    moved = np.asarray(_measured(robot, jnp.asarray(w.pose)))
    yaw = moved[..., 2]
    psi = np.array([float(robot.camera.yaw(robot.session_index(s))) for s in w.session])[:, None]
    chord = _turned(psi, moved[..., :2])
    place = np.broadcast_to(np.asarray(robot.camera.marker_place), chord.shape)
    chord -= _turned(yaw, place) - place
    # a chord is the arc times sinc, and points half the turn away from its start
    arc = _turned(-0.5 * yaw, chord) / np.sinc(yaw / (2 * np.pi))[..., None]
    return np.concatenate([arc, yaw[..., None]], -1) / w.dt[..., None]


def _turned(angle: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Plane vectors (..., 2), each turned by its angle (...)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], -1)


Number = TypeVar("Number")


def _by_floor(w: Windows) -> dict[str, np.ndarray]:
    floor = np.asarray(w.surface)
    return {str(name): floor == name for name in dict.fromkeys(w.surface)}


def _need(floors: Mapping[str, Number], name: str) -> Number:
    if name not in floors:
        raise ValueError(f"no surface '{name}'; identified: {', '.join(floors)}")
    return floors[name]


@dataclass(frozen=True)
class Encoder(Rung):
    """No slip: xi = J^+ r w."""

    name: str = "encoder"
    state: dict[str, np.ndarray] = field(default_factory=dict)

    def fit(self, w: Windows, robot: Robot) -> "Encoder":
        return self

    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        j = np.asarray(robot.geometry.inverse()) * float(robot.geometry.wheel_radius)
        return np.asarray((w.turn / w.dt[..., None]) @ j.T)

    def series(self, surface: str, load: str) -> str:
        return surface


Features = Callable[[np.ndarray], np.ndarray]
"""From the regressor (...,) to features (..., k); slip is their weighted sum."""


@dataclass(frozen=True)
class Curve(Rung):
    """Slip of each wheel as a function of its own current or torque, linear in coefficients.

        s_i = sum_k beta_k phi_k(x_i),   xi = J^+ r (w (1 - s))

    Attributes:
        features: phi.
        torque: x is M = C_e I + R I^2/wm [N m] instead of the current [A].
        per_wheel: own coefficients for every wheel.
        positive: coefficients from here on are not negative (a monotone curve).
        insensitive: epsilon-insensitive loss instead of least squares, as support vector regression
            with a linear kernel has it; epsilon is a tenth of a robust std of what slip takes away.
    """

    name: str
    features: Features
    torque: bool = False
    per_wheel: bool = False
    positive: int | None = None
    insensitive: bool = False
    state: dict[str, np.ndarray] = field(default_factory=dict)

    def _design(self, w: Windows, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Twist without slip, and its change per coefficient (piece, window, 3, k)."""
        j = np.asarray(robot.geometry.inverse()) * float(robot.geometry.wheel_radius)
        speed = w.turn / w.dt[..., None]
        phi = self.features(regressor(w, robot, speed, self.torque))
        moved = np.einsum("aw,npw,npwk->npawk", j, speed, phi)
        lost = moved.reshape(*moved.shape[:3], -1) if self.per_wheel else moved.sum(axis=3)
        return speed @ j.T, lost

    def fit(self, w: Windows, robot: Robot) -> "Curve":
        free, lost = self._design(w, robot)
        gap = (free - body_twist(w, robot)) * w.dt[..., None]
        lost = lost * w.dt[..., None, None]
        scale = np.array([1.0, 1.0, float(robot.geometry.base_radius)])
        beta = {}
        for name, mine in _by_floor(w).items():
            a = (lost[mine] * scale[:, None]).reshape(-1, lost.shape[-1])
            b = (gap[mine] * scale).ravel()
            lower = np.full(a.shape[1], -np.inf)
            if self.positive is not None:
                lower[self.positive :] = 0.0
            if self.insensitive:
                beta[name] = insensitive(a, b)
            else:
                beta[name] = lsq_linear(a, b, (lower, np.inf), method="bvls").x
        return replace(self, state=beta)

    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        free, lost = self._design(w, robot)
        beta = np.stack([_need(self.state, s) for s in w.surface])
        return np.asarray(free - np.einsum("npak,nk->npa", lost, beta))

    def stiffness(self, w: Windows, robot: Robot) -> dict[str, np.ndarray]:
        """A coefficient that rests on its bound does not move with the data."""
        if self.positive is None:
            return {}
        edge = np.arange(len(next(iter(self.state.values())))) >= self.positive
        return {key: np.diag((edge & (b <= 0)) * HELD) for key, b in self.state.items()}


def insensitive(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Least sum of max(|a beta - b| - epsilon, 0), epsilon = iqr(b) / 13.49.

    Support vector regression (Vapnik 1995) where its penalty on beta does not count, as a linear
    program.
    """
    epsilon = float(np.subtract(*np.percentile(b, (75, 25)))) / 13.49
    over = sparse.eye_array(len(b))
    bound = np.concatenate([b + epsilon, epsilon - b])
    sides = sparse.block_array([[a, -over], [-a, -over]], format="csr")
    cost = np.concatenate([np.zeros(a.shape[1]), np.ones(len(b))])
    limits = [(None, None)] * a.shape[1] + [(0, None)] * len(b)
    found = linprog(cost, sides, bound, bounds=limits)
    if not found.success:
        raise ValueError(f"support vector regression: {found.message}")
    return np.asarray(found.x[: a.shape[1]])


def regressor(w: Windows, robot: Robot, speed: np.ndarray, torque: bool) -> np.ndarray:
    """|I| [A] or |M| [N m] of every wheel and window."""
    if not w.has_current:
        return np.zeros_like(speed)
    amps = np.abs(w.current)
    if not torque:
        return amps
    along = np.asarray(signed(jnp.asarray(amps), jnp.asarray(speed), robot.motor.gear_ratio))
    return np.abs(np.asarray(robot.motor.characteristic(jnp.asarray(along), jnp.asarray(speed))))


@dataclass(frozen=True)
class Saturating(Rung):
    """Janosi-Hanamoto read backwards: M = M_max (1 - exp(-s / kappa)), s on the rising branch.

        s = -kappa log(1 - min(M / M_max, 0.98))

    Source: Janosi and Hanamoto 1961.
    """

    name: str = "saturating"
    state: dict[str, np.ndarray] = field(default_factory=dict)

    @staticmethod
    def slip(m: np.ndarray, shape: np.ndarray) -> np.ndarray:
        kappa, m_max = np.exp(shape[..., 0]), np.exp(shape[..., 1])
        return -kappa * np.log1p(-np.minimum(m / m_max, 0.98))

    def fit(self, w: Windows, robot: Robot) -> "Saturating":
        j = np.asarray(robot.geometry.inverse()) * float(robot.geometry.wheel_radius)
        speed = w.turn / w.dt[..., None]
        m, true = regressor(w, robot, speed, True), body_twist(w, robot)
        scale = np.array([1.0, 1.0, float(robot.geometry.base_radius)])
        shape = {}
        for name, mine in _by_floor(w).items():

            def gap(q: np.ndarray, mine: np.ndarray = mine) -> np.ndarray:
                xi = (speed[mine] * (1 - self.slip(m[mine], q))) @ j.T
                return np.asarray(((xi - true[mine]) * w.dt[mine][..., None] * scale).ravel())

            top = float(np.log(max(m[mine].max(), 1e-3) * 1.5))
            # the cap makes several minima: with one-sided differences rounding decides between them
            tries = [
                least_squares(gap, [np.log(k), top], jac="3-point", max_nfev=200)
                for k in (0.05, 0.3, 1.0)
            ]
            shape[name] = min(tries, key=lambda r: r.cost).x
        return replace(self, state=shape)

    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        j = np.asarray(robot.geometry.inverse()) * float(robot.geometry.wheel_radius)
        speed = w.turn / w.dt[..., None]
        shape = np.stack([_need(self.state, s) for s in w.surface])[:, None, None, :]
        slip = self.slip(regressor(w, robot, speed, True), shape)
        return np.asarray((speed * (1 - slip)) @ j.T)


@dataclass(frozen=True)
class HeadingLookup(Rung):
    """Encoders corrected by a Fourier series in the direction of travel, per floor.

        (along, across, yaw) = (far, 0, turn) + far sum_k c_k phi_k(angle)

    with far, angle and turn the encoders' displacement, its direction and their yaw. Six harmonics,
    the k-th held down by weight k^4; the weight by cross-validation over random runs within the
    data it is fitted to, which is how such a table is made, and what makes it good in between.
    A floor has one series for each load set-up it was driven with.
    """

    name: str = "heading_lookup"
    state: dict[str, np.ndarray] = field(default_factory=dict)
    weights: Sequence[float] = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)

    def fit(self, w: Windows, robot: Robot) -> "HeadingLookup":
        out = {}
        for key, phi, gap, run in self._each(w, robot):
            out[key] = _ridge(phi, gap, _best_weight(phi, gap, run, self.weights))
        return replace(self, state=out)

    def _each(
        self, w: Windows, robot: Robot
    ) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
        """Key, features, what they have to explain, and runs of every floor and load set-up."""
        angle, plain = _encoders(w, robot)
        true = body_twist(w, robot) * w.dt[..., None]
        c, s = np.cos(angle), np.sin(angle)
        along = c * true[..., 0] + s * true[..., 1]
        across = -s * true[..., 0] + c * true[..., 1]
        gap = np.stack([along, across, true[..., 2]], -1) - plain
        phi = _fourier(angle, plain[..., 0])
        series = np.asarray([f"{a}@{b}" for a, b in zip(w.surface, w.load, strict=True)])
        for key in dict.fromkeys(series.tolist()):
            mine = series == key
            yield key, phi[mine], gap[mine], w.run[mine]

    def stiffness(self, w: Windows, robot: Robot) -> dict[str, np.ndarray]:
        """The ridge as a Gaussian prior: its penalty over the mean square of what is left."""
        out = {}
        for key, phi, gap, run in self._each(w, robot):
            penalty = _penalty(phi, _best_weight(phi, gap, run, self.weights))
            left = np.mean((gap - phi @ self.state[key]) ** 2, axis=(0, 1))
            out[key] = np.kron(penalty, np.diag(1 / np.maximum(left, 1e-12)))
        return out

    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        angle, out = _encoders(w, robot)
        phi = _fourier(angle, out[..., 0])
        for n, (floor, load) in enumerate(zip(w.surface, w.load, strict=True)):
            out[n] += phi[n] @ self.state[self.series(floor, load)]
        c, s = np.cos(angle), np.sin(angle)
        x, y = c * out[..., 0] - s * out[..., 1], s * out[..., 0] + c * out[..., 1]
        return np.stack([x, y, out[..., 2]], -1) / w.dt[..., None]

    def series(self, surface: str, load: str) -> str:
        """Of this floor and load set-up, else of the load the floor was first driven with."""
        if (exact := f"{surface}@{load}") in self.state:
            return exact
        first = {key.rsplit("@", 1)[0]: key for key in reversed(self.state)}
        return str(_need(first, surface))


def _encoders(w: Windows, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Direction of travel by the encoders, and (distance, 0, yaw) of every window."""
    j = np.asarray(robot.geometry.inverse()) * float(robot.geometry.wheel_radius)
    step = w.turn @ j.T
    far = np.hypot(step[..., 0], step[..., 1])
    plain = np.stack([far, np.zeros_like(far), step[..., 2]], -1)
    return np.arctan2(step[..., 1], step[..., 0]), plain


HARMONICS = 6


def _fourier(angle: np.ndarray, far: np.ndarray) -> np.ndarray:
    waves = [f(k * angle) for k in range(1, HARMONICS + 1) for f in (np.cos, np.sin)]
    return np.stack([np.ones_like(angle), *waves], -1) * far[..., None]


def _ridge(phi: np.ndarray, target: np.ndarray, weight: float) -> np.ndarray:
    a = phi.reshape(-1, phi.shape[-1])
    gram = a.T @ a + _penalty(phi, weight)
    return np.asarray(np.linalg.solve(gram, a.T @ target.reshape(-1, 3)))


def _penalty(phi: np.ndarray, weight: float) -> np.ndarray:
    rough = np.concatenate([[0.0], np.repeat(np.arange(1.0, HARMONICS + 1) ** 4, 2)])
    return np.asarray(weight * np.sum(phi[..., 0] ** 2) * np.diag(rough))


def _best_weight(
    phi: np.ndarray, gap: np.ndarray, run: np.ndarray, weights: Sequence[float]
) -> float:
    return min(weights, key=lambda weight: _left_out(phi, gap, run, weight))


def _left_out(phi: np.ndarray, target: np.ndarray, run: np.ndarray, weight: float) -> float:
    """Squared error over five random folds of runs."""
    fold, loss = np.random.default_rng(0).integers(0, 5, run.max() + 1)[run], 0.0
    for k in range(5):
        test = fold == k
        if test.any() and not test.all():
            gap = target[test] - phi[test] @ _ridge(phi[~test], target[~test], weight)
            loss += float((gap**2 * np.array([1.0, 1.0, 0.02])).sum())
    return loss


def _powers(*exponents: int) -> Features:
    return lambda x: np.stack([x**k for k in exponents], -1)


def _above(threshold: float) -> Features:
    """The deployed form of the paper: affine above a current, no slip below."""
    return lambda x: np.stack([np.where(x > threshold, x, 0.0), (x > threshold) * 1.0], -1)


def _ramps(knots: Sequence[float]) -> Features:
    """I-spline of degree 1: a constant and rising ramps between knots; monotone if weights >= 0."""
    edges = np.asarray([*knots])

    def phi(x: np.ndarray) -> np.ndarray:
        ramps = [np.clip((x - a) / (b - a), 0, 1) for a, b in pairwise(edges)]
        return np.stack([np.ones_like(x), *ramps], -1)

    return phi


def rungs(has_current: bool) -> list[Rung]:
    """Every rung the logs allow, unfitted; `paper` is the form the authors ran on the robot.

    Its threshold of 0.4 A and the spline's knots up to 0.25 N m are for motors of that size.
    """
    out: list[Rung] = [Encoder(), Curve("constant", _powers(0))]
    if has_current:
        out += [
            Curve("linear", _powers(1), torque=True),
            Curve("affine", _powers(0, 1), torque=True),
            Curve("svr", _powers(0, 1), torque=True, insensitive=True),
            Curve("quadratic", _powers(0, 1, 2), torque=True),
            Saturating(),
            Curve(
                "monotone_spline",
                _ramps((0.0, 0.02, 0.04, 0.06, 0.1, 0.15, 0.25)),
                torque=True,
                positive=1,
            ),
            Curve("affine_current", _powers(0, 1)),
            Curve("paper", _above(0.4), per_wheel=True),
        ]
    return [*out, HeadingLookup()]


def restored(states: Mapping[str, Mapping[str, Sequence]]) -> list[Rung]:
    """Rungs from their names and states, as `{rung.name: rung.state}` wrote them."""
    known = {rung.name: rung for rung in rungs(has_current=True)}
    if strange := sorted(set(states) - set(known)):
        raise ValueError(f"no model '{strange[0]}'; there are: {', '.join(known)}")
    return [
        known[name].with_state({floor: np.asarray(v, float) for floor, v in state.items()})
        for name, state in states.items()
    ]
