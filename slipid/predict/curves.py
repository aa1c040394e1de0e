"""Slip models with a curve of each wheel's slip over its current or torque.

    xi = J^+ r (w_i (1 - s_i))

xi is the body twist, r w_i the rim speed of wheel i and s_i its slip. The curves are fitted to the
motion of the body. Residuals are displacements, so that nothing is divided by a wheel speed.
"""

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import final

import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.optimize import least_squares, linprog, lsq_linear

from slipid.model.motor import REST
from slipid.predict.slip_model import RobotSpec, RunSignals, Twists
from slipid.predict.steps import Steps, TrainingWindows, TwistModel, scaled_least_squares

Slips = Float[np.ndarray, "step drive"]
Regressor = Callable[[RunSignals, RobotSpec], Slips]
"""Function that returns the argument x of each wheel's slip curve in every step."""
Features = Callable[[np.ndarray], np.ndarray]
"""Function from the regressor (...,) to features (..., k); slip is their weighted sum."""
BOUND_PRECISION = 1e12
"""Precision assigned to a coefficient at its bound, which is thereby treated as fixed."""
RIDGE = 1e-6
"""Ridge on each coefficient of a monotone curve, relative to the norm of its column.

The ridge has no visible influence on coefficients that the runs determine. All other coefficients
become as small as possible; without the ridge, rounding errors would determine them."""


def current(signals: RunSignals, spec: RobotSpec) -> Slips:
    """Return currents [A], positive if the motor drives its wheel; zeros if none were logged."""
    return np.zeros_like(signals.turn) if signals.current is None else signals.along(spec)


def soft_torque(signals: RunSignals, spec: RobotSpec) -> Slips:
    """Return the torque (`RunSignals.torque`) of every motor [N m]; zeros without logged currents.

    Currents fade to zero near standstill, I = |I| w / sqrt(w^2 + w0^2), because an unsigned ammeter
    does not show the sign of a current there.
    """
    shaft = np.abs(spec.gear_ratio * signals.speed)
    amps = current(signals, spec) * shaft / np.sqrt(shaft**2 + REST**2)
    return replace(signals, current=amps, current_is_signed=False).torque(spec, REST)


@dataclass(frozen=True)
class WheelSlip(TwistModel, abc.ABC):
    """A model that predicts the slip of each wheel from the current of its motor."""

    @abc.abstractmethod
    def slip(self, steps: Steps, spec: RobotSpec) -> Slips:
        """Return the slip of each drive [-] in every step."""

    def twist(self, steps: Steps, spec: RobotSpec) -> Twists:
        rim = steps.signals.speed * spec.wheel_radius * (1.0 - self.slip(steps, spec))
        return np.asarray(rim @ spec.back.T)


@final
@dataclass(frozen=True)
class CurveModel(WheelSlip):
    """Slip of each wheel as a function of its current or torque, linear in coefficients.

        s_i = sum_k beta_k phi_k(x_i)

    Attributes:
        features: functions phi_k of the regressor.
        regressor: function that returns x, the current [A] or a torque [N m].
        per_wheel: True if every wheel has separate coefficients.
        monotone: True if only the first coefficient may be negative.
        insensitive: True for an epsilon-insensitive loss instead of least squares, as in support
            vector regression with a linear kernel; epsilon is a tenth of a robust std of the
            displacement lost to slip.
        smoothing: time constant of a low pass of x [s], None for no smoothing.
        most: largest magnitude of the slip; slip is negative if a wheel is dragged along.
    """

    features: Features
    regressor: Regressor = current
    per_wheel: bool = False
    monotone: bool = False
    insensitive: bool = False
    smoothing: float | None = None
    most: float = np.inf

    def learn(self, w: TrainingWindows, spec: RobotSpec) -> "CurveModel":
        rim = w.steps.signals.speed * spec.wheel_radius
        parts, gap = w.rows(spec.back @ (rim[..., None] * self.regressors(w.steps, spec)), spec)
        a, b = parts.reshape(-1, parts.shape[-1]), gap.ravel()
        if self.insensitive:
            return replace(self, coefficients=insensitive(a, b))
        if not self.monotone:
            return replace(self, coefficients=scaled_least_squares(a, b))
        lower = np.where(np.arange(a.shape[1]) > 0, 0.0, -np.inf)
        ridge = RIDGE * np.diag(np.linalg.norm(a, axis=0))
        all_rows = np.concatenate([a, ridge]), np.concatenate([b, np.zeros(len(ridge))])
        return replace(self, coefficients=lsq_linear(*all_rows, (lower, np.inf), method="bvls").x)

    def slip(self, steps: Steps, spec: RobotSpec) -> Slips:
        return np.clip(self.regressors(steps, spec) @ self.known, -self.most, self.most)

    def regressors(self, steps: Steps, spec: RobotSpec) -> Float[np.ndarray, "step drive k"]:
        """Return the features; their sum, weighted by the coefficients, is each drive's slip."""
        x = self.regressor(steps.signals, spec)
        phi = self.features(x if self.smoothing is None else steps.smoothed(x, self.smoothing))
        if not self.per_wheel:
            return phi
        return np.einsum("sdk,de->sdek", phi, np.eye(phi.shape[1])).reshape(*phi.shape[:2], -1)

    def stiffness(self, w: TrainingWindows, spec: RobotSpec) -> Float[np.ndarray, "k k"]:
        """Return `BOUND_PRECISION` for coefficients at their bound of zero, and zero for others."""
        held = self.monotone & (np.arange(self.numbers) > 0) & (self.known <= 0)
        return np.diag(held * BOUND_PRECISION)


def insensitive(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the beta that minimises the sum of max(|a beta - b| - epsilon, 0).

    epsilon is a tenth of a robust std of b. This is support vector regression (Vapnik 1995) with a
    negligible penalty on beta, solved as a linear program.
    """
    epsilon = 0.1 * robust_std(b)
    over = sparse.eye_array(len(b))
    bound = np.concatenate([b + epsilon, epsilon - b])
    sides = sparse.block_array([[a, -over], [-a, -over]], format="csr")
    cost = np.concatenate([np.zeros(a.shape[1]), np.ones(len(b))])
    limits = [(None, None)] * a.shape[1] + [(0, None)] * len(b)
    found = linprog(cost, sides, bound, bounds=limits)
    if not found.success:
        raise ValueError(f"support vector regression: the linear program failed: {found.message}")
    return np.asarray(found.x[: a.shape[1]])


def robust_std(x: Float[np.ndarray, " sample"]) -> float:
    """Return the std of a Gaussian with the interquartile range of x, which is 1.349 stds."""
    return float(np.subtract(*np.percentile(x, (75, 25)))) / 1.349


@final
@dataclass(frozen=True)
class Saturating(WheelSlip):
    """Slip of each wheel by the inverted Janosi-Hanamoto curve, M = M_max (1 - exp(-s / kappa)).

        s = -kappa log(1 - min(M / M_max, 0.98))

    M is the wheel's torque [N m]. The coefficients are the logarithms of kappa and M_max. Source:
    Janosi and Hanamoto 1961.
    """

    name: str = "saturating"

    def learn(self, w: TrainingWindows, spec: RobotSpec) -> "Saturating":
        def errors(shape: np.ndarray) -> np.ndarray:
            return w.errors(replace(self, coefficients=shape).twist(w.steps, spec), spec)

        torque = soft_torque(w.steps.signals, spec)
        top = float(np.log(max(torque.max(), 1e-3) * 1.5))
        # The cap of 0.98 causes several minima, so that several starts are tried. Differences are
        # 3-point ones, as rounding errors of one-sided differences would decide which minimum is
        # found.
        starts = ([np.log(k), top] for k in (0.05, 0.3, 1.0))
        tries = [least_squares(errors, x, jac="3-point", max_nfev=200) for x in starts]
        return replace(self, coefficients=min(tries, key=lambda r: r.cost).x)

    def slip(self, steps: Steps, spec: RobotSpec) -> Slips:
        kappa, m_max = np.exp(self.known)
        share = np.minimum(soft_torque(steps.signals, spec) / m_max, 0.98)
        return np.asarray(-kappa * np.log1p(-share))


def powers(*exponents: int) -> Features:
    """Return features that are powers of the regressor."""
    return lambda x: np.stack([x**k for k in exponents], -1)


def above(threshold: float) -> Features:
    """Return features of slip that is affine above a current [A], else zero.

    This is the form that ran on the robot of the 2021 paper (docs/theory.md).
    """
    return lambda x: np.stack([np.where(x > threshold, x, 0.0), (x > threshold) * 1.0], -1)


def ramps(knots: Sequence[float]) -> Features:
    """Return the features of an I-spline of degree 1: a constant and a rising ramp between knots.

    The curve is monotone if the weights of all ramps are not negative.
    """

    def phi(x: np.ndarray) -> np.ndarray:
        rising = [np.clip((x - a) / (b - a), 0, 1) for a, b in pairwise(knots)]
        return np.stack([np.ones_like(x), *rising], -1)

    return phi
