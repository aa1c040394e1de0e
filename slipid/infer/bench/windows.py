"""Short windows of a record, each with two sets of signals: from its even and from its odd rows.

No derivative of a noisy signal is taken. With a kernel c(t) over a window, of integral 1, each
equation is integrated, <x> = int c x dt and [x] = int c (dx/dt) dt. For signals that are straight
lines between rows both are sums over the rows l of the window, whatever the kernel:

    <x> = sum_l c_l (t_l+1 - t_l) (x_l + x_l+1) / 2        [x] = sum_l c_l (x_l+1 - x_l)

One sum goes over the even rows of a window, another over the odd ones. Their sensor noises are
independent, so that the residual of one can be multiplied by the signals of the other without bias
(`slipid.infer.bench.moments`).

Windows with a gap in time are left out, as are those with a jump of the voltage inside or shortly
before them: the time of the jump between two rows is unknown, and the current is not a straight
line there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.infer.bench.motor import BRUSH_CURRENT, REST, BenchRecord

ELECTRICAL_S, MECHANICAL_S = 3e-3, 1e-2
"""Half the length of a window of each equation, about a time constant of small motors [s]."""
LEAST, ENOUGH = 2, 8
"""Smallest and desired half length of a window [row].

The smallest one is needed for a slope from odd rows. Windows with fewer than the desired number of
rows are lengthened to it, but not beyond those of the mechanical equation (`MECHANICAL_S`).
"""
MOST = 20_000
"""Largest number of windows of one record."""
WIDE = 4
"""Ratio of the longer window, whose mean gives the sign of a small current, to a window."""
STRAY = 1.5
"""Ratio of a window's duration to its nominal one above which it spans a gap between rows."""
JUMP = 6.0
"""Step of the voltage between rows above which it counts as a jump [robust std of steps]."""
SETTLED_S, SETTLED_ROWS = 5e-3, 4
"""Time after a jump of the voltage until currents are straight lines between rows [s], [row].

The shorter of the two applies.
"""
BRAKES = 4.0
"""Deceleration of the shaft above which the motor may be braking [robust std of accelerations]."""


@dataclass(frozen=True, eq=False)
class HalfSignals:
    """Signals of every window from its even, or from its odd, rows.

    Attributes:
        signals: signals that the coefficients of the equation multiply, `VOLTS` or `AMPS`.
        measured: left side of the equation, the mean voltage [V] or current [A].
        speed: mean speed [rad/s].
        current: mean current [A].
    """

    signals: Float[np.ndarray, "window column"]
    measured: Float[np.ndarray, " window"]
    speed: Float[np.ndarray, " window"]
    current: Float[np.ndarray, " window"]


@dataclass(frozen=True, eq=False)
class BenchWindows:
    """Windows of one equation, one after the other.

    Attributes:
        even: signals from even rows.
        odd: signals from odd rows.
        time: middle of each window, from the first row of its record [s].
        record: index of the record of each window.
        usable: False for windows in which the equation may not hold, as at rest.
    """

    even: HalfSignals
    odd: HalfSignals
    time: Float[np.ndarray, " window"]
    record: Int[np.ndarray, " window"]
    usable: Bool[np.ndarray, " window"]

    @property
    def both(self) -> HalfSignals:
        """Means of the signals from even and from odd rows."""
        pairs = zip(vars(self.even).values(), vars(self.odd).values(), strict=True)
        return HalfSignals(*((a + b) / 2 for a, b in pairs))


def electrical(records: Sequence[BenchRecord], zero: float) -> BenchWindows | None:
    """Return windows of the electrical equation [V], None without voltages.

    `zero` is the reading of the ammeter at zero current [A], from which small currents get their
    signs.
    """
    parts = []
    for k, r in enumerate(records):
        if (voltage := r.voltage) is None:
            return None
        at = _WindowPlaces(r, ELECTRICAL_S)

        def half(
            kernel: "_HalfKernel", r: BenchRecord = r, voltage: np.ndarray = voltage
        ) -> HalfSignals:
            current, speed = kernel.mean(r.current), kernel.mean(r.speed)
            along = np.ones(len(speed)) if r.signed else np.sign(kernel.long_mean(r.speed))
            sign = np.tanh((kernel.long_mean(r.current) - zero * along) / BRUSH_CURRENT)
            known = current, speed, sign, kernel.slope(r.current), np.ones(len(sign)), along
            return HalfSignals(np.stack(known, 1), kernel.mean(voltage), speed, current)

        parts.append(_cut(r, k, at, half))
    return _joined(parts)


def mechanical(records: Sequence[BenchRecord]) -> BenchWindows:
    """Return windows of the mechanical equation [A]; they are not usable at rest.

    At rest the friction may have any value up to that of motion.
    """
    parts = []
    for k, r in enumerate(records):
        at = _WindowPlaces(r, MECHANICAL_S)
        rows = r.speed[at.middle[:, None] + np.arange(-at.half, at.half + 1)]
        moving = np.abs(rows.mean(axis=1)) > 2 * REST
        along = np.ones(len(rows)) if r.signed else np.sign(rows.mean(axis=1))

        def half(
            kernel: "_HalfKernel", r: BenchRecord = r, along: np.ndarray = along
        ) -> HalfSignals:
            current, speed = kernel.mean(r.current), kernel.mean(r.speed)
            known = kernel.slope(r.speed), np.tanh(speed / REST), speed, along
            return HalfSignals(np.stack(known, 1), current, speed, current)

        parts.append(_cut(r, k, at, half, moving))
    return _joined(parts)


class _WindowPlaces:
    """Positions of the windows of a record: `middle` row of each, and `half` their length [row]."""

    def __init__(self, r: BenchRecord, half_s: float):
        half_s = max(half_s, min(ENOUGH * r.period, MECHANICAL_S))
        self.half = half = max(LEAST, 2 * round(half_s / r.period / 2))
        last = len(r.time) - half
        middle = np.arange(half, last, max(half // 2, len(r.time) // MOST, 1))
        span = r.time[middle + half] - r.time[middle - half]
        self.middle = middle[(span <= STRAY * 2 * half * r.period) & ~_jumps(r, half, middle)]


class _HalfKernel:
    """Kernel c over every second row of the windows: even rows for `first` 0, odd ones for 1."""

    def __init__(self, r: BenchRecord, at: _WindowPlaces, first: int):
        self.rows = at.middle[:, None] + np.arange(first - at.half, at.half - first + 1, 2)
        reach = WIDE * at.half
        wide = at.middle[:, None] + np.arange(first - reach, reach - first + 1, 2)
        self.wide = np.clip(wide, first, len(r.time) - 1)
        time = r.time[self.rows]
        middle = (time[:, 1:] + time[:, :-1]) / 2 - r.time[at.middle][:, None]
        kernel = np.cos(0.5 * np.pi * middle / (time[:, -1:] - time[:, :1])) ** 2
        self.step = np.diff(time, axis=1)
        self.kernel = kernel / (kernel * self.step).sum(axis=1, keepdims=True)

    def mean(self, signal: Float[np.ndarray, " row"]) -> Float[np.ndarray, " window"]:
        x = signal[self.rows]
        return np.asarray((self.kernel * self.step * (x[:, 1:] + x[:, :-1]) / 2).sum(axis=1))

    def long_mean(self, signal: Float[np.ndarray, " row"]) -> Float[np.ndarray, " window"]:
        """Return the mean over a longer window of the same rows, whose sign is more reliable."""
        return np.asarray(signal[self.wide].mean(axis=1))

    def slope(self, signal: Float[np.ndarray, " row"]) -> Float[np.ndarray, " window"]:
        return np.asarray((self.kernel * np.diff(signal[self.rows], axis=1)).sum(axis=1))


def _cut(
    r: BenchRecord,
    number: int,
    at: _WindowPlaces,
    half: Callable[[_HalfKernel], HalfSignals],
    usable: Bool[np.ndarray, " window"] | None = None,
) -> BenchWindows:
    """Return the windows of one record.

    Args:
        r: the record.
        number: index of the record.
        at: positions of the windows.
        half: function that returns the signals of the windows by one kernel.
        usable: False for windows in which the equation may not hold, all True by default.
    """
    even, odd = halves = _HalfKernel(r, at, 0), _HalfKernel(r, at, 1)
    usable = np.ones(len(at.middle), bool) if usable is None else usable
    if not r.signed:
        # unsigned currents were given the sign of the speed, which is wrong if the motor brakes
        speed, slope = (sum(getattr(h, k)(r.speed) for h in halves) for k in ("mean", "slope"))
        faster = slope * np.sign(speed)
        spread = 1.4826 * np.median(np.abs(faster)) if len(faster) else 0.0
        usable = usable & (faster > -BRAKES * spread)
    time, count = r.time[at.middle] - r.time[0], np.full(len(at.middle), number)
    return BenchWindows(half(even), half(odd), time, count, usable)


def _jumps(
    r: BenchRecord, half: int, middle: Int[np.ndarray, " window"]
) -> Bool[np.ndarray, " window"]:
    """Return a mask of the windows in which, or shortly before which, the voltage jumps."""
    if r.voltage is None:
        return np.zeros(len(middle), bool)
    step = np.diff(r.voltage)
    away = np.abs(step - np.median(step))
    # a mostly constant signal has median 0; steps below a thousandth of its range are no jumps
    jump = away > JUMP * max(1.4826 * float(np.median(away)), 1e-3 * float(np.ptp(r.voltage)))
    rows = int(np.clip(round(SETTLED_S / r.period), 1, SETTLED_ROWS))
    count = np.concatenate([[0], np.cumsum(jump)])
    return np.asarray(count[middle + half] > count[np.maximum(middle - half - rows, 0)])


def _joined(parts: Sequence[BenchWindows]) -> BenchWindows:
    """Return the windows of several records, one after the other."""

    def halves(found: Sequence[HalfSignals]) -> HalfSignals:
        return HalfSignals(
            *map(np.concatenate, zip(*(vars(h).values() for h in found), strict=True))
        )

    rest = ([getattr(p, name) for p in parts] for name in ("time", "record", "usable"))
    even, odd = halves([p.even for p in parts]), halves([p.odd for p in parts])
    return BenchWindows(even, odd, *map(np.concatenate, rest))
