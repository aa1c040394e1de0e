"""Slip detection by indicators from encoders, gyro and currents, by thresholds or fuzzy rules.

Signals are smoothed by a causal exponential mean (I~, w, gyro). With J_i the rim speed of wheel i
per body twist, xi_c the commanded twist and xi_enc the twist by the encoders:

    w_ref,i = J_i xi_c / r  median_j(r w_j / J_j xi_c)   (without a command: xi_enc for xi_c)
    EI = sat(max_i max(|w_i - w_ref,i| / |w_ref,i|, |dw_i/dt| / a_max))
    GI = sat(|W_enc - gyro| / g_th)
    CI = sat((min_i I~_i - I_lo) / (I_hi - I_lo)),       sat(x) = x cut to 0..1

`reina_deterministic` flags slip where GI >= 1 or CI >= 1. `reina_fuzzy` feeds EI, CI and GI into
Sugeno's inference with fuzzy sets on 0..1, its consequents trained by least squares on whether the
training windows slip, and flags slip where the answer is at least one half. A window of half a
second slips where |xi - xi_enc| > 0.2 |xi_enc|, yaw rates weighted by the base radius.

Tuned: the quantile of windows without slip that sets a_max, g_th and I_hi, and how long signals are
smoothed; of the fuzzy row the number of fuzzy sets instead of the quantile.

Liberties:
- The original only detects. Here the path is that of the encoders, its twist scaled by 1 - s where
  slip is flagged, s the mean slip of what was flagged in training windows (least squares).
- Thresholds are quantiles over the training windows without slip (I_lo: the median); where all
  slip, the smallest value seen.
- Where there is no gyro, EI >= 1 takes the place of GI >= 1.
- The original compares the wheels of a rover with each other. An omni robot's wheels turn at
  different speeds, so they are compared with the shape of the commanded twist; what a slow wheel
  is off is divided by 0.3 of the fastest reference instead of its own. Three omni wheels fit any
  twist exactly: then EI tells how wheels follow their command, not whether they slip, and without
  a command only accelerations are left of it.
- The smallest current is taken over wheels that turn with at least 0.3 of the fastest rim speed;
  the others carry no load that could tell of slip.
- Fuzzy sets are triangles, every combination of sets has a rule, and consequents are constants
  that are trained on poses; the original's own sets and rules are not taken over.
- The score is the larger of the uncut indicators that flag, or the fuzzy answer; 0 at rest.
- The original also sees by a camera how deep its wheels have sunk; that is left out.

Source: Reina, Ojeda, Milella, Borenstein 2006, "Wheel slippage and sinkage detection for planetary
rovers", IEEE/ASME Transactions on Mechatronics 11(2).
"""

import abc
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from slipid.baselines.interface import (
    WINDOW_S,
    Channel,
    Heard,
    Machine,
    Method,
    Numbers,
    Run,
    Said,
    groups,
    path_of,
)
from slipid.baselines.motion.fuzzy import Sugeno

SLIPS = 0.2
"""Slip from which on a window counts as slipping, as a share of what the encoders say."""
_REST = 0.01
"""Rim speed below which a robot stands [m/s]."""
_DRIVING = 0.3
"""Share of the fastest rim speed from which on a wheel counts as driving."""
_CURRENT: frozenset[Channel] = frozenset({"current"})


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


@dataclass(frozen=True)
class _Detector(Method):
    """What both rows share.

    Attributes:
        smoothing: how long signals are smoothed [s].
        quantile: of the steps without slip that sets the thresholds.
        limits: fitted thresholds.
        slip: share of the encoders' twist that is lost where slip is flagged, fitted.
    """

    needs: frozenset[Channel] = field(default=_CURRENT, kw_only=True)
    smoothing: float = 0.3
    quantile: float = 0.95
    limits: Limits = field(default_factory=Limits)
    slip: float = 0.0

    def fit(self, runs: Sequence[Run], machine: Machine) -> "_Detector":
        examples = [Example.of(run, machine, self.smoothing) for run in runs]
        limited = replace(self, limits=Limits.of(examples, self.quantile))
        trained = limited._trained(examples)
        return replace(trained, slip=trained._mean_slip(examples))

    def predict(self, runs: Sequence[Heard], machine: Machine) -> list[Said]:
        said = []
        for heard in runs:
            score = self.score(Signals.of(heard, machine, self.smoothing))
            kept = 1.0 - self.slip * (score >= self._flagged)
            path = path_of(heard.rolling(machine) * kept[:, None], heard.dt)
            said.append(Said(path, slipping=score))
        return said

    def score(self, signals: Signals) -> Numbers:
        """How sure it is that the robot slips in each step; 0 where it stands."""
        return np.where(signals.moving, self._answer(Indicators.of(signals, self.limits)), 0.0)

    def _mean_slip(self, examples: Sequence[Example]) -> float:
        """Slip of the flagged parts of windows that explains their twists best."""
        against = square = 0.0
        for example in examples:
            flags = (self.score(example.signals) >= self._flagged).astype(float)
            count = np.diff(example.first, append=len(flags))
            share = np.add.reduceat(flags, example.first) / count
            against += float(share @ example.against)
            square += float(share**2 @ example.square)
        return against / square if square > 0.0 else 0.0

    def _trained(self, examples: Sequence[Example]) -> "_Detector":
        """Itself, with what it learns beside the thresholds."""
        return self

    @property
    @abc.abstractmethod
    def _flagged(self) -> float:
        """Score from which on slip is flagged."""

    @abc.abstractmethod
    def _answer(self, indicators: Indicators) -> Numbers:
        """Score of moving steps."""


@final
@dataclass(frozen=True)
class ReinaDeterministic(_Detector):
    """Slip is flagged where GI >= 1 or CI >= 1; where there is no gyro, EI >= 1 or CI >= 1."""

    name: str = "reina_deterministic"

    def candidates(self) -> Sequence["ReinaDeterministic"]:
        return [replace(self, quantile=q, smoothing=s) for q in (0.9, 0.98) for s in (0.3, 1.0)]

    @property
    def numbers(self) -> int:
        return 4 + int(np.isfinite(self.limits.turning))

    @property
    def _flagged(self) -> float:
        return 1.0

    def _answer(self, indicators: Indicators) -> Numbers:
        turning = indicators.encoder if indicators.gyro is None else indicators.gyro
        return np.maximum(turning, indicators.current)


@final
@dataclass(frozen=True)
class ReinaFuzzy(_Detector):
    """Slip is flagged where Sugeno's inference from EI, CI and, if there is one, GI says half.

    Attributes:
        sets: fuzzy sets of every indicator.
        rules: fitted.
    """

    name: str = "reina_fuzzy"
    sets: int = 2
    rules: Sugeno | None = None

    def candidates(self) -> Sequence["ReinaFuzzy"]:
        return [replace(self, sets=n, smoothing=s) for n in (2, 3) for s in (0.3, 1.0)]

    @property
    def numbers(self) -> int:
        rules = 0 if self.rules is None else len(self.rules.consequents)
        return 4 + int(np.isfinite(self.limits.turning)) + rules

    @property
    def _flagged(self) -> float:
        return 0.5

    def _trained(self, examples: Sequence[Example]) -> "ReinaFuzzy":
        signals = [example.signals for example in examples]
        inputs = np.concatenate([self._inputs(Indicators.of(s, self.limits)) for s in signals])
        slips = np.concatenate([example.slips for example in examples])
        known = np.isfinite(slips)
        untrained = Sugeno.logical_or(inputs.shape[1], self.sets)
        return replace(self, rules=untrained.trained(inputs[known], slips[known]))

    def _answer(self, indicators: Indicators) -> Numbers:
        inputs = self._inputs(indicators)
        rules = self.rules or Sugeno.logical_or(inputs.shape[1], self.sets)
        return rules.infer(inputs)

    def _inputs(self, indicators: Indicators) -> Float[np.ndarray, "step input"]:
        """The indicators as columns. A gyro that is missing in a run says nothing of slip."""
        columns = [indicators.encoder, indicators.current]
        if np.isfinite(self.limits.turning):
            silent = np.zeros_like(indicators.encoder)
            columns.append(silent if indicators.gyro is None else indicators.gyro)
        return np.stack(columns, axis=1)


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
