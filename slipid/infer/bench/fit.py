"""The numbers of one motor by the quasi-posterior of their moments.

With the moments g of both equations, their scatter S and Gaussian priors in the search space z,

    -2 log pi(z) = g(z)^T S^-1 g(z) + |(z - mean) / std|^2 + const

(Chernozhukov and Hong 2003: as good as a likelihood where the mean of g is what is known). Weights,
S and z are found in turn. Its curvature J^T J, of the residuals in that sum, is the sandwich of
robust statistics at once: intervals hold although noise is neither white nor Gaussian nor known.

Why not least squares or a Kalman smoother? The current is a noisy input: least squares has R too
small by the part of the noise in the current's variance, and a smoother that knows better needs the
spectra of three noises and what the voltage did between rows. Here no noise has to be known.
"""

import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from slipid.infer.bench.moments import (
    MomentSums,
    cell_length,
    celled,
    grouped,
    memory,
    scatter,
    start,
    sums,
    widened,
)
from slipid.infer.bench.motor import (
    AMPS,
    BRUSH_CURRENT,
    VOLTS,
    BenchMotor,
    BenchRecord,
    BenchRoot,
    SensorNoise,
    noise_of,
)
from slipid.infer.bench.windows import BenchWindows, electrical, mechanical
from slipid.search_space import Choice, Space

ROUNDS = 30
"""Of weights, scatter and numbers, at most."""
SETTLED = 0.02
"""It stops when no number moves by more of its std in a round."""
CONSTANT_S = 2e-3
"""Std of the electrical time constant before anything is seen [s]."""
ASKED = (len(VOLTS) - 1, len(AMPS))
"""Moments of each equation: that along a magnitude is left to the mechanical one."""


@dataclass(frozen=True, eq=False)
class MotorFit:
    """What a fit of one motor found.

    Attributes:
        label: of the motor, "" where it is the only one.
        space: free and fixed numbers, priors. `choices`: what the user wanted.
        z, covariance: at the optimum, in the search space.
        volts, amps: windows of both equations, None without voltage.
        volts_sums, amps_sums: their weights and residuals.
        remember: time over which residuals are correlated [s].
        stretches: how many such times were seen.
    """

    label: str
    records: tuple[BenchRecord, ...]
    space: Space
    choices: tuple[Choice, ...]
    z: Float[np.ndarray, " free"]
    covariance: Float[np.ndarray, "free free"]
    volts: BenchWindows | None
    amps: BenchWindows
    volts_sums: MomentSums | None
    amps_sums: MomentSums
    noise: SensorNoise
    remember: float
    stretches: float
    converged: bool
    reason: str
    rounds: int

    @property
    def motor(self) -> BenchMotor:
        """The numbers found."""
        found: BenchMotor = self.space.tree(jnp.asarray(self.z)).motor
        return found

    @property
    def has_voltage(self) -> bool:
        return self.volts is not None

    @property
    def period(self) -> float:
        """Usual time between rows [s]."""
        return float(np.median([r.period for r in self.records]))


class _EquationSums(eqx.Module):
    """Sums of one equation, nothing where it has no windows."""

    constant: Array
    slope: Array
    tangent: Array

    @staticmethod
    def of(s: MomentSums | None, moments: int, columns: int) -> "_EquationSums":
        if s is None:
            return _EquationSums(jnp.zeros(moments), *[jnp.zeros((moments, columns))] * 2)
        return _EquationSums(*map(jnp.asarray, (s.constant, s.slope, s.tangent)))


class _Objective(eqx.Module):
    """What the numbers are sought with: sums of both equations, S^-1/2, priors."""

    space: Space
    volts: _EquationSums
    amps: _EquationSums
    root: Array

    def tangents(self) -> "_Objective":
        """The same, whose slopes are what decides how sure the numbers are."""
        slopes = self.volts.tangent, self.amps.tangent
        return eqx.tree_at(lambda h: (h.volts.slope, h.amps.slope), self, slopes)


def fit_motor(
    records: Sequence[BenchRecord], choices: Sequence[Choice] = (), label: str = ""
) -> MotorFit:
    """Fit one motor to its records, of which all or none have voltages."""
    amps, volts = mechanical(records), electrical(records, 0.0)
    first = _first(volts, amps, all(r.signed for r in records))
    scaled = [*_scaled(records, float(first.resistance)), *choices]
    space = Space(BenchRoot(BenchMotor()), scaled)
    z = space.vector(BenchRoot(first))
    # what is not free, or has a start of the user's, keeps it
    z = np.where(_chosen(space, choices), space.start, z)
    zero, moved, rounds = 0.0, np.inf, 0
    while moved >= SETTLED and rounds < ROUNDS:
        motor = space.tree(jnp.asarray(z)).motor
        if abs(float(motor.current_offset) - zero) > 0.02 * BRUSH_CURRENT:
            zero = float(motor.current_offset)
            volts = electrical(records, zero)
        v = None if volts is None else sums(volts, np.asarray(motor.volts()), ASKED[0])
        a = sums(amps, np.asarray(motor.amps()), ASKED[1])
        s, remember, stretches = _scatter(volts, v, amps, a)
        new, covariance = _solved(space, z, v, a, s)
        moved = float(np.max(np.abs(new - z) / np.sqrt(np.diag(covariance)), initial=0.0))
        z, rounds = new, rounds + 1
    settled = moved < SETTLED and bool(np.isfinite(z).all())
    reason = f"no number moved {SETTLED:g} of its std in round {rounds}"
    return MotorFit(
        label=label,
        records=tuple(records),
        space=space,
        choices=tuple(choices),
        z=z,
        covariance=covariance,
        volts=volts,
        amps=amps,
        volts_sums=v,
        amps_sums=a,
        noise=noise_of(records),
        remember=remember,
        stretches=stretches,
        converged=settled,
        reason=reason if settled else f"{rounds} rounds without settling",
        rounds=rounds,
    )


def _first(volts: BenchWindows | None, amps: BenchWindows, signed: bool) -> BenchMotor:
    """Where the search starts: both equations by themselves, what is negative left at its start."""
    usual = BenchMotor()
    r, c, drop, slow, one = float(usual.resistance), float(usual.back_emf), 0.0, 0.0, 0.0
    if volts is not None:
        found = start(volts, ASKED[0], list(range(ASKED[0])))
        r, c = (float(x) if x > 0 else y for x, y in zip(found, (r, c), strict=False))
        drop, slow, one = map(float, found[2:5])
    # a magnitude's zero and friction are one signal: least squares shares it between both
    k = start(amps, ASKED[1], list(range(ASKED[1] if signed else ASKED[1] - 1)))
    torque = (usual.rotor_inertia, usual.coulomb_friction, usual.viscous_friction)
    j, tau, b = (float(x) * c if x > 0 else float(y) for x, y in zip(k, torque, strict=False))
    zero = float(k[3])
    return BenchMotor(
        # in order of declaration
        *map(jnp.asarray, (r, c, slow, drop, tau, b, j, zero, one + r * zero))
    )


def _scaled(records: Sequence[BenchRecord], resistance: float) -> list[Choice]:
    """Priors that go with the size of the motor: a time constant, and tenths of what was seen."""
    amps = 0.1 * max(float(np.abs(r.current).max()) for r in records)
    chosen = [Choice("motor.current_offset", prior_mean=0.0, prior_std=max(amps, 1e-6))]
    known = [r.voltage for r in records if r.voltage is not None]
    if known:
        volts = 0.1 * max(float(np.abs(u).max()) for u in known)
        chosen.append(Choice("motor.voltage_offset", prior_mean=0.0, prior_std=max(volts, 1e-6)))
    slow = CONSTANT_S * resistance
    return [*chosen, Choice("motor.inductance", prior_mean=0.0, prior_std=slow)]


def _chosen(space: Space, choices: Sequence[Choice]) -> np.ndarray:
    """Coordinates that the user gave a start."""
    wanted = [c.pattern for c in choices if c.start is not None]
    return space.where(lambda e: any(fnmatch.fnmatchcase(e.path, p) for p in wanted))


def _scatter(
    volts: BenchWindows | None, v: MomentSums | None, amps: BenchWindows, a: MomentSums
) -> tuple[Float[np.ndarray, "moment moment"], float, float]:
    """Scatter of all moments; time that residuals remember [s], and how many such there are."""
    pairs = [(amps, a)] if volts is None or v is None else [(volts, v), (amps, a)]
    length = cell_length([w for w, _ in pairs])
    parts = [celled(s.moments, w, length) for w, s in pairs]
    count = max(len(p) for p in parts)
    g = np.concatenate([np.pad(p, ((0, count - len(p)), (0, 0))) for p in parts], axis=1)
    left = [celled(s.residual[:, None], w, length)[:, 0] for w, s in pairs]
    lags = 2 * max(memory(x) for x in left) + 2
    groups = np.concatenate([grouped(s, w) for w, s in pairs], axis=1)
    return widened(scatter(g, lags), groups), lags * length / 2, count / lags


def _solved(
    space: Space, z: np.ndarray, v: MomentSums | None, a: MomentSums, s: np.ndarray
) -> tuple[Float[np.ndarray, " free"], Float[np.ndarray, "free free"]]:
    """Optimum of the quasi-posterior with weights and scatter held, and its covariance."""
    std = np.sqrt(np.maximum(np.diag(s), 1e-300))
    # signals may all be alike, as in a log at one speed: their moments then say one thing only
    root = np.linalg.inv(np.linalg.cholesky(s / std / std[:, None] + 1e-9 * np.eye(len(s)))) / std
    if v is None:
        root = np.concatenate([np.zeros((len(root), ASKED[0])), root], axis=1)
    volts, amps = _EquationSums.of(v, ASKED[0], len(VOLTS)), _EquationSums.of(a, *a.slope.shape)
    found, tangent = _searched(jnp.asarray(z), _Objective(space, volts, amps, jnp.asarray(root)))
    jacobian = np.asarray(tangent)
    return np.asarray(found), np.linalg.inv(jacobian.T @ jacobian)


@eqx.filter_jit
def _searched(z: Float[Array, " free"], held: _Objective) -> tuple[Array, Array]:
    """Optimum, and the Jacobian of the residuals there."""
    solver = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)
    found = optx.least_squares(_residuals, solver, z, args=held, max_steps=200, throw=False)
    return found.value, jax.jacfwd(_residuals)(found.value, held.tangents())


def _residuals(z: Float[Array, " free"], held: _Objective) -> Float[Array, " residual"]:
    """S^-1/2 g and what the prior says."""
    motor = held.space.tree(z).motor
    pairs = (held.volts, motor.volts()), (held.amps, motor.amps())
    g = jnp.concatenate([block.constant - block.slope @ k for block, k in pairs])
    prior = (z - held.space.prior_mean) / held.space.prior_std
    return jnp.concatenate([held.root @ g, prior])
