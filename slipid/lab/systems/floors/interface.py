"""Interface of floor classifiers: the signals that they use, and the beliefs that they return.

A classifier is fitted to runs whose floor is known. It then processes other runs row by row and
returns the probability of every floor after each row, from that row and earlier ones only.

Features of a row are causal: they are computed over trailing windows of fixed length in seconds,
which end with the row itself:

    mean and std of the current and of the speed of each drive
    mean of the summed currents divided by the mean of the summed wheel speeds
    mean magnitude of the gyro's yaw rate; mean and std of its shortfall from the encoders' yaw rate

The time since the start of the run is a feature too, since the first windows are shorter. slipid's
own filter uses the same channels: wheels, currents, gyro. Vibration is used only on request.
"""

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.predict.slip_model import RobotSpec

Beliefs = Float[np.ndarray, "row floor"]
"""Probability of each floor after every row."""
Features = Float[np.ndarray, "row feature"]
FloorChannel = Literal["current", "gyro", "vibration"]
"""Optional channel of the features; wheel speeds are always used."""
DEFAULT_CHANNELS: frozenset[FloorChannel] = frozenset({"current", "gyro"})
"""Channels that slipid uses too, besides the wheel speeds."""
REST_WHEEL_SPEED = 0.3
"""Largest wheel speed at which a wheel counts as at rest [rad/s]."""
WINDOWS_S = (0.5, 1.0, 2.0)
"""Lengths of the feature windows [s]."""


@dataclass(frozen=True, eq=False)
class FloorSignals:
    """Signals of a run from which its floor can be recognised, row by row, without a pose.

    Attributes:
        name: name of the run.
        floor: floor of the run; classifiers may read it in training runs only.
        time: time of each row [s], increasing.
        speed: wheel speed of each drive [rad/s].
        current: current of each motor [A]; its magnitude where an ammeter has no sign.
        gyro: yaw rate [rad/s], NaN where it is missing; None without a gyro.
        vibration: std of the vertical acceleration since the row before [m/s^2], NaN where it is
            missing; None where it was not logged.
    """

    name: str
    floor: str
    time: Float[np.ndarray, " row"]
    speed: Float[np.ndarray, "row drive"]
    current: Float[np.ndarray, "row drive"]
    gyro: Float[np.ndarray, " row"] | None = None
    vibration: Float[np.ndarray, " row"] | None = None

    def __len__(self) -> int:
        return len(self.time)

    @property
    def dt(self) -> Float[np.ndarray, " row"]:
        """Duration of each row: time since the previous row; for the first row the median [s]."""
        steps = np.diff(self.time)
        first = float(np.median(steps)) if len(steps) else 0.0
        return np.append(first, steps)

    @property
    def moving(self) -> Bool[np.ndarray, " row"]:
        """True in rows in which a wheel turns; at rest there is no evidence about the floor."""
        return np.asarray(np.abs(self.speed).max(axis=1) > REST_WHEEL_SPEED)

    def rows(self, first: int, last: int) -> "FloorSignals":
        """Return the run's rows from `first` up to but not including `last`."""
        part = slice(first, last)
        arrays: dict[str, Any] = {
            k: x[part] for k, x in vars(self).items() if isinstance(x, np.ndarray)
        }
        return replace(self, **arrays)

    def segment_start(self, seconds: float) -> Int[np.ndarray, " row"]:
        """Return the index of the first row of each row's segment; segments last `seconds` [s]."""
        start = np.cumsum(self.dt) - self.dt
        number = np.floor(start / seconds + 1e-6)
        return np.searchsorted(number, number)

    def segments(self, seconds: float) -> list["FloorSignals"]:
        """Return consecutive segments of the run of this length [s]; the last may be shorter."""
        edges = [*np.unique(self.segment_start(seconds)), len(self)]
        return [self.rows(int(a), int(b)) for a, b in pairwise(edges)]

    def rolling(self, spec: RobotSpec) -> Float[np.ndarray, "row 3"]:
        """Return the body twist without slip [m/s, m/s, rad/s]."""
        return np.asarray(self.speed * spec.wheel_radius @ spec.back.T)


@dataclass(frozen=True)
class FloorClassifier(abc.ABC):
    """A classifier of floors, before or after it is fitted.

    Attributes:
        name: name of its row in the tables.
        labels: floors to which it was fitted, in the order of its beliefs; empty before a fit.
    """

    name: str
    labels: tuple[str, ...] = ()

    def candidates(self) -> Sequence["FloorClassifier"]:
        """Return variants with different settings, from which cross-validation selects one."""
        return (self,)

    @abc.abstractmethod
    def fit(self, runs: Sequence[FloorSignals], spec: RobotSpec) -> Self:
        """Return the classifier fitted to runs with known floors."""

    @abc.abstractmethod
    def probability(self, runs: Sequence[FloorSignals], spec: RobotSpec) -> list[Beliefs]:
        """Return the probability of each floor after every row of every run.

        Each run is processed separately. The belief after a row depends on that row and earlier
        ones only.
        """

    @property
    @abc.abstractmethod
    def numbers(self) -> int:
        """Number of fitted parameters."""


def floors_of(runs: Sequence[FloorSignals]) -> tuple[str, ...]:
    """Return the sorted names of the floors of some runs."""
    return tuple(sorted({run.floor for run in runs}))


def training_rows(
    runs: Sequence[FloorSignals], features: Callable[[FloorSignals], Features], every_s: float = 0.0
) -> tuple[Features, np.ndarray]:
    """Return features and floor names of rows in which robots move.

    The rows of a run are about `every_s` [s] apart.
    """
    found, floors = [], []
    for run in runs:
        every = max(1, round(every_s / max(float(np.median(run.dt)), 1e-3)))
        take = np.flatnonzero(run.moving)[::every]
        found.append(features(run)[take])
        floors += [run.floor] * len(take)
    return np.concatenate(found), np.array(floors)


def accumulated(
    log_likelihood: Float[np.ndarray, "row floor"],
    run: FloorSignals,
    apart_s: float,
    memory_s: float = np.inf,
) -> Beliefs:
    """Return the belief after every row from the likelihoods l_t of the floors in each row.

    log p_t = exp(-dt / memory) log p_{t-1} + (dt / apart) log l_t + const,   p_0 uniform

    Rows are not independent: all rows within `apart_s` [s] together count as one observation.
    Evidence fades with the time constant `memory_s` [s]. A row in which the robot is at rest, or
    whose likelihood is not finite, does not change the belief.
    """
    used = run.moving & np.isfinite(log_likelihood).all(axis=1)
    evidence = np.where(used[:, None], log_likelihood, 0.0) * (run.dt / apart_s)[:, None]
    keep = np.where(used, np.exp(-run.dt / memory_s), 1.0)
    log, beliefs = np.zeros(log_likelihood.shape[1]), np.empty_like(log_likelihood)
    for t in range(len(run)):
        log = keep[t] * log + evidence[t]
        log = log - log.max()
        beliefs[t] = np.exp(log)
    return np.asarray(beliefs / beliefs.sum(axis=1, keepdims=True))


def features(
    run: FloorSignals,
    spec: RobotSpec,
    channels: frozenset[FloorChannel] = DEFAULT_CHANNELS,
    windows_s: Sequence[float] = WINDOWS_S,
    restart_s: float = np.inf,
) -> Features:
    """Return the features of every row from the rows up to it; NaN where a channel has no value.

    After every `restart_s` [s], windows restart without earlier rows, as at the start of a run.
    """
    start = run.segment_start(restart_s)
    columns = [np.minimum(run.time - run.time[start], max(windows_s))]
    amps = np.abs(run.current) if "current" in channels else run.current[:, :0]
    for seconds in windows_s:
        window = TrailingWindow.of(run.time, seconds, start)
        columns += [m for x in (*amps.T, *run.speed.T) for m in window.mean_and_std(x)]
        if "current" in channels:
            turning = np.abs(run.speed).sum(axis=1)
            columns.append(window.mean(amps.sum(axis=1)) / (window.mean(turning) + 0.1))
        if "gyro" in channels and run.gyro is not None:
            shortfall = yaw_rate_shortfall(run.gyro, run.rolling(spec)[:, 2])
            columns.append(window.mean(np.abs(run.gyro)))
            columns += window.mean_and_std(shortfall)
        if "vibration" in channels and run.vibration is not None:
            columns += window.mean_and_std(run.vibration)
    return np.stack(columns, axis=1)


def yaw_rate_shortfall(
    gyro: Float[np.ndarray, " row"], rolling: Float[np.ndarray, " row"]
) -> Float[np.ndarray, " row"]:
    """Return the shortfall of the body's yaw rate below that of the rolling wheels [rad/s].

    The shortfall is the difference of the yaw rates from encoders and gyro, with a sign that makes
    it positive where the body turns less than its wheels do, to the left or to the right.
    """
    return np.asarray(np.where(rolling < 0, gyro - rolling, rolling - gyro))


@dataclass(frozen=True, eq=False)
class TrailingWindow:
    """Trailing window of each row: the rows of the last seconds, including the row itself.

    Attributes:
        first: index of the first row in the window of each row.
    """

    first: Int[np.ndarray, " row"]

    @classmethod
    def of(
        cls,
        time: Float[np.ndarray, " row"],
        seconds: float,
        start: Int[np.ndarray, " row"] | None = None,
    ) -> "TrailingWindow":
        """Return windows of `seconds` [s] for rows at times `time` [s], cut off at rows `start`."""
        first = np.searchsorted(time, time - seconds + 1e-6)
        return cls(first if start is None else np.maximum(first, start))

    def mean(self, x: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        """Return the mean of the finite values in each window; NaN where there is none."""
        return self.mean_and_std(x)[0]

    def mean_and_std(self, x: Float[np.ndarray, " row"]) -> list[Float[np.ndarray, " row"]]:
        """Return mean and std of the finite values in each window; NaN where there is none."""
        known = np.isfinite(x)
        # the first value is subtracted, so that the difference of squares loses fewer digits
        offset = float(x[known][0]) if known.any() else 0.0
        value = np.where(known, x - offset, 0.0)
        count = self._sum(known.astype(float))
        count = np.where(count > 0, count, np.nan)
        mean = self._sum(value) / count
        variance = self._sum(value**2) / count - mean**2
        return [mean + offset, np.sqrt(np.maximum(variance, 0.0))]

    def _sum(self, x: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        total = np.append(0.0, np.cumsum(x))
        return np.asarray(total[1:] - total[self.first])
