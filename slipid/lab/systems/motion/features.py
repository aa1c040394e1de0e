"""Inputs and targets of the learned methods, in windows of half a second.

The inputs of a window are means over the measurements of the robot itself:

    rolling twist (vx, vy, W), as if nothing slipped; speed of each drive
    direction (vx, vy, L W) / size, with size = |(vx, vy, L W)| and L the base radius,
    and its second harmonic ((vx^2 - vy^2), 2 vx vy) / size^2
    if they were logged: |current| of each drive; commanded twist; gyro and (gyro - W) L / size

The target is the slip ratio of the body,

    ratio = (true twist - rolling twist) (1, 1, L) / size

This ratio has no unit. Where friction does not depend on the speed, the ratio depends little on the
speed, so that a fit at one speed also holds at other speeds, unlike a fit of a target in m/s. The
noise of the pose is divided by the size too, so windows are weighted by

    weight ~ size^2 / (size^2 + (median size / 2)^2)

This weight rises with the square of the size at low speeds, where the noise of the pose dominates,
and is constant at high speeds, where the unexplained part of the slip dominates. Windows in which
the wheels rest are omitted. Predicted ratios are multiplied by the size again, so that a robot at
rest does not slip.
"""

import abc
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Protocol, Self, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.lab.systems.one_thread import one_thread
from slipid.predict.slip_model import (
    WINDOW_S,
    Channel,
    PredictedRun,
    RobotSpec,
    Run,
    RunSignals,
    SlipModel,
    Twists,
    groups,
    path_of,
)

REST_SPEED = 0.02
"""Size of the rolling twist below which a robot counts as at rest [m/s]."""

Inputs = Float[np.ndarray, "window input"]
Ratios = Float[np.ndarray, "window 3"]
"""Slip ratio of the body in each window: forward, to the left, turning."""


@runtime_checkable
class Regressor(Protocol):
    """Interface of scikit-learn's fitted regressors, as far as it is used here."""

    def predict(self, X: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True, eq=False)
class SignalWindows:
    """Signals of several runs in windows of half a second, one run after the other.

    Attributes:
        signals: signals of each run, averaged over its windows.
        rolling: body twist without slip.
        size: size of the rolling twist [m/s], with the yaw rate multiplied by the base radius.
        run: index of the run of each window.
    """

    signals: Sequence[RunSignals]
    rolling: Twists
    size: Float[np.ndarray, " window"]
    run: Int[np.ndarray, " window"]

    @classmethod
    def of(cls, runs: Sequence[RunSignals], spec: RobotSpec) -> "SignalWindows":
        """Return the windows of runs whose signals are given in shorter steps."""
        joined = [run.windowed() for run in runs]
        rolling = np.concatenate([run.rolling(spec) for run in joined])
        size = np.sqrt(((rolling * spec.size) ** 2).sum(axis=1))
        return cls(joined, rolling, size, np.repeat(np.arange(len(joined)), [*map(len, joined)]))

    @property
    def moving(self) -> Bool[np.ndarray, " window"]:
        """True for windows in which the wheels turn fast enough to define a slip ratio."""
        return self.size >= REST_SPEED

    def direction(self, spec: RobotSpec) -> Float[np.ndarray, "window 3"]:
        """Return the rolling twist divided by its size: forward, to the left, turning."""
        return np.asarray(self.rolling * spec.size / self.size.clip(min=REST_SPEED)[:, None])

    def speed(self) -> Float[np.ndarray, "window drive"]:
        """Return the wheel speed of each drive [rad/s]."""
        return np.concatenate([run.speed for run in self.signals])

    def amperes(self) -> Float[np.ndarray, "window drive"]:
        """Return the magnitude of each drive's current [A]."""
        return np.abs(self._channel("current"))

    def inputs(self, spec: RobotSpec, channels: frozenset[Channel]) -> Inputs:
        """Return the inputs from encoders and from the given channels.

        Raises:
            ValueError: a run lacks one of the channels.
        """
        direction = self.direction(spec)
        x, y = direction[:, 0], direction[:, 1]
        columns = [self.rolling, self.speed(), direction, np.stack([x * x - y * y, 2 * x * y], 1)]
        if "current" in channels:
            columns.append(self.amperes())
        if "command" in channels:
            columns.append(self._channel("command"))
        if "gyro" in channels:
            gyro = self._channel("gyro")
            slip = (gyro - self.rolling[:, 2]) * spec.base_radius / self.size.clip(min=REST_SPEED)
            columns.append(np.stack([gyro, slip], axis=1))
        return np.concatenate(columns, axis=1)

    def _channel(self, name: Channel) -> Float[np.ndarray, "window *of"]:
        """Return the values of a channel in all windows; ValueError if a run lacks it."""
        for run in self.signals:
            if getattr(run, name) is None:
                raise ValueError(
                    f"{run.name}: no {name}, but the training runs have one; expected it in every "
                    "run"
                )
        return np.concatenate([getattr(run, name) for run in self.signals])


@dataclass(frozen=True, eq=False)
class SlipExamples:
    """Training windows in which the wheels turn, with true slip ratios from the poses.

    Attributes:
        windows: all windows; the other attributes have rows only for windows with turning wheels.
        channels: channels that every run has and whose inputs are used.
        inputs: inputs of the learned methods.
        ratio: true slip ratio.
        weight: weight of each window; the mean of all weights is one.
        run: index of the run of each window.
        floor: name of the floor of each window.
    """

    windows: SignalWindows
    channels: frozenset[Channel]
    inputs: Inputs
    ratio: Ratios
    weight: Float[np.ndarray, " window"]
    run: Int[np.ndarray, " window"]
    floor: np.ndarray

    @classmethod
    def of(cls, runs: Sequence[Run], spec: RobotSpec) -> "SlipExamples":
        """Return the training windows of runs with poses.

        Raises:
            ValueError: the wheels turn in no window.
        """
        channels, windows = common(runs), SignalWindows.of([run.signals for run in runs], spec)
        moving = windows.moving
        if not moving.any():
            raise ValueError(
                "no window of the runs has turning wheels; expected runs in which the robot drives"
            )
        size = windows.size[moving]
        true = np.concatenate([run.windowed().twist for run in runs])
        return cls(
            windows=windows,
            channels=channels,
            inputs=windows.inputs(spec, channels)[moving],
            ratio=(true - windows.rolling)[moving] * spec.size / size[:, None],
            weight=weight_of(size),
            run=windows.run[moving],
            floor=np.array([run.floor for run in runs])[windows.run[moving]],
        )


@dataclass(frozen=True, eq=False)
class LearnedSlip(SlipModel, abc.ABC):
    """Slip model by a regression of the slip ratio on the inputs of windows.

    Attributes:
        channels: channels of the inputs besides the encoders.
        regressor: fitted regression of the slip ratio's three components; None before a fit.
    """

    channels: frozenset[Channel] = field(default=frozenset(), kw_only=True)
    regressor: Regressor | None = field(default=None, kw_only=True)

    @abc.abstractmethod
    def trained(self, examples: SlipExamples) -> Self:
        """Return the model with its regression fitted to the training windows."""

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> Self:
        examples = SlipExamples.of(runs, spec)
        with one_thread():
            return replace(self.trained(examples), channels=examples.channels)

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        if self.regressor is None:
            raise ValueError(f"{self.name} was not fitted; expected a call of fit before predict")
        windows = SignalWindows.of(runs, spec)
        with one_thread():
            ratio = self.regressor.predict(windows.inputs(spec, self.channels))
        return with_slip(runs, windows, ratio, spec)


@dataclass(frozen=True, eq=False)
class Scale:
    """Standardisation of columns to mean 0 and standard deviation 1 on the training rows.

    Values outside the training range are clipped to it: polynomials and networks do not
    extrapolate sensibly.

    Attributes:
        mean: mean of each column.
        std: standard deviation of each column; one where a column is constant.
        low: smallest training value.
        high: largest training value.
    """

    mean: Float[np.ndarray, " column"]
    std: Float[np.ndarray, " column"]
    low: Float[np.ndarray, " column"]
    high: Float[np.ndarray, " column"]

    @classmethod
    def of(cls, x: Float[np.ndarray, "row column"]) -> "Scale":
        """Return the standardisation of the columns of these training rows."""
        std = x.std(axis=0)
        # compare with a tolerance: rounding errors make the std of a constant column nonzero
        flat = std <= 1e-9 * np.abs(x).max(axis=0)
        return cls(x.mean(axis=0), np.where(flat, 1.0, std), x.min(axis=0), x.max(axis=0))

    def scaled(self, x: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "row column"]:
        """Return clipped and standardised values."""
        return np.asarray((x.clip(self.low, self.high) - self.mean) / self.std)

    def back(self, x: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "row column"]:
        """Return standardised values in original units, clipped to the training range."""
        return np.asarray((x * self.std + self.mean).clip(self.low, self.high))


def common(runs: Sequence[Run]) -> frozenset[Channel]:
    """Return the channels that all runs have, other than encoders."""
    every: tuple[Channel, ...] = ("current", "gyro", "command")
    return frozenset(
        name for name in every if all(getattr(run.signals, name) is not None for run in runs)
    )


def weight_of(size: Float[np.ndarray, " window"]) -> Float[np.ndarray, " window"]:
    """Return the weights of windows with rolling twists of these sizes; their mean is one."""
    weight = size**2 / (size**2 + (0.5 * np.median(size)) ** 2)
    return np.asarray(weight / weight.mean())


def with_slip(
    runs: Sequence[RunSignals], windows: SignalWindows, ratio: Ratios, spec: RobotSpec
) -> list[PredictedRun]:
    """Return predicted paths of runs, integrated from encoders and each window's slip ratio.

    The slip velocity of a window is added to the rolling twist in all of its steps.
    """
    slip = at_steps(ratio * windows.size[:, None] / spec.size, windows, runs)
    return [
        PredictedRun(path_of(run.rolling(spec) + of_run, run.dt))
        for run, of_run in zip(runs, slip, strict=True)
    ]


def at_steps(
    values: Float[np.ndarray, "window value"], windows: SignalWindows, runs: Sequence[RunSignals]
) -> list[Float[np.ndarray, "_ value"]]:
    """Return for every step the value of its window, in one array for each run."""
    ends = np.searchsorted(windows.run, np.arange(len(runs) + 1))
    return [
        np.repeat(values[start:stop], np.diff(groups(run.dt, WINDOW_S), append=len(run)), axis=0)
        for run, (start, stop) in zip(runs, pairwise(ends), strict=True)
    ]
