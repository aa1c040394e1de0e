"""The indicators of slip come from smoothed signals and from what these are where nothing slips.

Signals of a run are smoothed in every step. Limits are quantiles of the signals of training steps
without slip, and indicators are signals over their limits. The formulas stand at the top of
`method.py`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from slipid.identify.compare.slip_model import WINDOW_S, Heard, Machine, Numbers, Run, groups

SLIPS = 0.2
"""Slip from which on a window counts as slipping, as a share of what the encoders say."""
_REST = 0.01
"""Rim speed below which a robot stands [m/s]."""
_DRIVING = 0.3
"""Share of the fastest rim speed from which on a wheel counts as driving."""


@dataclass(frozen=True, eq=False)
class Signals:
    """What the indicators are made of, smoothed, in every step of a run.

    Attributes:
        deviation: largest deviation of a wheel from its reference, relative.
        change: largest acceleration of a wheel [rad/s^2].
        turning: of the yaw rate by the encoders from the gyro's [rad/s], or None.
        amps: smallest current of the wheels that drive [A].
        moving: whether the wheels turn.
    """

    deviation: Numbers
    change: Numbers
    turning: Numbers | None
    amps: Numbers
    moving: Bool[np.ndarray, " step"]

    @classmethod
    def of(cls, heard: Heard, machine: Machine, seconds: float) -> "Signals":
        """Of a run, smoothed over so long."""
        mean = smoothing(heard.dt, seconds)
        speed, amps = mean @ heard.speed, mean @ heard.along(machine)
        rim = machine.wheel_radius * speed
        fastest = np.abs(rim).max(axis=1, keepdims=True)
        drives = np.abs(rim) >= _DRIVING * fastest
        turning = None
        if heard.gyro is not None:
            turning = np.abs(mean @ (heard.rolling(machine)[:, 2] - heard.gyro))
        change = np.diff(speed, axis=0, prepend=speed[:1]) / heard.dt[:, None]
        return cls(
            deviation=_deviation(rim, mean, heard, machine),
            change=np.abs(change).max(axis=1),
            turning=turning,
            amps=np.where(drives, amps, np.inf).min(axis=1),
            moving=fastest[:, 0] > _REST,
        )


@dataclass(frozen=True)
class Limits:
    """What signals are without slip.

    Attributes:
        change: a_max, acceleration of a wheel [rad/s^2].
        turning: g_th, of the yaw rate by the encoders from the gyro's [rad/s].
        usual, highest: I_lo and I_hi, smallest current of the driving wheels [A].
    """

    change: float = 1.0
    turning: float = 1.0
    usual: float = 0.0
    highest: float = 1.0

    @classmethod
    def of(cls, examples: "Sequence[Example]", quantile: float) -> "Limits":
        """By quantiles of the steps that do not slip."""
        signals = [example.signals for example in examples]
        slips = np.concatenate([example.slips for example in examples])

        def limit(signal: np.ndarray, at: float) -> float:
            firm = signal[slips == 0.0]
            return float(np.quantile(firm, at) if len(firm) else signal.min())

        amps = np.concatenate([one.amps for one in signals])
        usual = limit(amps, 0.5)
        with_gyro = [one.turning for one in signals if one.turning is not None]
        turning = np.inf
        if len(with_gyro) == len(signals):
            turning = max(limit(np.concatenate(with_gyro), quantile), 1e-3)
        return cls(
            change=max(limit(np.concatenate([one.change for one in signals]), quantile), 1e-3),
            turning=turning,
            usual=usual,
            highest=max(limit(amps, quantile), usual + 1e-3),
        )


@dataclass(frozen=True, eq=False)
class Indicators:
    """EI, CI and GI of every step, before they are cut to 0..1; GI is None without a gyro."""

    encoder: Numbers
    current: Numbers
    gyro: Numbers | None

    @classmethod
    def of(cls, signals: Signals, limits: Limits) -> "Indicators":
        """Of a run's signals."""
        turning = signals.turning if np.isfinite(limits.turning) else None
        return cls(
            encoder=np.maximum(signals.deviation, signals.change / limits.change),
            current=(signals.amps - limits.usual) / (limits.highest - limits.usual),
            gyro=None if turning is None else turning / limits.turning,
        )


@dataclass(frozen=True, eq=False)
class Example:
    """A training run: its signals, and how much it slipped in each window.

    Attributes:
        signals: of its steps.
        first: first step of every window.
        slips: of its steps, 1 where their window slips, 0 where not, nan where it stands.
        against: what the encoders say too much in each window, times what they say [m^2/s^2].
        square: what they say, times itself [m^2/s^2].
    """

    signals: Signals
    first: np.ndarray
    slips: Numbers
    against: Float[np.ndarray, " window"]
    square: Float[np.ndarray, " window"]

    @classmethod
    def of(cls, run: Run, machine: Machine, seconds: float) -> "Example":
        """Of a run whose signals are smoothed over so long."""
        joined = run.windowed()
        rolling = joined.heard.rolling(machine) * machine.size
        slip = rolling - joined.twist * machine.size
        size = np.linalg.norm(rolling, axis=1)
        slips = np.where(size > _REST, np.linalg.norm(slip, axis=1) > SLIPS * size, np.nan)
        first = groups(run.heard.dt, WINDOW_S)
        return cls(
            signals=Signals.of(run.heard, machine, seconds),
            first=first,
            slips=np.repeat(slips, np.diff(first, append=len(run.heard))),
            against=(slip * rolling).sum(axis=1),
            square=size**2,
        )


def smoothing(dt: Numbers, seconds: float) -> Float[np.ndarray, "step step"]:
    """Matrix of a causal exponential mean with this time constant, by the middles of the steps."""
    middle = np.cumsum(dt) - 0.5 * dt
    age = middle[:, None] - middle[None, :]
    weight = np.where(age >= 0.0, np.exp(-np.maximum(age, 0.0) / seconds), 0.0) * dt
    return weight / weight.sum(axis=1, keepdims=True)


def _deviation(
    rim: Float[np.ndarray, "step drive"],
    mean: Float[np.ndarray, "step step"],
    heard: Heard,
    machine: Machine,
) -> Numbers:
    """Largest relative deviation of a wheel from the shape of the commanded twist."""
    forward = machine.forward.T
    shape = mean @ (heard.rolling(machine) @ forward)
    if heard.command is not None:
        commanded = mean @ (heard.command @ forward)
        asked = np.abs(commanded).max(axis=1, keepdims=True) > _REST
        shape = np.where(asked, commanded, shape)
    turns = np.abs(shape) >= np.maximum(_DRIVING * np.abs(shape).max(axis=1, keepdims=True), 1e-9)
    ratio = np.sort(np.where(turns, rim / np.where(turns, shape, 1.0), np.inf), axis=1)
    # those that do not turn are sorted to the end: the median is in the middle of the others
    count = np.maximum(turns.sum(axis=1, keepdims=True), 1)
    middle = np.concatenate([(count - 1) // 2, count // 2], axis=1)
    median = np.take_along_axis(ratio, middle, axis=1).mean(axis=1, keepdims=True)
    reference = shape * np.where(np.isfinite(median), median, 0.0)
    scale = np.maximum(np.abs(reference).max(axis=1, keepdims=True), _REST)
    return np.asarray(
        (np.abs(rim - reference) / np.maximum(np.abs(reference), _DRIVING * scale)).max(axis=1)
    )
