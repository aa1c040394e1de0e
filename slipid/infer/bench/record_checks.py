"""Checks of a motor's logs before a fit: wrong units, signs and columns are refused."""

from collections.abc import Sequence

import numpy as np

from slipid.infer.bench.moments import equation, scatter, start
from slipid.infer.bench.motor import REST, VOLTS, BenchRecord, noise
from slipid.infer.bench.windows import BenchWindows, electrical, mechanical
from slipid.support.errors import DataError

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
    current = np.concatenate([r.current for r in records])
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
