"""Guesses of units that are not in column names, from plausible rates of logs and robot speeds."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.data.reading.layout import CHANNELS
from slipid.data.reading.units import factor

_SECONDS = (1e9, 4e9)
"""Plausible range of the time stamps of robots [s], counted from 1970."""
_CLOCKS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_STEPS = (2e-4, 2.5)
"""Plausible range of the time between rows of a log [s]."""
FAST = 12.0
"""Largest plausible speed of a robot [m/s]; a unit that implies a higher one is wrong."""
RADII = (0.012, 0.6)
"""Plausible range of wheel radii [m]."""
_TURNED, _NEAR_TURN = 0.5, 5.0
"""If the heading integrated from a turn rate has a range above `_TURNED` [rad], it decides the unit
of the logged heading, whose range may differ from it by a factor of at most `_NEAR_TURN` [1]."""


@dataclass(frozen=True)
class UnitGuess:
    """Guess of a unit.

    Attributes:
        unit: the unit.
        reason: reason for the unit, which becomes a comment in the config; empty if there is none.
        doubt: question to the user about the unit; empty if there is none.
    """

    unit: str
    reason: str = ""
    doubt: str = ""


def usual_step(time: Float[np.ndarray, " row"]) -> float:
    """Return the median time between rows, in the unit of `time`; 1 if time does not increase."""
    steps = np.diff(time)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0


def time_unit(values: Float[np.ndarray, " row"]) -> UnitGuess:
    """Return a guess of the unit of time: from stamps that count from 1970, else from the steps."""
    first = float(np.nanmin(np.abs(values)))
    for unit, per in _CLOCKS.items():
        if _SECONDS[0] < first / per < _SECONDS[1]:
            return UnitGuess(unit, f"counts from 1970, in {unit}")
    steps = np.abs(np.diff(values[~np.isnan(values)]))
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    fits = [unit for unit, per in _CLOCKS.items() if _STEPS[0] <= usual / per <= _STEPS[1]]
    if len(fits) == 1:
        return UnitGuess(fits[0], f"steps of {usual:.4g}")
    if not fits:
        return UnitGuess("s", doubt=f"in which unit are steps of {usual:.4g}?")
    if fits[0] == "s" and usual < 1.0 and (steps != np.round(steps)).any():
        return UnitGuess("s", f"steps of {usual:.4g}")
    return UnitGuess(fits[0], doubt=f"steps of {usual:.4g}: in {' or '.join(fits)}?")


def position_unit(
    time: Float[np.ndarray, " row"], x: Float[np.ndarray, " row"], y: Float[np.ndarray, " row"]
) -> UnitGuess:
    """Return a guess of the unit of positions x, y, from the speed that they imply.

    `time` is in seconds.
    """
    speed, size = speed_of(time, x, y), float(np.nanmax(np.abs([x, y])))
    if speed < FAST and size < 200:
        return UnitGuess("m", f"at most {speed:.2g} m/s")
    whole = x[~np.isnan(x)]
    if float(np.nanmin([x, y])) >= 0 and size < 4100 and (whole == np.round(whole)).all():
        return UnitGuess("mm", doubt="millimetres, or pixels (then give metres_per_pixel)?")
    if speed < 1e3 * FAST:
        return UnitGuess("mm", f"at most {speed:.4g} mm/s")
    return UnitGuess("m", doubt=f"in which unit? It moves by {speed:.3g} of them a second")


def speed_of(
    time: Float[np.ndarray, " row"], x: Float[np.ndarray, " row"], y: Float[np.ndarray, " row"]
) -> float:
    """Return the 90 % quantile of the speed [unit of x and y per s].

    Speeds are means over steps of about one second, so that noise averages out.
    """
    there = ~(np.isnan(x) | np.isnan(y) | np.isnan(time))
    time, x, y = time[there], x[there], y[there]
    if len(time) < 3:
        return 0.0
    stride = max(1, int(1.0 / max(float(np.median(np.diff(time))), 1e-6)))
    stride = min(stride, max(1, len(time) // 3))
    t, x, y = time[::stride], x[::stride], y[::stride]
    steps = np.diff(t)
    good = steps > 0
    speeds = np.hypot(np.diff(x), np.diff(y))[good] / steps[good]
    return float(np.quantile(speeds, 0.9)) if len(speeds) else 0.0


def heading_unit(values: Float[np.ndarray, " row"], turned: float = 0.0) -> UnitGuess:
    """Return a guess of the unit of a heading: from jumps by a full turn, else from its range.

    Args:
        values: headings as in the file.
        turned: range of the heading, integrated from a gyro or commands [rad]; 0 without them.
    """
    known = values[~np.isnan(values)]
    jump, most = float(np.abs(np.diff(known)).max(initial=0.0)), float(np.abs(known).max(initial=0))
    if 330 < jump <= 361:
        return UnitGuess("deg", "jumps by 360")
    if 5.8 < jump <= 6.2832 + 1e-3:
        return UnitGuess("rad", "jumps by 2 pi")
    if turned > _TURNED:
        times = float(np.ptp(known)) / turned
        for unit, expected in (("rad", 1.0), ("deg", 180.0 / np.pi)):
            if expected / _NEAR_TURN < times < expected * _NEAR_TURN:
                return UnitGuess(unit, f"range is {times:.2g} times that by the turn rate")
    if most <= 6.2832 + 1e-3:
        doubt = "radians or degrees? It never turns far" if most < 0.5 else ""
        return UnitGuess("rad", f"up to {most:.3g}", doubt)
    if most <= 361 and most > 50:
        return UnitGuess("deg", f"up to {most:.3g}")
    return UnitGuess(
        "rad" if most < 30 else "deg", doubt=f"radians or degrees? It reaches {most:.4g}"
    )


def speed_unit(ratio: float | None, radius: float | None) -> UnitGuess:
    """Return a guess of the unit of wheel speeds, from the speed of the pose.

    Args:
        ratio: speed of the pose [m/s] over that of the wheels [unit of the file], times the gear
            ratio for motor speeds; None if unknown.
        radius: wheel radius [m], or None if it is unknown.
    """
    options = "rad/s, rpm or deg/s; or m/s at the rim"
    if ratio is None:
        return UnitGuess("rad/s", doubt=f"in which unit: {options}?")
    if radius is not None:
        units = {unit: ratio / factor(unit, "rad/s") for unit in ("rad/s", "rpm", "deg/s", "rev/s")}
        best = min(units, key=lambda unit: abs(np.log(units[unit] / radius)))
        apart = abs(np.log(units[best] / radius))
        if apart < 0.7 and apart < abs(np.log(ratio)):
            return UnitGuess(best, "as fast as the pose")
    elif RADII[0] <= ratio <= RADII[1]:
        return UnitGuess("rad/s", f"as fast as the pose with wheels of about {ratio:.2g} m")
    if 0.7 < ratio < 1.5:
        return UnitGuess("m/s", doubt="as fast as the pose itself: is it m/s at the rim?")
    if RADII[0] <= ratio / factor("rpm", "rad/s") <= RADII[1]:
        return UnitGuess("rpm", doubt="rpm, or deg/s? With rad/s wheels would be too small")
    return UnitGuess("rad/s", doubt=f"in which unit: {options}?")


def angle_unit(ratio: float | None, radius: float | None) -> UnitGuess:
    """Return a guess of the unit of wheel angles; the arguments are those of `speed_unit`."""
    if ratio is None:
        return UnitGuess("rad", doubt="radians, degrees, turns or ticks?")
    low, high = RADII if radius is None else (radius / 2, radius * 2)
    for unit in ("rad", "deg", "rev"):
        if low <= ratio / factor(unit, "rad") <= high:
            return UnitGuess(unit, "turns as far as the pose goes")
    return UnitGuess("rad", doubt="radians, degrees, turns or ticks? None agrees with the pose")


def usual_unit(channel: str) -> UnitGuess:
    """Return the unit of a channel that is almost always logged in SI units (or ticks)."""
    return UnitGuess({"wheel_ticks": "tick"}.get(channel, CHANNELS[channel]))


def current_unit(most: float) -> UnitGuess:
    """Return a guess of the unit of currents, from their largest magnitude."""
    if most > 120:
        return UnitGuess("mA", f"up to {most:.4g}")
    return UnitGuess("A", f"up to {most:.3g}")


def duty_unit(values: Float[np.ndarray, "row column"]) -> UnitGuess:
    """Return a guess of the unit of duty cycles, from their size.

    Whole numbers may be percent or the counts of a timer, such as 0 to 255, which is asked.
    """
    known = values[~np.isnan(values)]
    most = float(np.abs(known).max(initial=0.0))
    if 1.05 < most < 256 and most != 100 and (known == np.round(known)).all():
        ask = (
            f"whole numbers up to {most:g}: counts of 0 to 255 (then scale = {1 / 255:.6f}), or "
            'percent (then unit = "percent")?'
        )
        return UnitGuess("1", doubt=ask)
    if most <= 1.05:
        return UnitGuess("1", f"up to {most:.3g}")
    if most <= 105:
        return UnitGuess("percent", f"up to {most:.3g}")
    return UnitGuess("1", doubt=f"it reaches {most:.4g}: give scale = 1 / value at full duty")
