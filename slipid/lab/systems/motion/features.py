"""What learned methods see of a window of half a second, and what they are taught to say of it.

Inputs of a window, all from what the robot itself measures, means over the window:

    rolling twist (vx, vy, W), as if nothing slipped; speed of each drive
    direction (vx, vy, L W) / size, with size = |(vx, vy, L W)| and L the base radius,
    and its second harmonic ((vx^2 - vy^2), 2 vx vy) / size^2
    |current| of each drive; commanded twist; gyro, and (gyro - W) L / size; each if it was logged

The target is the slip ratio of the body,

    ratio = (true twist - rolling twist) (1, 1, L) / size

It has no unit and hardly depends on the speed where friction does not, so that what was learned at
one speed carries over to others; a target in m/s would not. Noise of the pose is divided by the
size too, so windows count with

    weight ~ size^2 / (size^2 + (typical size / 2)^2)

which rises with the square where that noise dominates, and is level where what the inputs leave
unsaid does; windows in which the wheels rest teach nothing. A ratio is multiplied by the size again
where it is used, so that a robot at rest does not slip.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.predict.slip_model import (
    WINDOW_S,
    Channel,
    PredictedRun,
    RobotSpec,
    Run,
    RunSignals,
    Twists,
    groups,
    path_of,
)

REST = 0.02
"""Size of a rolling twist below which a robot is as good as at rest [m/s]."""

Inputs = Float[np.ndarray, "window input"]
Ratios = Float[np.ndarray, "window 3"]
"""Slip ratio of the body in each window: ahead, to the left, turning."""


@runtime_checkable
class Regressor(Protocol):
    """What is used of scikit-learn's fitted regressors."""

    def predict(self, X: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True, eq=False)
class SignalWindows:
    """Windows of several runs, one run after the other.

    Attributes:
        heard: each run in windows.
        rolling: body twist if nothing slips.
        size: of the rolling twist [m/s], a yaw rate counted as the speed at the base radius.
        run: number of the run that each window is of.
    """

    signals: Sequence[RunSignals]
    rolling: Twists
    size: Float[np.ndarray, " window"]
    run: Int[np.ndarray, " window"]

    @classmethod
    def of(cls, runs: Sequence[RunSignals], spec: RobotSpec) -> "SignalWindows":
        """Of runs in their own steps."""
        return cls.joined([run.windowed() for run in runs], spec)

    @classmethod
    def joined(cls, joined: Sequence[RunSignals], spec: RobotSpec) -> "SignalWindows":
        """Of runs whose steps are windows already."""
        rolling = _stacked([run.rolling(spec) for run in joined])
        size = np.sqrt(((rolling * spec.size) ** 2).sum(axis=1))
        return cls(joined, rolling, size, np.repeat(np.arange(len(joined)), [*map(len, joined)]))

    @property
    def moves(self) -> Bool[np.ndarray, " window"]:
        """Whether the wheels turn fast enough to tell anything."""
        return self.size >= REST

    def direction(self, spec: RobotSpec) -> Float[np.ndarray, "window 3"]:
        """Rolling twist over its size: ahead, to the left, turning."""
        return np.asarray(self.rolling * spec.size / self.size.clip(min=REST)[:, None])

    def speed(self) -> Float[np.ndarray, "window drive"]:
        """Wheel speed of each drive [rad/s]."""
        return _stacked([run.speed for run in self.signals])

    def amperes(self) -> Float[np.ndarray, "window drive"]:
        """Magnitude of each drive's current [A]."""
        return np.abs(_stacked([_logged(run.current, run, "current") for run in self.signals]))

    def inputs(self, spec: RobotSpec, channels: frozenset[Channel]) -> Inputs:
        """All inputs, with those of the channels named.

        Raises:
            ValueError: a run lacks one of the channels.
        """
        direction = self.direction(spec)
        x, y = direction[:, 0], direction[:, 1]
        columns = [self.rolling, self.speed(), direction, np.stack([x * x - y * y, 2 * x * y], 1)]
        if "current" in channels:
            columns.append(self.amperes())
        if "command" in channels:
            columns.append(_stacked([_logged(run.command, run, "command") for run in self.signals]))
        if "gyro" in channels:
            gyro = _stacked([_logged(run.gyro, run, "gyro")[:, None] for run in self.signals])[:, 0]
            slip = (gyro - self.rolling[:, 2]) * spec.base_radius / self.size.clip(min=REST)
            columns.append(np.stack([gyro, slip], axis=1))
        return np.concatenate(columns, axis=1)


@dataclass(frozen=True, eq=False)
class SlipExamples:
    """Windows in which wheels turned, with the slip that the pose shows in them.

    Attributes:
        windows: all of them; the rows of the rest are those that move.
        channels: that every run has, and whose inputs are used.
        weight: of each window; the mean is one.
        run: number of the run that each window is of.
    """

    windows: SignalWindows
    channels: frozenset[Channel]
    inputs: Inputs
    ratio: Ratios
    weight: Float[np.ndarray, " window"]
    run: Int[np.ndarray, " window"]

    @classmethod
    def of(cls, runs: Sequence[Run], spec: RobotSpec) -> "SlipExamples":
        """Of runs with poses.

        Raises:
            ValueError: the wheels turn in no window of them.
        """
        joined, channels = [run.windowed() for run in runs], common(runs)
        windows = SignalWindows.joined([run.signals for run in joined], spec)
        moves = windows.moves
        if not moves.any():
            raise ValueError("no window of the runs has turning wheels; nothing to learn from")
        size = windows.size[moves]
        slip = (_stacked([run.twist for run in joined]) - windows.rolling)[moves]
        return cls(
            windows=windows,
            channels=channels,
            inputs=windows.inputs(spec, channels)[moves],
            ratio=slip * spec.size / size[:, None],
            weight=weight_of(size),
            run=windows.run[moves],
        )


@dataclass(frozen=True, eq=False)
class Scale:
    """Makes columns comparable: mean zero and standard deviation one where it was taken.

    Values beyond those that were seen are taken for the nearest seen: polynomials and networks say
    nothing sensible far away from where they were taught.
    """

    mean: Float[np.ndarray, " column"]
    std: Float[np.ndarray, " column"]
    low: Float[np.ndarray, " column"]
    high: Float[np.ndarray, " column"]

    @classmethod
    def of(cls, x: Float[np.ndarray, "row column"]) -> "Scale":
        std = x.std(axis=0)
        # rounding is no spread: of a column that is constant nothing is left
        flat = std <= 1e-9 * np.abs(x).max(axis=0)
        return cls(x.mean(axis=0), np.where(flat, 1.0, std), x.min(axis=0), x.max(axis=0))

    def scaled(self, x: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "row column"]:
        return np.asarray((x.clip(self.low, self.high) - self.mean) / self.std)

    def back(self, x: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "row column"]:
        return np.asarray(x * self.std + self.mean)


def common(runs: Sequence[Run]) -> frozenset[Channel]:
    """Channels beside the encoders that all runs have."""
    every: tuple[Channel, ...] = ("current", "gyro", "command")
    return frozenset(
        name for name in every if all(getattr(run.signals, name) is not None for run in runs)
    )


def weight_of(size: Float[np.ndarray, " window"]) -> Float[np.ndarray, " window"]:
    """How much windows of these sizes count, with a mean of one."""
    weight = size**2 / (size**2 + (0.5 * np.median(size)) ** 2)
    return np.asarray(weight / weight.mean())


def with_slip(
    runs: Sequence[RunSignals], windows: SignalWindows, ratio: Ratios, spec: RobotSpec
) -> list[PredictedRun]:
    """Paths of runs at their own steps: the encoders', with the slip that is said of each window.

    A window's slip velocity holds for all of its steps.
    """
    slip = at_steps(ratio * windows.size[:, None] / spec.size, windows, runs)
    return [
        PredictedRun(path_of(run.rolling(spec) + of_run, run.dt))
        for run, of_run in zip(runs, slip, strict=True)
    ]


def at_steps(
    values: Float[np.ndarray, "window value"], windows: SignalWindows, runs: Sequence[RunSignals]
) -> list[Float[np.ndarray, "_ value"]]:
    """The values of each window, at every step that lies in it; an array for each run."""
    ends = np.searchsorted(windows.run, np.arange(len(runs) + 1))
    return [
        np.repeat(values[start:stop], np.diff(groups(run.dt, WINDOW_S), append=len(run)), axis=0)
        for run, (start, stop) in zip(runs, pairwise(ends), strict=True)
    ]


def _stacked(parts: Sequence[Float[np.ndarray, "_ column"]]) -> Float[np.ndarray, "row column"]:
    return np.concatenate(list(parts))


def _logged(
    values: Float[np.ndarray, "window *of"] | None, run: RunSignals, channel: Channel
) -> Float[np.ndarray, "window *of"]:
    if values is None:
        raise ValueError(f"{run.name}: no {channel}, but there was one in the runs learned from")
    return values
