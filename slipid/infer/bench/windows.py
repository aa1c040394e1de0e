"""Short windows of a record, each with two sets of signals: from its even and from its odd rows.

No derivative of a noisy signal is taken. With a kernel c(t) over a window, of integral 1, each
equation is integrated, <x> = int c x dt and [x] = int c (dx/dt) dt. For signals that are straight
lines between rows both are sums over the rows l of the window, whatever the kernel:

    <x> = sum_l c_l (t_l+1 - t_l) (x_l + x_l+1) / 2        [x] = sum_l c_l (x_l+1 - x_l)

One sum goes over the even rows of a window, another over the odd rows. The sensor noises of both
sums are independent, so that the residual from even rows can be multiplied by the signals from odd
rows without bias, and vice versa (`slipid.infer.bench.moments`).

Windows with a gap in time are omitted, and so are windows with a jump of the voltage inside or
shortly before: the time of the jump between two rows is unknown, and the current is not a straight
line between rows there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.infer.bench.motor import BRUSH_CURRENT, REST, BenchRecord

ELECTRICAL_S, MECHANICAL_S = 3e-3, 1e-2
"""Half the length of a window of each equation, about a time constant of small motors [s]."""
LEAST_ROWS, ENOUGH_ROWS = 2, 8
"""Smallest and desired half length of a window [row].

A slope from odd rows needs at least `LEAST_ROWS`. Shorter half lengths than `ENOUGH_ROWS` are
extended to it, but not beyond that of the mechanical equation (`MECHANICAL_S`).
"""
MOST_WINDOWS = 20_000
"""Largest number of windows of one record."""
LONG_WINDOW_RATIO = 4
"""Ratio of the length of the longer windows, whose means give the signs of small currents, to the
length of windows."""
GAP_RATIO = 1.5
"""Ratio of a window's duration to its nominal one above which the window spans a gap in time."""
JUMP_STDS = 6.0
"""Step of the voltage between rows above which it counts as a jump [robust std of steps]."""
SETTLED_S, SETTLED_ROWS = 5e-3, 4
"""Time after a jump of the voltage until currents are straight lines between rows [s], [row].

The shorter of the two applies.
"""
BRAKING_STDS = 4.0
"""Deceleration of the shaft above which the motor may be braking [robust std of accelerations]."""


@dataclass(frozen=True, eq=False)
class BenchWindows:
    """Windows of one equation, one after the other.

    The axis `half` has two entries: signals from the even rows of each window, and from its odd
    rows.

    Attributes:
        signals: signals that the coefficients of the equation multiply, `VOLTS` or `AMPS`.
        measured: left side of the equation, the mean voltage [V] or current [A].
        speed: mean speed [rad/s].
        current: mean current [A].
        time: middle of each window, from the first row of its record [s].
        record: index of the record of each window.
        usable: False for windows in which the equation may not hold, as at rest.
    """

    signals: Float[np.ndarray, "half window column"]
    measured: Float[np.ndarray, "half window"]
    speed: Float[np.ndarray, "half window"]
    current: Float[np.ndarray, "half window"]
    time: Float[np.ndarray, " window"]
    record: Int[np.ndarray, " window"]
    usable: Bool[np.ndarray, " window"]


def electrical(records: Sequence[BenchRecord], zero: float) -> BenchWindows | None:
    """Return windows of the electrical equation [V], None without voltages.

    `zero` is the reading of the ammeter at zero current [A]; the signs of small currents are those
    of their readings less `zero`.
    """
    parts = []
    for k, r in enumerate(records):
        if r.voltage is None:
            return None
        at = _RecordWindows(r, ELECTRICAL_S)
        current, speed = at.mean(r.amps), at.mean(r.speed)
        along = np.ones_like(speed) if r.signed else np.sign(at.long_mean(r.speed))
        sign = np.tanh((at.long_mean(r.amps) - zero * along) / BRUSH_CURRENT)
        signals = current, speed, sign, at.slope(r.amps), np.ones_like(speed), along
        known = np.stack(signals, 2), at.mean(r.voltage), speed, current
        parts.append(BenchWindows(*known, *at.places(k), at.driven()))
    return _joined(parts)


def mechanical(records: Sequence[BenchRecord]) -> BenchWindows:
    """Return windows of the mechanical equation [A]; they are not usable at rest.

    The equation does not hold at rest, where friction may have any value up to that of motion.
    """
    parts = []
    for k, r in enumerate(records):
        at = _RecordWindows(r, MECHANICAL_S)
        rows = r.speed[at.middle[:, None] + np.arange(-at.half, at.half + 1)]
        usable = at.driven() & (np.abs(rows.mean(axis=1)) > 2 * REST)
        current, speed = at.mean(r.amps), at.mean(r.speed)
        along = 1.0 if r.signed else np.sign(rows.mean(axis=1))
        signals = (
            at.slope(r.speed),
            np.tanh(speed / REST),
            speed,
            np.broadcast_to(along, speed.shape),
        )
        parts.append(
            BenchWindows(np.stack(signals, 2), current, speed, current, *at.places(k), usable)
        )
    return _joined(parts)


class _RecordWindows:
    """Windows of a record, and means and slopes of its signals in them, from even and odd rows.

    Attributes:
        middle: index of the middle row of each window.
        half: half the length of a window [row].
        rows: indices of the even rows, then of the odd rows, of every window.
    """

    def __init__(self, r: BenchRecord, half_s: float):
        half_s = max(half_s, min(ENOUGH_ROWS * r.period, MECHANICAL_S))
        self.record, self.half = r, max(LEAST_ROWS, 2 * round(half_s / r.period / 2))
        half, last = self.half, len(r.time) - self.half
        middle = np.arange(half, last, max(half // 2, len(r.time) // MOST_WINDOWS, 1))
        span = r.time[middle + half] - r.time[middle - half]
        self.middle = middle[(span <= GAP_RATIO * 2 * half * r.period) & ~_jumps(r, half, middle)]
        self.rows = [self._rows(half, first) for first in (0, 1)]
        self._step = [np.diff(r.time[rows], axis=1) for rows in self.rows]
        self._kernel = [
            self._kernel_of(rows, step) for rows, step in zip(self.rows, self._step, strict=True)
        ]

    def _rows(self, half: int, first: int) -> Int[np.ndarray, "window some"]:
        """Return every second row of the windows: even ones for `first` 0, odd ones for 1."""
        return self.middle[:, None] + np.arange(first - half, half - first + 1, 2)

    def _kernel_of(
        self, rows: Int[np.ndarray, "window some"], step: Float[np.ndarray, "window interval"]
    ) -> Float[np.ndarray, "window interval"]:
        """Return the kernel c of every window, of integral 1, between its rows."""
        time = self.record.time[rows]
        about = (time[:, 1:] + time[:, :-1]) / 2 - self.record.time[self.middle][:, None]
        kernel = np.cos(0.5 * np.pi * about / (time[:, -1:] - time[:, :1])) ** 2
        return np.asarray(kernel / (kernel * step).sum(axis=1, keepdims=True))

    def mean(self, signal: Float[np.ndarray, " row"]) -> Float[np.ndarray, "half window"]:
        """Return the mean <x> of a signal in every window."""
        parts = zip(self._kernel, self._step, (signal[rows] for rows in self.rows), strict=True)
        return np.stack([(c * dt * (x[:, 1:] + x[:, :-1]) / 2).sum(axis=1) for c, dt, x in parts])

    def slope(self, signal: Float[np.ndarray, " row"]) -> Float[np.ndarray, "half window"]:
        """Return the mean slope [x] of a signal in every window."""
        parts = zip(self._kernel, self.rows, strict=True)
        return np.stack([(c * np.diff(signal[rows], axis=1)).sum(axis=1) for c, rows in parts])

    def long_mean(self, signal: Float[np.ndarray, " row"]) -> Float[np.ndarray, "half window"]:
        """Return means over longer windows around the same rows, for more reliable signs."""
        last = len(signal) - 1
        wide = [
            np.clip(self._rows(LONG_WINDOW_RATIO * self.half, first), first, last)
            for first in (0, 1)
        ]
        return np.stack([signal[rows].mean(axis=1) for rows in wide])

    def driven(self) -> Bool[np.ndarray, " window"]:
        """Return a mask of the windows in which unsigned currents have the right sign.

        Unsigned currents were given the sign of the speed, which is wrong if the motor brakes.
        """
        if self.record.signed:
            return np.ones(len(self.middle), bool)
        speed, slope = (of(self.record.speed).sum(axis=0) for of in (self.mean, self.slope))
        faster = slope * np.sign(speed)
        spread = 1.4826 * np.median(np.abs(faster)) if len(faster) else 0.0
        return np.asarray(faster > -BRAKING_STDS * spread)

    def places(
        self, number: int
    ) -> tuple[Float[np.ndarray, " window"], Int[np.ndarray, " window"]]:
        """Return the time of every window [s], and the record's index `number` once per window."""
        time = self.record.time
        return time[self.middle] - time[0], np.full(len(self.middle), number)


def _jumps(
    r: BenchRecord, half: int, middle: Int[np.ndarray, " window"]
) -> Bool[np.ndarray, " window"]:
    """Return a mask of the windows in which, or shortly before which, the voltage jumps."""
    if r.voltage is None:
        return np.zeros(len(middle), bool)
    step = np.diff(r.voltage)
    away = np.abs(step - np.median(step))
    # The second limit keeps small steps of a mostly constant voltage, whose median step is 0, from
    # counting as jumps.
    jump = away > JUMP_STDS * max(1.4826 * float(np.median(away)), 1e-3 * float(np.ptp(r.voltage)))
    rows = int(np.clip(round(SETTLED_S / r.period), 1, SETTLED_ROWS))
    count = np.concatenate([[0], np.cumsum(jump)])
    return np.asarray(count[middle + half] > count[np.maximum(middle - half - rows, 0)])


def _joined(parts: Sequence[BenchWindows]) -> BenchWindows:
    """Return the windows of several records, one after the other."""
    fields = zip(*(vars(part).values() for part in parts), strict=True)
    # The axis of windows is the first of a field, or the second if the axis `half` comes first.
    return BenchWindows(*(np.concatenate(x, axis=min(x[0].ndim, 2) - 1) for x in fields))
