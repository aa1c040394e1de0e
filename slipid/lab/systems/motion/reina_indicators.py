"""Sugeno's fuzzy inference answers by rules with constants that least squares trains.

Every input lies in 0..1 and belongs to `sets` triangular sets, whose peaks are evenly spaced and
whose memberships sum to one: for two sets, low is 1 - x and high is x. There is one rule for every
combination of sets of the inputs. A rule fires with the product of its memberships, and the answer
is the mean of the rules' consequents, weighted by how much they fire:

    y = sum_k f_k c_k,    f_k = prod_i mu_ik(x_i),    sum_k f_k = 1

Consequents are those of least squares, pulled a little towards the answer of a logical OR, so that
a rule that no sample fires still says what its words say.

Source: Takagi & Sugeno 1985, IEEE Transactions on Systems, Man, and Cybernetics 15(1); of order
zero.

The indicators of slip come from smoothed signals and from what these are where nothing slips.

Signals of a run are smoothed in every step. Limits are quantiles of the signals of training steps
without slip, and indicators are signals over their limits. The formulas stand at the top of
`method.py`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from slipid.predict.slip_model import WINDOW_S, Numbers, RobotSpec, Run, RunSignals, groups

_PULL = 1.0
"""How many samples the answer of a logical OR counts as, in every rule."""


@dataclass(frozen=True, eq=False)
class Sugeno:
    """Fuzzy rules on a grid of sets.

    Attributes:
        sets: fuzzy sets of each input.
        consequents: answer of each rule; the sets of the last input change fastest.
    """

    sets: int
    consequents: Float[np.ndarray, " rule"]

    @classmethod
    def logical_or(cls, inputs: int, sets: int) -> "Sugeno":
        """Rules that answer with the peak of the highest set among their inputs."""
        peak = np.linspace(0.0, 1.0, sets)
        grid = np.stack(np.meshgrid(*[peak] * inputs, indexing="ij"), axis=-1)
        return cls(sets, grid.max(axis=-1).ravel())

    def strengths(self, x: Float[np.ndarray, "sample input"]) -> Float[np.ndarray, "sample rule"]:
        """How much each rule fires; the rules of a sample sum to one."""
        peak = np.linspace(0.0, 1.0, self.sets)
        member = np.maximum(1.0 - np.abs(x[..., None] - peak) * (self.sets - 1), 0.0)
        fires = member[:, 0]
        for more in member.transpose(1, 0, 2)[1:]:
            fires = (fires[:, :, None] * more[:, None, :]).reshape(len(x), -1)
        return fires

    def infer(self, x: Float[np.ndarray, "sample input"]) -> Float[np.ndarray, " sample"]:
        """Answer to each sample; inputs beyond 0..1 count as its ends."""
        return np.asarray(self.strengths(np.clip(x, 0.0, 1.0)) @ self.consequents)

    def trained(
        self, x: Float[np.ndarray, "sample input"], wanted: Float[np.ndarray, " sample"]
    ) -> "Sugeno":
        """The same sets with the consequents that come nearest to the wanted answers."""
        fires = self.strengths(np.clip(x, 0.0, 1.0))
        pulled = _PULL * np.eye(len(self.consequents))
        right = fires.T @ wanted + _PULL * self.consequents
        return replace(self, consequents=np.linalg.solve(fires.T @ fires + pulled, right))


SLIPS = 0.2
"""Slip from which on a window counts as slipping, as a share of what the encoders say."""
_REST = 0.01
"""Rim speed below which a robot stands [m/s]."""
_DRIVING = 0.3
"""Share of the fastest rim speed from which on a wheel counts as driving."""


@dataclass(frozen=True, eq=False)
class SmoothedSignals:
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
    def of(cls, heard: RunSignals, spec: RobotSpec, seconds: float) -> "SmoothedSignals":
        """Of a run, smoothed over so long."""
        mean = smoothing(heard.dt, seconds)
        speed, amps = mean @ heard.speed, mean @ heard.along(spec)
        rim = spec.wheel_radius * speed
        fastest = np.abs(rim).max(axis=1, keepdims=True)
        drives = np.abs(rim) >= _DRIVING * fastest
        turning = None
        if heard.gyro is not None:
            turning = np.abs(mean @ (heard.rolling(spec)[:, 2] - heard.gyro))
        change = np.diff(speed, axis=0, prepend=speed[:1]) / heard.dt[:, None]
        return cls(
            deviation=_deviation(rim, mean, heard, spec),
            change=np.abs(change).max(axis=1),
            turning=turning,
            amps=np.where(drives, amps, np.inf).min(axis=1),
            moving=fastest[:, 0] > _REST,
        )


@dataclass(frozen=True)
class SlipThresholds:
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
    def of(cls, examples: "Sequence[LabelledRun]", quantile: float) -> "SlipThresholds":
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
    def of(cls, signals: SmoothedSignals, limits: SlipThresholds) -> "Indicators":
        """Of a run's signals."""
        turning = signals.turning if np.isfinite(limits.turning) else None
        return cls(
            encoder=np.maximum(signals.deviation, signals.change / limits.change),
            current=(signals.amps - limits.usual) / (limits.highest - limits.usual),
            gyro=None if turning is None else turning / limits.turning,
        )


@dataclass(frozen=True, eq=False)
class LabelledRun:
    """A training run: its signals, and how much it slipped in each window.

    Attributes:
        signals: of its steps.
        first: first step of every window.
        slips: of its steps, 1 where their window slips, 0 where not, nan where it stands.
        against: what the encoders say too much in each window, times what they say [m^2/s^2].
        square: what they say, times itself [m^2/s^2].
    """

    signals: SmoothedSignals
    first: np.ndarray
    slips: Numbers
    against: Float[np.ndarray, " window"]
    square: Float[np.ndarray, " window"]

    @classmethod
    def of(cls, run: Run, spec: RobotSpec, seconds: float) -> "LabelledRun":
        """Of a run whose signals are smoothed over so long."""
        joined = run.windowed()
        rolling = joined.signals.rolling(spec) * spec.size
        slip = rolling - joined.twist * spec.size
        size = np.linalg.norm(rolling, axis=1)
        slips = np.where(size > _REST, np.linalg.norm(slip, axis=1) > SLIPS * size, np.nan)
        first = groups(run.signals.dt, WINDOW_S)
        return cls(
            signals=SmoothedSignals.of(run.signals, spec, seconds),
            first=first,
            slips=np.repeat(slips, np.diff(first, append=len(run.signals))),
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
    heard: RunSignals,
    spec: RobotSpec,
) -> Numbers:
    """Largest relative deviation of a wheel from the shape of the commanded twist."""
    forward = spec.forward.T
    shape = mean @ (heard.rolling(spec) @ forward)
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
