"""Rungs below the force balance: encoders, slip curves wheel by wheel, corrected kinematics.

Residuals are in displacement, so nothing is divided by a wheel speed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
from scipy import sparse
from scipy.optimize import least_squares, linprog, lsq_linear

from slipid.data.windows import Windows
from slipid.identify.compare.kinematics import Nominal, corrected
from slipid.identify.compare.rung import (
    HeadingLookup,
    Rung,
    Together,
    body_twist,
    of_floor,
    rims,
)
from slipid.model.geometry import Geometry
from slipid.model.motor import signed
from slipid.model.robot import Robot

KNOTS = (0.0, 0.02, 0.04, 0.06, 0.1, 0.15, 0.25)
"""Of the monotone spline [N m]."""
HELD = 1e12
"""Precision of a coefficient that rests on its bound."""
RIDGE = 1e-6
"""Pull of each coefficient towards zero, in the length of its column of the design.

Too weak to matter where runs tell coefficients apart; where they do not, the smallest are taken
instead of whichever rounding prefers.
"""


@dataclass(frozen=True)
class Encoder(Rung):
    """No slip: xi = J^+ r w, at the fitted radius, places and lag."""

    name: str = "encoder"

    def fit(self, w: Windows, robot: Robot) -> "Encoder":
        return self

    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        j, speed = rims(w, robot)
        return np.asarray(speed @ j.T)

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
        monotone: no coefficient but the first is negative.
        insensitive: epsilon-insensitive loss instead of least squares, as support vector regression
            with a linear kernel has it; epsilon is a tenth of a robust std of what slip takes away.
    """

    features: Features
    torque: bool = False
    per_wheel: bool = False
    monotone: bool = False
    insensitive: bool = False

    def _design(self, w: Windows, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Twist without slip, and its change per coefficient (piece, window, 3, k)."""
        j, speed = rims(w, robot)
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
        for name in dict.fromkeys(w.surface):
            mine = np.asarray(w.surface) == name
            a = (lost[mine] * scale[:, None]).reshape(-1, lost.shape[-1])
            b = (gap[mine] * scale).ravel()
            if self.insensitive:
                beta[name] = insensitive(a, b)
            else:
                lower = np.where(self._held(a.shape[1]), 0.0, -np.inf)
                ridge = RIDGE * np.diag(np.linalg.norm(a, axis=0))
                rows = np.concatenate([a, ridge]), np.concatenate([b, np.zeros(len(ridge))])
                beta[name] = lsq_linear(*rows, (lower, np.inf), method="bvls").x
        return replace(self, state=beta)

    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        free, lost = self._design(w, robot)
        beta = np.stack([of_floor(self.state, s) for s in w.surface])
        return np.asarray(free - np.einsum("npak,nk->npa", lost, beta))

    def stiffness(self, w: Windows, robot: Robot) -> dict[str, np.ndarray]:
        """A coefficient that rests on its bound does not move with the data."""
        if not self.monotone:
            return {}
        return {
            key: np.diag((self._held(len(b)) & (b <= 0)) * HELD) for key, b in self.state.items()
        }

    def _held(self, count: int) -> np.ndarray:
        """Which coefficients are not negative."""
        return self.monotone & (np.arange(count) > 0)


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

    @staticmethod
    def slip(m: np.ndarray, shape: np.ndarray) -> np.ndarray:
        kappa, m_max = np.exp(shape[..., 0]), np.exp(shape[..., 1])
        return -kappa * np.log1p(-np.minimum(m / m_max, 0.98))

    def fit(self, w: Windows, robot: Robot) -> "Saturating":
        j, speed = rims(w, robot)
        m, true = regressor(w, robot, speed, True), body_twist(w, robot)
        scale = np.array([1.0, 1.0, float(robot.geometry.base_radius)])
        shape = {}
        for name in dict.fromkeys(w.surface):
            mine = np.asarray(w.surface) == name

            def gap(q: np.ndarray, mine: np.ndarray = mine) -> np.ndarray:
                xi = (speed[mine] * (1 - self.slip(m[mine], q))) @ j.T
                return np.asarray(((xi - true[mine]) * w.dt[mine][..., None] * scale).ravel())

            top = float(np.log(max(m[mine].max(), 1e-3) * 1.5))
            # the cap makes several minima: with one-sided differences rounding decides between them
            starts = ([np.log(k), top] for k in (0.05, 0.3, 1.0))
            tries = [least_squares(gap, x, jac="3-point", max_nfev=200) for x in starts]
            shape[name] = min(tries, key=lambda r: r.cost).x
        return replace(self, state=shape)

    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        j, speed = rims(w, robot)
        shape = np.stack([of_floor(self.state, s) for s in w.surface])[:, None, None, :]
        slip = self.slip(regressor(w, robot, speed, True), shape)
        return np.asarray((speed * (1 - slip)) @ j.T)


def _powers(*exponents: int) -> Features:
    return lambda x: np.stack([x**k for k in exponents], -1)


def _above(threshold: float) -> Features:
    """The deployed form of the paper: affine above a current, no slip below."""
    return lambda x: np.stack([np.where(x > threshold, x, 0.0), (x > threshold) * 1.0], -1)


def _ramps(knots: Sequence[float]) -> Features:
    """I-spline of degree 1: a constant and rising ramps between knots; monotone if weights >= 0."""

    def phi(x: np.ndarray) -> np.ndarray:
        ramps = [np.clip((x - a) / (b - a), 0, 1) for a, b in pairwise(knots)]
        return np.stack([np.ones_like(x), *ramps], -1)

    return phi


def rungs(shape: Geometry, has_current: bool, together: Together | None = None) -> list[Rung]:
    """Every rung the logs allow, unfitted; `paper` is the form the authors ran on the robot.

    The shape is the robot's as its config has it: wheels that do not determine the twist have rungs
    of their own. The threshold of `paper`, 0.4 A, and the spline's knots are for motors of that
    size. Runs that will be left out `together` are so, too, where a rung tunes itself.
    """
    plain: list[Rung] = [Nominal("nominal", shape), Encoder()]
    if not shape.determines_twist:
        return plain + corrected(shape)
    return plain + _of_wheels(has_current, together)


def _of_wheels(has_current: bool, together: Together | None) -> list[Rung]:
    """Slip wheel by wheel, and by the direction of travel."""
    out: list[Rung] = [Curve("constant", _powers(0))]
    if has_current:
        out += [
            Curve("linear", _powers(1), torque=True),
            Curve("affine", _powers(0, 1), torque=True),
            Curve("svr", _powers(0, 1), torque=True, insensitive=True),
            Curve("quadratic", _powers(0, 1, 2), torque=True),
            Saturating(),
            Curve("monotone_spline", _ramps(KNOTS), torque=True, monotone=True),
            Curve("affine_current", _powers(0, 1)),
            Curve("paper", _above(0.4), per_wheel=True),
        ]
    return [*out, HeadingLookup(together=together)]


def restored(shape: Geometry, states: Mapping[str, Mapping[str, Sequence]]) -> list[Rung]:
    """Rungs from their names and states, as `{rung.name: rung.state}` wrote them."""
    known = {rung.name: rung for rung in rungs(shape, has_current=True)}
    if strange := sorted(set(states) - set(known)):
        raise ValueError(f"no model '{strange[0]}'; there are: {', '.join(known)}")
    return [
        replace(known[name], state={floor: np.asarray(v, float) for floor, v in state.items()})
        for name, state in states.items()
    ]
