"""Reina's slip indicators, and Sugeno's fuzzy inference with trained consequents.

Fuzzy inference. Every input x_i lies in 0..1 and has a membership mu in each of `sets` triangular
fuzzy sets, whose peaks are evenly spaced and whose memberships sum to one: with two sets, the
membership in "low" is 1 - x and in "high" x. There is one rule for every combination of sets of the
inputs. The strength f_k of rule k is the product of its memberships, and the output is the mean of
the rules' consequents c_k, weighted by the strengths:

    y = sum_k f_k c_k,    f_k = prod_i mu_ik(x_i),    sum_k f_k = 1

Consequents are fitted by least squares with a weak prior, whose mean is the output of a logical OR
of the inputs; a rule without samples keeps this output.

Source: Takagi & Sugeno 1985, IEEE Transactions on Systems, Man, and Cybernetics 15(1), with
constant consequents (order zero).

Indicators. Signals of a run are smoothed in every step. Thresholds are quantiles of the signals of
training steps without slip, and indicators are signals relative to their thresholds. The formulas
are in the docstring of `reina.py`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from slipid.predict.slip_model import WINDOW_S, Numbers, RobotSpec, Run, RunSignals, groups

_PRIOR_SAMPLES = 1.0
"""Weight of the prior of each rule's consequent, in samples."""


@dataclass(frozen=True, eq=False)
class Sugeno:
    """Fuzzy rules, one for every combination of the inputs' fuzzy sets.

    Attributes:
        sets: number of fuzzy sets of each input.
        consequents: output of each rule; the sets of the last input change fastest.
    """

    sets: int
    consequents: Float[np.ndarray, " rule"]

    @classmethod
    def logical_or(cls, inputs: int, sets: int) -> "Sugeno":
        """Return rules for a logical OR: a rule's output is the largest peak of its sets."""
        peak = np.linspace(0.0, 1.0, sets)
        grid = np.stack(np.meshgrid(*[peak] * inputs, indexing="ij"), axis=-1)
        return cls(sets, grid.max(axis=-1).ravel())

    def strengths(self, x: Float[np.ndarray, "sample input"]) -> Float[np.ndarray, "sample rule"]:
        """Return the strength of each rule; the strengths for one sample sum to one."""
        peak = np.linspace(0.0, 1.0, self.sets)
        member = np.maximum(1.0 - np.abs(x[..., None] - peak) * (self.sets - 1), 0.0)
        strength = member[:, 0]
        for more in member.transpose(1, 0, 2)[1:]:
            strength = (strength[:, :, None] * more[:, None, :]).reshape(len(x), -1)
        return strength

    def infer(self, x: Float[np.ndarray, "sample input"]) -> Float[np.ndarray, " sample"]:
        """Return the output of each sample; inputs are clipped to 0..1."""
        return np.asarray(self.strengths(np.clip(x, 0.0, 1.0)) @ self.consequents)

    def trained(
        self, x: Float[np.ndarray, "sample input"], target: Float[np.ndarray, " sample"]
    ) -> "Sugeno":
        """Return the same sets with consequents fitted to the target outputs."""
        strength = self.strengths(np.clip(x, 0.0, 1.0))
        prior = _PRIOR_SAMPLES * np.eye(len(self.consequents))
        right = strength.T @ target + _PRIOR_SAMPLES * self.consequents
        return replace(self, consequents=np.linalg.solve(strength.T @ strength + prior, right))


SLIP_THRESHOLD = 0.2
"""A window slips if the true twist differs from the encoders' by more than this fraction of the
latter."""
_REST = 0.01
"""Largest speed of the fastest rim at which a robot counts as at rest [m/s]."""
_DRIVING = 0.3
"""Smallest rim speed, relative to the fastest wheel's, at which a wheel counts as driving."""


@dataclass(frozen=True, eq=False)
class SmoothedSignals:
    """Smoothed signals in every step of a run, from which the indicators are computed.

    Attributes:
        deviation: largest deviation of a wheel's speed from its reference, divided by the latter.
        change: largest magnitude of a wheel's acceleration [rad/s^2].
        turning: magnitude of the difference of the yaw rates from encoders and gyro [rad/s]; None
            without a gyro.
        amps: smallest current of the driving wheels [A].
        moving: True in steps in which the wheels turn.
    """

    deviation: Numbers
    change: Numbers
    turning: Numbers | None
    amps: Numbers
    moving: Bool[np.ndarray, " step"]

    @classmethod
    def of(cls, run: RunSignals, spec: RobotSpec, seconds: float) -> "SmoothedSignals":
        """Return the signals of a run, smoothed with this time constant [s]."""
        mean = smoothing(run.dt, seconds)
        speed, amps = mean @ run.speed, mean @ run.along(spec)
        rim = spec.wheel_radius * speed
        fastest = np.abs(rim).max(axis=1, keepdims=True)
        drives = np.abs(rim) >= _DRIVING * fastest
        turning = None
        if run.gyro is not None:
            turning = np.abs(mean @ (run.rolling(spec)[:, 2] - run.gyro))
        change = np.diff(speed, axis=0, prepend=speed[:1]) / run.dt[:, None]
        return cls(
            deviation=_deviation(rim, mean, run, spec),
            change=np.abs(change).max(axis=1),
            turning=turning,
            amps=np.where(drives, amps, np.inf).min(axis=1),
            moving=fastest[:, 0] > _REST,
        )


@dataclass(frozen=True)
class SlipThresholds:
    """Thresholds of the signals, from training steps without slip.

    Attributes:
        change: a_max, acceleration of a wheel [rad/s^2].
        turning: g_th, difference of the yaw rates from encoders and gyro [rad/s]; infinite if a
            training run has no gyro.
        current_low: I_lo, median of the smallest current of the driving wheels [A].
        current_high: I_hi, upper quantile of the smallest current of the driving wheels [A].
    """

    change: float = 1.0
    turning: float = 1.0
    current_low: float = 0.0
    current_high: float = 1.0

    @classmethod
    def of(cls, examples: "Sequence[LabelledRun]", quantile: float) -> "SlipThresholds":
        """Return the thresholds at this quantile of the signals in steps without slip."""
        signals = [example.signals for example in examples]
        slips = np.concatenate([example.slips for example in examples])

        def limit(signal: np.ndarray, at: float) -> float:
            firm = signal[slips == 0.0]
            return float(np.quantile(firm, at) if len(firm) else signal.min())

        amps = np.concatenate([one.amps for one in signals])
        low = limit(amps, 0.5)
        with_gyro = [one.turning for one in signals if one.turning is not None]
        turning = np.inf
        if len(with_gyro) == len(signals):
            turning = max(limit(np.concatenate(with_gyro), quantile), 1e-3)
        return cls(
            change=max(limit(np.concatenate([one.change for one in signals]), quantile), 1e-3),
            turning=turning,
            current_low=low,
            current_high=max(limit(amps, quantile), low + 1e-3),
        )

    def indicators(self, signals: SmoothedSignals) -> tuple[Numbers, Numbers, Numbers | None]:
        """Return EI, CI and GI in every step of a run, before they are clipped to 0..1.

        GI is None without a gyro.
        """
        encoder = np.maximum(signals.deviation, signals.change / self.change)
        current = (signals.amps - self.current_low) / (self.current_high - self.current_low)
        if signals.turning is None or not np.isfinite(self.turning):
            return encoder, current, None
        return encoder, current, signals.turning / self.turning


@dataclass(frozen=True, eq=False)
class LabelledRun:
    """A training run: its signals, and the slip of each window from the poses.

    Attributes:
        signals: smoothed signals of its steps.
        first: index of the first step of every window.
        slips: 1 in steps whose window slips, 0 where it does not, NaN at rest.
        against: scalar product, in each window, of the encoders' twist and its excess over the true
            twist [m^2/s^2].
        square: squared norm of the encoders' twist in each window [m^2/s^2].
    """

    signals: SmoothedSignals
    first: np.ndarray
    slips: Numbers
    against: Float[np.ndarray, " window"]
    square: Float[np.ndarray, " window"]

    @classmethod
    def of(cls, run: Run, spec: RobotSpec, seconds: float) -> "LabelledRun":
        """Return a run whose signals are smoothed with this time constant [s]."""
        joined = run.windowed()
        rolling = joined.signals.rolling(spec) * spec.size
        slip = rolling - joined.twist * spec.size
        size = np.linalg.norm(rolling, axis=1)
        slips = np.where(size > _REST, np.linalg.norm(slip, axis=1) > SLIP_THRESHOLD * size, np.nan)
        first = groups(run.signals.dt, WINDOW_S)
        return cls(
            signals=SmoothedSignals.of(run.signals, spec, seconds),
            first=first,
            slips=np.repeat(slips, np.diff(first, append=len(run.signals))),
            against=(slip * rolling).sum(axis=1),
            square=size**2,
        )


def smoothing(dt: Numbers, seconds: float) -> Float[np.ndarray, "step step"]:
    """Return the matrix that maps a signal in steps to its causal exponential mean.

    The age of a step is measured between the middles of steps; `seconds` is the time constant.
    """
    middle = np.cumsum(dt) - 0.5 * dt
    age = middle[:, None] - middle[None, :]
    weight = np.where(age >= 0.0, np.exp(-np.maximum(age, 0.0) / seconds), 0.0) * dt
    return weight / weight.sum(axis=1, keepdims=True)


def _deviation(
    rim: Float[np.ndarray, "step drive"],
    mean: Float[np.ndarray, "step step"],
    run: RunSignals,
    spec: RobotSpec,
) -> Numbers:
    """Return the largest relative deviation of a wheel's rim speed from its reference in each step.

    The references are the rim speeds of the commanded twist, or of the encoders' twist without a
    command, times the median ratio of measured to commanded rim speeds.
    """
    forward = spec.forward.T
    shape = mean @ (run.rolling(spec) @ forward)
    if run.command is not None:
        commanded = mean @ (run.command @ forward)
        is_commanded = np.abs(commanded).max(axis=1, keepdims=True) > _REST
        shape = np.where(is_commanded, commanded, shape)
    turns = np.abs(shape) >= np.maximum(_DRIVING * np.abs(shape).max(axis=1, keepdims=True), 1e-9)
    ratio = np.ma.masked_array(rim / np.where(turns, shape, 1.0), ~turns)
    reference = shape * np.ma.median(ratio, axis=1, keepdims=True).filled(0.0)
    scale = np.maximum(np.abs(reference).max(axis=1, keepdims=True), _REST)
    return np.asarray(
        (np.abs(rim - reference) / np.maximum(np.abs(reference), _DRIVING * scale)).max(axis=1)
    )
