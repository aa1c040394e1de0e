"""Short windows of a record, each of which is measured twice.

No derivative of a noisy signal is taken. With a kernel c(t) over a window, of integral 1, each
equation is integrated, <x> = int c x dt and [x] = int c (dx/dt) dt. For signals that are straight
lines between rows both are sums over the rows l of the window, whatever the kernel:

    <x> = sum_l c_l (t_l+1 - t_l) (x_l + x_l+1) / 2        [x] = sum_l c_l (x_l+1 - x_l)

One sum goes over the even rows of a window, another over the odd ones. Their sensor noises are
independent, so that a residual of one can be asked whether it goes with the signals of the other.

Left out are windows in which time jumps, those in which the voltage jumps, with some rows after it:
nobody knows when it did between two rows, and the current was not a straight line there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.infer.bench.motor import BRUSH_CURRENT, REST, BenchRecord

ELECTRICAL_S, MECHANICAL_S = 3e-3, 1e-2
"""Half the length of a window, about a time constant of small motors: transients are seen [s]."""
LEAST, ENOUGH = 2, 8
"""Half the length in rows: at least, for the odd rows to show a slope; and where it is not all
noise, for which no window is made longer than a mechanical one."""
MOST = 20_000
"""Windows of one record, at most."""
WIDE = 4
"""Length of the stretch that tells the sign of a small current, over a window."""
STRAY = 1.5
"""Times the usual length, above which a window spans a gap between rows."""
JUMP = 6.0
"""Robust stds of the voltage's steps from which one is a jump."""
SETTLED_S, SETTLED_ROWS = 5e-3, 4
"""After a jump of the voltage currents follow a straight line between rows again [s], [rows];
the shorter of both."""
BRAKES = 4.0
"""Robust stds of the slope of the speed from which a motor may be braking."""


@dataclass(frozen=True, eq=False)
class HalfSignals:
    """What the even, or the odd, rows say of every window: signals of an equation, and its left.

    With the means of speed [rad/s] and current [A].
    """

    signals: Float[np.ndarray, "window column"]
    left: Float[np.ndarray, " window"]
    speed: Float[np.ndarray, " window"]
    current: Float[np.ndarray, " window"]


@dataclass(frozen=True, eq=False)
class BenchWindows:
    """Windows of one equation, one after the other.

    Attributes:
        even, odd: what both halves of the rows say.
        time: middle of each [s], from the first row of its record.
        record: number of the record that it is of.
        usable: False where the equation does not hold, at rest, or may not.
    """

    even: HalfSignals
    odd: HalfSignals
    time: Float[np.ndarray, " window"]
    record: Int[np.ndarray, " window"]
    usable: Bool[np.ndarray, " window"]

    @property
    def both(self) -> HalfSignals:
        """Means of the two halves."""
        pairs = zip(vars(self.even).values(), vars(self.odd).values(), strict=True)
        return HalfSignals(*((a + b) / 2 for a, b in pairs))


def electrical(records: Sequence[BenchRecord], zero: float) -> BenchWindows | None:
    """Windows of the electrical equation [V], None without voltages.

    `zero` is what the ammeter shows without a current, for the signs of small ones [A].
    """
    parts = []
    for k, r in enumerate(records):
        if (measured := r.voltage) is None:
            return None
        at = _WindowPlaces(r, ELECTRICAL_S)

        def half(
            row: "_HalfKernel", r: BenchRecord = r, measured: np.ndarray = measured
        ) -> HalfSignals:
            current, speed = row.mean(r.current), row.mean(r.speed)
            along = np.ones(len(speed)) if r.signed else np.sign(row.longer(r.speed))
            sign = np.tanh((row.longer(r.current) - zero * along) / BRUSH_CURRENT)
            known = current, speed, sign, row.slope(r.current), np.ones(len(sign)), along
            return HalfSignals(np.stack(known, 1), row.mean(measured), speed, current)

        parts.append(_cut(r, k, at, half))
    return _joined(parts)


def mechanical(records: Sequence[BenchRecord]) -> BenchWindows:
    """Windows of the mechanical equation [A]; at rest friction is a reaction, and unknown."""
    parts = []
    for k, r in enumerate(records):
        at = _WindowPlaces(r, MECHANICAL_S)
        rows = r.speed[at.middle[:, None] + np.arange(-at.half, at.half + 1)]
        moving = np.abs(rows.mean(axis=1)) > 2 * REST
        along = np.ones(len(rows)) if r.signed else np.sign(rows.mean(axis=1))

        def half(row: "_HalfKernel", r: BenchRecord = r, along: np.ndarray = along) -> HalfSignals:
            current, speed = row.mean(r.current), row.mean(r.speed)
            known = row.slope(r.speed), np.tanh(speed / REST), speed, along
            return HalfSignals(np.stack(known, 1), current, speed, current)

        parts.append(_cut(r, k, at, half, moving))
    return _joined(parts)


class _WindowPlaces:
    """Where windows of a record are: middles [row] and half the length [rows]."""

    def __init__(self, r: BenchRecord, half_s: float):
        half_s = max(half_s, min(ENOUGH * r.period, MECHANICAL_S))
        self.half = half = max(LEAST, 2 * round(half_s / r.period / 2))
        last = len(r.time) - half
        middle = np.arange(half, last, max(half // 2, len(r.time) // MOST, 1))
        span = r.time[middle + half] - r.time[middle - half]
        self.middle = middle[(span <= STRAY * 2 * half * r.period) & ~_jumps(r, half, middle)]


class _HalfKernel:
    """Kernel of every second row of the windows, which begins `first` rows inside them."""

    def __init__(self, r: BenchRecord, at: _WindowPlaces, first: int):
        self.at = at.middle[:, None] + np.arange(first - at.half, at.half - first + 1, 2)
        reach = WIDE * at.half
        wide = at.middle[:, None] + np.arange(first - reach, reach - first + 1, 2)
        self.wide = np.clip(wide, first, len(r.time) - 1)
        time = r.time[self.at]
        middle = (time[:, 1:] + time[:, :-1]) / 2 - r.time[at.middle][:, None]
        kernel = np.cos(0.5 * np.pi * middle / (time[:, -1:] - time[:, :1])) ** 2
        self.step = np.diff(time, axis=1)
        self.kernel = kernel / (kernel * self.step).sum(axis=1, keepdims=True)

    def mean(self, signal: Float[np.ndarray, " row"]) -> Float[np.ndarray, " window"]:
        x = signal[self.at]
        return np.asarray((self.kernel * self.step * (x[:, 1:] + x[:, :-1]) / 2).sum(axis=1))

    def longer(self, signal: Float[np.ndarray, " row"]) -> Float[np.ndarray, " window"]:
        """Mean over a longer stretch of the same half of the rows, which tells a sign."""
        return np.asarray(signal[self.wide].mean(axis=1))

    def slope(self, signal: Float[np.ndarray, " row"]) -> Float[np.ndarray, " window"]:
        return np.asarray((self.kernel * np.diff(signal[self.at], axis=1)).sum(axis=1))


def _cut(
    r: BenchRecord,
    number: int,
    at: _WindowPlaces,
    half: Callable[[_HalfKernel], HalfSignals],
    usable: Bool[np.ndarray, " window"] | None = None,
) -> BenchWindows:
    """Windows of one record."""
    even, odd = halves = _HalfKernel(r, at, 0), _HalfKernel(r, at, 1)
    usable = np.ones(len(at.middle), bool) if usable is None else usable
    if not r.signed:
        # a magnitude was given the sign of the speed: wrong where the motor brakes
        speed, slope = (sum(getattr(h, k)(r.speed) for h in halves) for k in ("mean", "slope"))
        faster = slope * np.sign(speed)
        spread = 1.4826 * np.median(np.abs(faster)) if len(faster) else 0.0
        usable = usable & (faster > -BRAKES * spread)
    time, count = r.time[at.middle] - r.time[0], np.full(len(at.middle), number)
    return BenchWindows(half(even), half(odd), time, count, usable)


def _jumps(
    r: BenchRecord, half: int, middle: Int[np.ndarray, " window"]
) -> Bool[np.ndarray, " window"]:
    """Windows in which, or shortly before which, the voltage jumps between two rows."""
    if r.voltage is None:
        return np.zeros(len(middle), bool)
    step = np.diff(r.voltage)
    away = np.abs(step - np.median(step))
    # of a signal that mostly stands still the median is 0: a thousandth of its range is no jump
    jump = away > JUMP * max(1.4826 * float(np.median(away)), 1e-3 * float(np.ptp(r.voltage)))
    rows = int(np.clip(round(SETTLED_S / r.period), 1, SETTLED_ROWS))
    count = np.concatenate([[0], np.cumsum(jump)])
    return np.asarray(count[middle + half] > count[np.maximum(middle - half - rows, 0)])


def _joined(parts: Sequence[BenchWindows]) -> BenchWindows:
    """Windows of several records, one after the other."""

    def halves(found: Sequence[HalfSignals]) -> HalfSignals:
        return HalfSignals(
            *map(np.concatenate, zip(*(vars(h).values() for h in found), strict=True))
        )

    rest = ([getattr(p, name) for p in parts] for name in ("time", "record", "usable"))
    even, odd = halves([p.even for p in parts]), halves([p.odd for p in parts])
    return BenchWindows(even, odd, *map(np.concatenate, rest))
