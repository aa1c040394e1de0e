"""The one interface of every classifier of floors: what it hears of a run, and what it believes.

A classifier is fitted to runs of which the floor is known. Then it hears others row by row, and
says after each row how probable every floor is. It may use what came before, and nothing later.
"""

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.predict.slip_model import RobotSpec

Beliefs = Float[np.ndarray, "row floor"]
"""Probability of each floor after every row."""
STILL = 0.3
"""Wheel speed below which a wheel stands [rad/s]."""


@dataclass(frozen=True, eq=False)
class FloorSignals:
    """What a robot feels of a floor, row by row, without a pose.

    Attributes:
        name: of the run.
        floor: that it was driven on. Classifiers see it where they are fitted, and only there.
        time: of each row [s], growing.
        speed: of the wheels of each drive [rad/s].
        current: of each motor [A]; its size where an ammeter knows no sign.
        gyro: yaw rate [rad/s], NaN where it was not heard; None without a gyro.
        vibration: std of the vertical acceleration since the row before [m/s^2], NaN where it was
            not heard; None where it was not logged.
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
        """How long each row stands for [s]: since the one before, and the first as long as most."""
        steps = np.diff(self.time)
        first = float(np.median(steps)) if len(steps) else 0.0
        return np.append(first, steps)

    @property
    def moves(self) -> Bool[np.ndarray, " row"]:
        """Rows in which a wheel turns; a robot that stands feels no floor."""
        return np.asarray(np.abs(self.speed).max(axis=1) > STILL)

    def part(self, first: int, last: int) -> "FloorSignals":
        """The rows from `first` up to, and without, `last`."""
        rows = slice(first, last)
        return replace(
            self,
            time=self.time[rows],
            speed=self.speed[rows],
            current=self.current[rows],
            gyro=None if self.gyro is None else self.gyro[rows],
            vibration=None if self.vibration is None else self.vibration[rows],
        )

    def began(self, seconds: float) -> Int[np.ndarray, " row"]:
        """First row of the piece that each row is in, of pieces of this length [s]."""
        start = np.cumsum(self.dt) - self.dt
        number = np.floor(start / seconds + 1e-6)
        return np.searchsorted(number, number)

    def pieces(self, seconds: float) -> list["FloorSignals"]:
        """The run cut into parts of this length one after another, the last of them shorter."""
        edges = [*np.unique(self.began(seconds)), len(self)]
        return [self.part(int(a), int(b)) for a, b in pairwise(edges)]

    def rolling(self, spec: RobotSpec) -> Float[np.ndarray, "row 3"]:
        """Body twist if nothing slips [m/s, m/s, rad/s]."""
        return np.asarray(self.speed * spec.wheel_radius @ spec.back.T)


@dataclass(frozen=True)
class FloorClassifier(abc.ABC):
    """A classifier of floors, before or after it is fitted.

    Attributes:
        name: of its row.
        labels: floors that it was fitted to, in the order of its beliefs; none before.
    """

    name: str
    labels: tuple[str, ...] = ()

    def candidates(self) -> Sequence["FloorClassifier"]:
        """Itself with other settings, at most `TRIES`, from which cross-validation picks one."""
        return (self,)

    @abc.abstractmethod
    def fit(self, felts: Sequence[FloorSignals], spec: RobotSpec) -> Self:
        """The classifier fitted to runs whose floors it is told."""

    @abc.abstractmethod
    def probability(self, felts: Sequence[FloorSignals], spec: RobotSpec) -> list[Beliefs]:
        """Probability of each floor after every row of runs, each heard from its first row on.

        What it says after a row depends on that row and those before it, on nothing later.
        """

    @property
    @abc.abstractmethod
    def numbers(self) -> int:
        """How many numbers were fitted."""


def floors_of(felts: Sequence[FloorSignals]) -> tuple[str, ...]:
    """Names of the floors that runs were driven on, sorted."""
    return tuple(sorted({felt.floor for felt in felts}))


def training_rows(
    felts: Sequence[FloorSignals],
    features: Callable[[FloorSignals], Float[np.ndarray, "row feature"]],
    every_s: float = 0.0,
) -> tuple[Float[np.ndarray, "row feature"], np.ndarray]:
    """Features to train on and the floor of each row, of rows in which the robot moves.

    Rows that are taken are about `every_s` apart [s].
    """
    found, floors = [], []
    for felt in felts:
        every = max(1, round(every_s / max(float(np.median(felt.dt)), 1e-3)))
        take = np.flatnonzero(felt.moves)[::every]
        found.append(features(felt)[take])
        floors += [felt.floor] * len(take)
    return np.concatenate(found), np.array(floors)


def accumulated(
    log_likelihood: Float[np.ndarray, "row floor"],
    felt: FloorSignals,
    apart_s: float,
    memory_s: float = np.inf,
) -> Beliefs:
    """Beliefs by the likelihood of every row, all floors as probable at the start.

    log p_t = exp(-dt / memory) log p_{t-1} + (dt / apart) log l_t + const,   p_0 uniform

    Rows are no independent witnesses: what lies nearer than `apart_s` [s] counts as one. What was
    heard longer than `memory_s` [s] ago fades. A row in which the robot stands, or that has no
    likelihood, changes nothing.
    """
    heard = felt.moves & np.isfinite(log_likelihood).all(axis=1)
    log = np.zeros(log_likelihood.shape[1])
    beliefs = np.empty_like(log_likelihood)
    step = np.exp(-felt.dt / memory_s)
    news = np.where(heard[:, None], log_likelihood, 0.0) * (felt.dt / apart_s)[:, None]
    for t, (keep, more) in enumerate(zip(step, news, strict=True)):
        log = (keep * log if heard[t] else log) + more
        log = log - log.max()
        beliefs[t] = np.exp(log)
    return np.asarray(beliefs / beliefs.sum(axis=1, keepdims=True))
