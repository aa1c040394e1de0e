"""Check of a motor's records before a fit: wrong units, signs and columns are refused.

Signs are those of coefficients of two least squares over means of short blocks of rows,

    U = R I + C_e w + U_0        I = (J dw/dt + tau_c sign(w) + b w) / C_e + I_0
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from slipid.infer.bench.motor import BenchRecord, noise
from slipid.support.errors import DataError

REST = 2.5
"""Shaft speed below which the shaft may rest [rad/s]."""
BLOCK_S, BLOCK_ROWS = 1e-2, 4
"""Duration of a block, and its smallest number of rows [s], [row]."""
FEWEST_BLOCKS = 30
"""Smallest number of blocks in which the shaft turns, for a fit."""
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
    if float(np.abs(speed).max()) > FASTEST_SHAFT:
        found = f"the shaft turns at {np.abs(speed).max():.4g} rad/s"
        _fail(where, found, "its correct unit, perhaps rpm")
    if float(np.ptp(speed)) < max(6 * noise([r.speed for r in records]), REST):
        found = f"the shaft does not turn (speeds within {np.ptp(speed):.3g} rad/s)"
        expected = "a log in which the motor turns in both directions and at several speeds"
        _fail(where, found, expected)
    blocks = _blocks_of(records)
    if blocks.turning.sum() < FEWEST_BLOCKS:
        found = f"the shaft turns in {blocks.turning.sum()} short blocks of the log"
        _fail(where, found, f"at least {FEWEST_BLOCKS}: a longer log, or more rows per second")
    amps = [r.current for r in records if r.current is not None]
    if not amps:
        return
    current = np.concatenate(amps)
    if np.ptp(current) == 0:
        _fail(where, f"the current is {current[0]:g} A in every row", "the motor's current")
    if all(r.signed for r in records):
        _signed(where, speed, current)
    _signs(where, blocks, signed=all(r.signed for r in records))
    if blocks.voltage is not None and not unit_known:
        _milliamperes(where, blocks)


def _fail(where: str, found: str, expected: str) -> None:
    raise DataError(f"{where}: {found}; expected {expected}")


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Means over blocks of rows of all records.

    Attributes:
        voltage: voltage, None if it was not logged [V].
        current: current, 0 if it was not logged [A].
        speed: shaft speed [rad/s].
        slope: acceleration [rad/s^2].
        turning: True where the shaft turns.
    """

    voltage: Float[np.ndarray, " block"] | None
    current: Float[np.ndarray, " block"]
    speed: Float[np.ndarray, " block"]
    slope: Float[np.ndarray, " block"]
    turning: Bool[np.ndarray, " block"]


def _blocks_of(records: Sequence[BenchRecord]) -> _Blocks:
    parts = []
    for r in records:
        size = max(BLOCK_ROWS, round(BLOCK_S / r.period))
        count = max(len(r.time) // size, 1)

        def mean(x: np.ndarray | None, size: int = size, count: int = count) -> np.ndarray:
            whole = np.zeros(count * size) if x is None else x[: count * size]
            return whole.reshape(count, -1).mean(axis=1)

        time, speed = mean(r.time), mean(r.speed)
        slope = np.gradient(speed, time) if count > 2 else np.zeros(count)
        parts.append(np.stack([mean(r.voltage), mean(r.current), speed, slope]))
    voltage, current, speed, slope = np.concatenate(parts, axis=1)
    has_voltage = all(r.voltage is not None for r in records)
    turning = np.abs(speed) > 2 * REST
    return _Blocks(voltage if has_voltage else None, current, speed, slope, turning)


def _signed(where: str, speed: np.ndarray, current: np.ndarray) -> None:
    """Raise `DataError` if a current that is configured as signed consists of magnitudes."""
    back = speed < -0.2 * float(np.abs(speed).max())
    level = 0.1 * float(np.abs(current).max())
    negative = (current < -level).mean()
    driven = back.mean() > 0.05 and float(np.median(current[back])) > 0
    if driven and negative == 0 and current.min() > -level:
        found = "the current is never negative, though the shaft turns in both directions"
        expected = "a signed current, or --unsigned (current_is_signed = false) for magnitudes"
        _fail(where, found, expected)


def _signs(where: str, b: _Blocks, signed: bool) -> None:
    """Raise `DataError` for exchanged or reversed columns, shown by coefficients of wrong sign.

    Current increases with acceleration because of inertia, and voltage with speed because of
    back-EMF.
    """
    some = b.turning
    one, w = np.ones(int(some.sum())), b.speed[some]
    # Unsigned currents were given the sign of the speed, so their sign proves nothing.
    inertia = _coefficient([b.slope[some], np.sign(w), w, one], b.current[some])[1] if signed else 0
    if b.voltage is None:
        if inertia < -SURE_STDS:
            found = "the shaft accelerates against its current"
            expected = "current and speed with the same sign convention (reverse one: scale -1)"
            _fail(where, found, expected)
        return
    along = float(np.sum(b.voltage * b.speed))
    one = np.ones(len(b.speed))
    back = _coefficient([b.speed, b.current, one], b.voltage)[1]
    through = _coefficient([b.current, b.speed, one], b.voltage)[1]
    if inertia < -SURE_STDS:
        column = "current" if along > 0 else "speed"
        found = f"the {column} has the wrong sign: the shaft accelerates against its current"
        _fail(where, found, f"the {column} multiplied by -1")
    if along < 0 and back < -SURE_STDS:
        found = "the voltage has the wrong sign: it opposes the speed"
        _fail(where, found, "the voltage multiplied by -1")
    if back < -SURE_STDS and through > 0:
        found = "the voltage falls with speed: voltage and current seem to be exchanged"
        _fail(where, found, "each of them in the column of the other")


def _coefficient(
    columns: Sequence[Float[np.ndarray, " block"]], right: Float[np.ndarray, " block"]
) -> tuple[float, float]:
    """Return the coefficient of the first column in a least squares, and its size [std]."""
    table = np.stack(columns, 1)
    found, *_ = np.linalg.lstsq(table, right, rcond=1e-10)
    scatter = float(np.mean((right - table @ found) ** 2))
    variance = float(np.linalg.pinv(table.T @ table, rcond=1e-12)[0, 0]) * scatter
    return float(found[0]), float(found[0]) / max(float(np.sqrt(variance)), 1e-300)


def _milliamperes(where: str, b: _Blocks) -> None:
    if b.voltage is None:
        return
    found, stds = _coefficient([b.current, b.speed, np.ones(len(b.speed))], b.voltage)
    highest = float(np.abs(b.voltage).max())
    if 0 < found < highest**2 / LARGEST_POWER and stds > SURE_STDS:
        heat = highest**2 / found / 1e3
        _fail(
            where,
            f"a resistance of {found:.2g} ohm at {highest:.3g} V, that is {heat:.0f} kW at "
            "standstill",
            "the unit of the current (I:mA for mA; if it is really A, I:A or a prior of "
            "motor.resistance)",
        )
