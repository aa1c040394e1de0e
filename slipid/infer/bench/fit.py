"""Check of a motor's logs and fit of one motor: the maximum of the quasi-posterior of its moments.

Logs with wrong units, signs or columns are refused before the fit (`check_records`).

With the moments g of both equations, their scatter S and Gaussian priors in the search space z,

    -2 log pi(z) = g(z)^T S^-1 g(z) + |(z - mean) / std|^2 + const

(Chernozhukov and Hong 2003: such a quasi-posterior may replace a posterior if only the mean of g is
known). Weights, S and z are updated in turn. With J the derivative of S^-1/2 g and of the prior's
residuals with respect to z, the inverse of J^T J equals the sandwich covariance of robust
statistics: intervals are valid although the noise is neither white nor Gaussian nor known.

Least squares and Kalman smoothers are unsuitable because the current is a noisy input: least
squares underestimates R by the fraction of noise in the current's variance, and a smoother needs
the spectra of three noises and the voltage between rows. Moments need none of these.
"""

import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from slipid.infer.bench.moments import (
    Equation,
    cell_length,
    celled,
    correlation_cells,
    equation,
    grouped,
    scatter,
    start,
    widened,
)
from slipid.infer.bench.motor import (
    AMPS,
    BRUSH_CURRENT,
    REST,
    VOLTS,
    BenchMotor,
    BenchRecord,
    BenchRoot,
    noise,
)
from slipid.infer.bench.windows import BenchWindows, electrical, mechanical
from slipid.search_space import Choice, Space
from slipid.support.errors import DataError

MOST_ROUNDS = 30
"""Largest number of updates of weights, scatter and parameters."""
SETTLED_STDS = 0.02
"""Largest change of a parameter in the last round of a converged fit [std]."""
TIME_CONSTANT_STD_S = 2e-3
"""Prior std of the electrical time constant L_a / R [s]."""
MOMENTS = (len(VOLTS) - 1, len(AMPS))
"""Number of moments of the electrical and of the mechanical equation.

The last signal of both equations is the sign given to unsigned currents; it multiplies residuals
only in the mechanical equation."""


@dataclass(frozen=True, eq=False)
class MotorFit:
    """Fit of one motor.

    Attributes:
        label: label of the motor, "" for a single one.
        records: runs of the motor.
        space: free and fixed parameters with their priors.
        choices: user's choices.
        z: search vector at the optimum.
        covariance: covariance of the search vector.
        equations: the electrical equation, absent without voltage, and the mechanical one.
        correlation_time: time over which residuals are correlated [s].
        independent_times: length of the records divided by twice the correlation time.
        converged: True if the parameters converged.
        reason: sentence on how the fit ended.
        rounds: number of rounds.
    """

    label: str
    records: tuple[BenchRecord, ...]
    space: Space
    choices: tuple[Choice, ...]
    z: Float[np.ndarray, " free"]
    covariance: Float[np.ndarray, "free free"]
    equations: tuple[Equation, ...]
    correlation_time: float
    independent_times: float
    converged: bool
    reason: str
    rounds: int

    @property
    def motor(self) -> BenchMotor:
        """Motor with the fitted parameters."""
        found: BenchMotor = self.space.tree(jnp.asarray(self.z)).motor
        return found

    @property
    def noise(self) -> dict[str, float | None]:
        """Std of the white noise of each channel, None for a channel that was not logged."""
        volts = [r.voltage for r in self.records if r.voltage is not None]
        return {
            "voltage": noise(volts) if volts else None,
            "current": noise([r.amps for r in self.records]),
            "speed": noise([r.speed for r in self.records]),
        }

    @property
    def has_voltage(self) -> bool:
        return len(self.equations) > 1

    @property
    def period(self) -> float:
        """Median time between rows [s]."""
        return float(np.median([r.period for r in self.records]))


class _Objective(eqx.Module):
    """Arguments of the search for the optimum.

    Attributes:
        space: free parameters with their priors.
        root: S^-1/2, which whitens the moments.
        constant: vector h of each equation (`Equation`), the mechanical equation last.
        slope: matrix G of each equation.
    """

    space: Space
    root: Array
    constant: tuple[Array, ...]
    slope: tuple[Array, ...]


def fit_motor(
    records: Sequence[BenchRecord], choices: Sequence[Choice] = (), label: str = ""
) -> MotorFit:
    """Return the fit of one motor to its records, of which all or none have voltages."""
    amps, volts = mechanical(records), electrical(records, 0.0)
    first = _first(volts, amps, all(r.signed for r in records))
    scaled = [*_scaled(records, float(first.resistance)), *choices]
    space = Space(BenchRoot(BenchMotor()), scaled)
    z = space.vector(BenchRoot(first))
    # Start values from the user replace those estimated from the equations.
    started = [c.pattern for c in choices if c.start is not None]
    chosen = space.where(lambda e: any(fnmatch.fnmatchcase(e.path, p) for p in started))
    z = np.where(chosen, space.start, z)
    zero, moved, rounds = 0.0, np.inf, 0
    while moved >= SETTLED_STDS and rounds < MOST_ROUNDS:
        motor = space.tree(jnp.asarray(z)).motor
        if abs(float(motor.current_offset) - zero) > 0.02 * BRUSH_CURRENT:
            zero = float(motor.current_offset)
            volts = electrical(records, zero)
        equations = [equation(amps, np.asarray(motor.amps()), MOMENTS[1])]
        if volts is not None:
            equations.insert(0, equation(volts, np.asarray(motor.volts()), MOMENTS[0]))
        s, correlation_time, independent_times = _scatter(equations)
        new, covariance = _solved(space, z, equations, s)
        moved = float(np.max(np.abs(new - z) / np.sqrt(np.diag(covariance)), initial=0.0))
        z, rounds = new, rounds + 1
    settled = moved < SETTLED_STDS and bool(np.isfinite(z).all())
    reason = f"no parameter changed by {100 * SETTLED_STDS:g} % of its std in round {rounds}"
    return MotorFit(
        label=label,
        records=tuple(records),
        space=space,
        choices=tuple(choices),
        z=z,
        covariance=covariance,
        equations=tuple(equations),
        correlation_time=correlation_time,
        independent_times=independent_times,
        converged=settled,
        reason=reason if settled else f"{rounds} rounds without convergence",
        rounds=rounds,
    )


def _first(volts: BenchWindows | None, amps: BenchWindows, signed: bool) -> BenchMotor:
    """Estimate start values from each equation separately; defaults replace negative estimates."""
    usual = BenchMotor()
    r, c, drop, slow, one = float(usual.resistance), float(usual.back_emf), 0.0, 0.0, 0.0
    if volts is not None:
        found = start(volts, MOMENTS[0])
        r, c = (float(x) if x > 0 else y for x, y in zip(found, (r, c), strict=False))
        drop, slow, one = map(float, found[2:5])
    # With unsigned currents, the zero of the ammeter and friction have the same signal: the zero is
    # not estimated then.
    k = start(amps, MOMENTS[1] if signed else MOMENTS[1] - 1)
    torque = (usual.rotor_inertia, usual.coulomb_friction, usual.viscous_friction)
    j, tau, b = (float(x) * c if x > 0 else float(y) for x, y in zip(k, torque, strict=False))
    zero = float(k[3])
    return BenchMotor(
        # The order is that in which `BenchMotor` declares its parameters.
        *map(jnp.asarray, (r, c, slow, drop, tau, b, j, zero, one + r * zero))
    )


def _scaled(records: Sequence[BenchRecord], resistance: float) -> list[Choice]:
    """Return priors scaled to the motor.

    The stds of the meters' zeros are a tenth of the largest signals, and that of the inductance is
    `TIME_CONSTANT_STD_S` times the resistance.
    """
    amps = 0.1 * max(float(np.abs(r.amps).max()) for r in records)
    chosen = [Choice("motor.current_offset", prior_mean=0.0, prior_std=max(amps, 1e-6))]
    known = [r.voltage for r in records if r.voltage is not None]
    if known:
        volts = 0.1 * max(float(np.abs(u).max()) for u in known)
        chosen.append(Choice("motor.voltage_offset", prior_mean=0.0, prior_std=max(volts, 1e-6)))
    slow = TIME_CONSTANT_STD_S * resistance
    return [*chosen, Choice("motor.inductance", prior_mean=0.0, prior_std=slow)]


def _scatter(
    equations: Sequence[Equation],
) -> tuple[Float[np.ndarray, "moment moment"], float, float]:
    """Return the covariance S of all moments, and the correlation time of residuals [s].

    The third result is the number of independent times: the length of the records in units of twice
    the correlation time.
    """
    length = cell_length([e.windows for e in equations])
    parts = [celled(e.moments, e.windows, length) for e in equations]
    count = max(len(p) for p in parts)
    g = np.concatenate([np.pad(p, ((0, count - len(p)), (0, 0))) for p in parts], axis=1)
    residuals = [celled(e.weighted_residual[:, None], e.windows, length)[:, 0] for e in equations]
    lags = 2 * max(correlation_cells(x) for x in residuals) + 2
    groups = np.concatenate([grouped(e) for e in equations], axis=1)
    return widened(scatter(g, lags), groups), lags * length / 2, count / lags


def _solved(
    space: Space, z: np.ndarray, equations: Sequence[Equation], s: np.ndarray
) -> tuple[Float[np.ndarray, " free"], Float[np.ndarray, "free free"]]:
    """Return the optimum of the free parameters, and its covariance.

    The weights of the equations and the covariance S of all moments, `s`, are held fixed.
    """
    std = np.sqrt(np.maximum(np.diag(s), 1e-300))
    # S is singular for collinear signals, as in a log at one speed, hence the 1e-9
    root = np.linalg.inv(np.linalg.cholesky(s / std / std[:, None] + 1e-9 * np.eye(len(s)))) / std
    constant, slope, tangent = (
        tuple(jnp.asarray(getattr(e, name)) for e in equations)
        for name in ("constant", "slope", "tangent")
    )
    held = _Objective(space, jnp.asarray(root), constant, slope)
    found, of_tangents = _searched(jnp.asarray(z), held, replace(held, slope=tangent))
    jacobian = np.asarray(of_tangents)
    return np.asarray(found), np.linalg.inv(jacobian.T @ jacobian)


@eqx.filter_jit
def _searched(
    z: Float[Array, " free"], held: _Objective, tangents: _Objective
) -> tuple[Array, Array]:
    """Return the optimum of `held`, and the Jacobian there of the residuals of `tangents`."""
    solver = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)
    found = optx.least_squares(_residuals, solver, z, args=held, max_steps=200, throw=False)
    return found.value, jax.jacfwd(_residuals)(found.value, tangents)


def _residuals(z: Float[Array, " free"], held: _Objective) -> Float[Array, " residual"]:
    """Return S^-1/2 g and the residuals of the prior."""
    motor = held.space.tree(z).motor
    coefficients = (motor.volts(), motor.amps())[-len(held.slope) :]
    sums_of = zip(held.constant, held.slope, coefficients, strict=True)
    g = jnp.concatenate([constant - slope @ k for constant, slope, k in sums_of])
    prior = (z - held.space.prior_mean) / held.space.prior_std
    return jnp.concatenate([held.root @ g, prior])


FEWEST_WINDOWS = 30
"""Smallest number of windows of an equation for a fit."""
SURE_STDS = 5.0
"""A column is refused if a coefficient of wrong sign is larger than this in magnitude [std]."""
FASTEST_SHAFT = 3000.0
"""Shaft speed that brushed motors do not reach: a faster one shows a wrong unit [rad/s]."""
LARGEST_POWER = 2e4
"""Power U^2 / R at standstill above which the current is assumed to be in milliamperes [W]."""


def check_records(records: Sequence[BenchRecord], label: str, unit_known: bool = False) -> None:
    """Raise `DataError`, with a remedy, if records contradict the meaning of their columns.

    With `unit_known` the unit of the current is not checked.
    """
    where = records[0].name + (f", motor {label}" if label else "")
    speed = np.concatenate([r.speed for r in records])
    current = np.concatenate([r.amps for r in records])
    if float(np.abs(speed).max()) > FASTEST_SHAFT:
        _fail(
            where,
            f"the shaft turns at {np.abs(speed).max():.4g} rad/s",
            "its correct unit, perhaps rpm",
        )
    if float(np.ptp(speed)) < max(6 * noise([r.speed for r in records]), REST):
        found = f"the shaft does not turn (speeds within {np.ptp(speed):.3g} rad/s)"
        _fail(
            where, found, "a log in which the motor turns in both directions and at several speeds"
        )
    if np.ptp(current) == 0:
        _fail(where, f"the current is {current[0]:g} A in every row", "the motor's current")
    if all(r.signed for r in records):
        _signed(where, speed, current)
    amps, volts = mechanical(records), electrical(records, 0.0)
    if amps.usable.sum() < FEWEST_WINDOWS:
        found = f"the log has {amps.usable.sum()} short windows in which the shaft turns"
        _fail(where, found, f"at least {FEWEST_WINDOWS}: a longer log, or more rows per second")
    _signs(where, records, volts, amps)
    if volts is not None and not unit_known:
        _milliamperes(where, records, volts)


def _fail(where: str, found: str, expected: str) -> None:
    raise DataError(f"{where}: {found}; expected {expected}")


def _signed(where: str, speed: np.ndarray, current: np.ndarray) -> None:
    """Raise `DataError` if a current that is configured as signed consists of magnitudes."""
    back = speed < -0.2 * float(np.abs(speed).max())
    level = 0.1 * float(np.abs(current).max())
    negative = (current < -level).mean()
    driven = back.mean() > 0.05 and float(np.median(current[back])) > 0
    if driven and negative == 0 and current.min() > -level:
        found = "the current is never negative, though the shaft turns in both directions"
        _fail(
            where,
            found,
            "a signed current, or --unsigned (current_is_signed = false) for magnitudes",
        )


def _signs(
    where: str, records: Sequence[BenchRecord], volts: BenchWindows | None, amps: BenchWindows
) -> None:
    """Raise `DataError` for exchanged or reversed columns, shown by coefficients of wrong sign.

    Current increases with acceleration because of inertia, and voltage with speed because of
    back-EMF.
    """
    # Unsigned currents were given the sign of the speed, so their sign proves nothing.
    inertia = _sure(amps, 0) if all(r.signed for r in records) else 0.0
    if volts is None:
        if inertia < -SURE_STDS:
            found = "the shaft accelerates against its current"
            _fail(
                where,
                found,
                "current and speed with the same sign convention (reverse one of them: scale -1)",
            )
        return
    along = sum(float(np.sum(r.voltage * r.speed)) for r in records if r.voltage is not None)
    back, through = _sure(volts, 1), _sure(volts, 0)
    if inertia < -SURE_STDS:
        column = "current" if along > 0 else "speed"
        found = f"the {column} has the wrong sign: the shaft accelerates against its current"
        _fail(where, found, f"the {column} multiplied by -1")
    if along < 0 and back < -SURE_STDS:
        _fail(
            where,
            "the voltage has the wrong sign: it opposes the speed",
            "the voltage multiplied by -1",
        )
    if back < -SURE_STDS and through > 0:
        found = "the voltage falls with speed: voltage and current seem to be exchanged"
        _fail(where, found, "each of them in the column of the other")


def _sure(w: BenchWindows, column: int) -> float:
    """Return a coefficient divided by its std, estimated from one equation without priors."""
    signals = w.signals.shape[-1] - (w.signals.shape[-1] == len(VOLTS))
    found = start(w, signals)
    s = equation(w, found, signals)
    inverse = np.linalg.pinv(s.tangent[:, :signals], rcond=1e-10)
    std = np.sqrt(np.diag(inverse @ scatter(s.moments, 8) @ inverse.T))
    return float(found[column] / max(std[column], 1e-300))


def _milliamperes(where: str, records: Sequence[BenchRecord], volts: BenchWindows) -> None:
    found = start(volts, 5)
    highest = max(float(np.abs(r.voltage).max()) for r in records if r.voltage is not None)
    if 0 < found[0] < highest**2 / LARGEST_POWER and _sure(volts, 0) > SURE_STDS:
        heat = highest**2 / found[0] / 1e3
        _fail(
            where,
            f"a resistance of {found[0]:.2g} ohm at {highest:.3g} V, that is {heat:.0f} kW at "
            "standstill",
            "the unit of the current (I:mA for mA; if it is really A, I:A or a prior of "
            "motor.resistance)",
        )
