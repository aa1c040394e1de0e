"""Steps of many runs in common arrays, and slip models that predict the body twist of each step."""

import abc
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np
from jaxtyping import Float, Int

from slipid.predict.slip_model import (
    WINDOW_S,
    PredictedRun,
    RobotSpec,
    Run,
    RunSignals,
    SlipModel,
    Twists,
    group_means,
    groups,
    path_of,
)


@dataclass(frozen=True, eq=False)
class Steps:
    """The steps of several runs one after the other, so that all are computed at once.

    Attributes:
        signals: all steps as if they were one run; its name and floor are those of the first run.
        first: index of the first step of each run.
        speed_change: wheel speed at the end of each step less that at its start [rad/s], so that d
            turn / d lag = -speed_change; None if the lag of the poses is known.
        lag: assumed lag of the poses behind the wheels [s].
    """

    signals: RunSignals
    first: Int[np.ndarray, " run"]
    speed_change: Float[np.ndarray, "step drive"] | None = None
    lag: float = 0.0

    @classmethod
    def of(cls, runs: Sequence[RunSignals]) -> "Steps":
        """Return all steps of several runs of one robot.

        Raises:
            ValueError: the currents of some runs are signed and those of others are not.
        """
        if len({run.current_is_signed for run in runs}) > 1:
            raise ValueError("currents of some runs are signed; expected all signed or none")
        currents = [run.current for run in runs if run.current is not None]
        gyros = [run.gyro for run in runs if run.gyro is not None]
        signals = replace(
            runs[0],
            dt=np.concatenate([run.dt for run in runs]),
            turn=np.concatenate([run.turn for run in runs]),
            # A channel that is missing in one run is dropped from all of them.
            current=np.concatenate(currents) if len(currents) == len(runs) else None,
            gyro=np.concatenate(gyros) if len(gyros) == len(runs) else None,
            command=None,
        )
        return cls(signals, np.cumsum([0, *(len(run) for run in runs[:-1])]))

    def at_lag(self, lag: float) -> "Steps":
        """Return the steps at another lag [s], to first order.

        They are unchanged if `speed_change` is None.
        """
        if self.speed_change is None:
            return self
        turn = self.signals.turn - (lag - self.lag) * self.speed_change
        return replace(self, signals=replace(self.signals, turn=turn), lag=lag)

    @property
    def length(self) -> Int[np.ndarray, " run"]:
        """Number of steps of each run."""
        return np.diff(self.first, append=len(self.signals))

    def predicted(
        self, twist: Twists, slipping: Float[np.ndarray, " step"] | None = None
    ) -> list[PredictedRun]:
        """Return each run's prediction from the twists and slip scores of all steps."""
        parts = zip(self._runs(twist), self._runs(self.signals.dt), strict=True)
        paths = [path_of(xi, dt) for xi, dt in parts]
        if slipping is None:
            return [PredictedRun(path) for path in paths]
        sure = self._runs(slipping)
        return [PredictedRun(path, slipping=own) for path, own in zip(paths, sure, strict=True)]

    def smoothed(
        self, values: Float[np.ndarray, "step drive"], time_constant: float
    ) -> Float[np.ndarray, "step drive"]:
        """Return each run's values after a first-order low pass, which starts at the first value.

        x~_k = a x~_(k-1) + (1 - a) x_k   with   a = exp(-dt / time constant [s])
        """
        run = np.repeat(np.arange(len(self.first)), self.length)
        step = np.arange(len(values)) - self.first[run]
        shape = len(self.first), int(self.length.max())
        memory, x = np.ones((*shape, 1)), np.zeros((*shape, values.shape[1]))
        memory[run, step, 0] = np.exp(-self.signals.dt / time_constant)
        x[run, step] = values
        # One loop over the steps of the longest run smooths all runs at once.
        for k in range(1, shape[1]):
            x[:, k] += memory[:, k] * (x[:, k - 1] - x[:, k])
        return x[run, step]

    def ends(self, twist: Twists) -> Float[np.ndarray, "run 3"]:
        """Return each run's end pose relative to its start [m, m, rad], given all steps' twists."""
        return np.stack([run.path[-1] for run in self.predicted(twist)])

    def _runs(self, values: np.ndarray) -> list[np.ndarray]:
        """Split the values of all steps into one array per run."""
        return np.split(values, self.first[1:])


@dataclass(frozen=True, eq=False)
class TrainingWindows:
    """Steps of runs, grouped into windows of about half a second, with the measured twist in each.

    The noise of a camera is large over one step. Models are therefore trained on windows: the mean
    of their predictions over the steps of a window is compared with the measured twist.

    Attributes:
        steps: steps of all runs.
        first: index of the first step of each window.
        dt: length of each window [s].
        twist: body twist of each window from the poses [m/s, m/s, rad/s].
        run: index of the run of each window.
    """

    steps: Steps
    first: Int[np.ndarray, " window"]
    dt: Float[np.ndarray, " window"]
    twist: Float[np.ndarray, "window 3"]
    run: Int[np.ndarray, " window"]

    @classmethod
    def of(cls, runs: Sequence[Run]) -> "TrainingWindows":
        """Return the windows of runs."""
        steps = Steps.of([run.signals for run in runs])
        joined = [run.windowed() for run in runs]
        begins = [groups(run.signals.dt, WINDOW_S) for run in runs]
        first = np.concatenate([s + begin for s, begin in zip(steps.first, begins, strict=True)])
        dt = np.concatenate([run.signals.dt for run in joined])
        run = np.repeat(np.arange(len(runs)), [len(begin) for begin in begins])
        return cls(steps, first, dt, np.concatenate([run.twist for run in joined]), run)

    @property
    def signals(self) -> RunSignals:
        """Measurements of the robot, with every window as one step."""
        signals = self.steps.signals
        current = None if signals.current is None else self.means(signals.current)
        turn = np.add.reduceat(signals.turn, self.first)
        return replace(signals, dt=self.dt, turn=turn, current=current, gyro=None, command=None)

    def means(self, values: Float[np.ndarray, "step *any"]) -> Float[np.ndarray, "window *any"]:
        """Return the means of values over the windows, weighted by the length of the steps."""
        return group_means(values, self.steps.signals.dt, self.first)

    def errors(self, twist: Twists, spec: RobotSpec) -> Float[np.ndarray, " row"]:
        """Return the displacement errors of all windows [m], from predicted twists of all steps.

        There are three errors per window; the yaw error is multiplied by the base radius.
        """
        return np.asarray(((self.means(twist) - self.twist) * self._scale(spec)).ravel())

    def _scale(self, spec: RobotSpec) -> Float[np.ndarray, "window 3"]:
        """Return the factor from twists to displacements of every window."""
        return self.dt[:, None] * spec.size

    def rows(
        self, parts: Float[np.ndarray, "step 3 k"], spec: RobotSpec
    ) -> tuple[Float[np.ndarray, "window 3 k"], Float[np.ndarray, "window 3"]]:
        """Return linear equations for the coefficients of a slip model, three for each window.

        For each window, a weighted sum of `parts` equals the encoders' displacement less the
        measured one: sum_k coefficient_k part_k dt = (rolling - twist) dt, with yaw times the base
        radius. The results are part_k dt and the right side [m].
        """
        gap = self.means(self.steps.signals.rolling(spec)) - self.twist
        scale = self._scale(spec)
        return self.means(parts) * scale[..., None], gap * scale


def scaled_least_squares(
    a: Float[np.ndarray, "row k"], b: Float[np.ndarray, " row"]
) -> Float[np.ndarray, " k"]:
    """Return the least-squares solution, computed with columns scaled to unit norm.

    If there are several solutions, the result is the minimum-norm one in scaled coefficients.
    """
    size = np.linalg.norm(a, axis=0)
    # Division by an infinite norm ignores a column that contains only rounding errors.
    size[size <= 1e-12 * size.max(initial=0.0)] = np.inf
    return np.asarray(np.linalg.lstsq(a / size, b, rcond=1e-6)[0] / size)


@dataclass(frozen=True)
class TwistModel(SlipModel, abc.ABC):
    """A slip model that predicts the body twist of every step from the signals of its run.

    Attributes:
        coefficients: fitted coefficients; None before a fit, and for a model that has none.
    """

    learns: ClassVar[bool] = True
    """True if the model has coefficients to fit."""
    by_load: ClassVar[bool] = False
    """True if `slipid compare` fits every load set-up of a floor separately."""
    coefficients: np.ndarray | None = field(default=None, kw_only=True)

    @abc.abstractmethod
    def learn(self, w: TrainingWindows, spec: RobotSpec) -> Self:
        """Return the model fitted to windows."""

    @abc.abstractmethod
    def twist(self, steps: Steps, spec: RobotSpec) -> Twists:
        """Return the body twist of every step [m/s, m/s, rad/s]."""

    def stiffness(self, w: TrainingWindows, spec: RobotSpec) -> Float[np.ndarray, "k k"]:
        """Return the precision of the flattened coefficients that ridges and bounds contribute."""
        return np.zeros((self.numbers, self.numbers))

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> "TwistModel":
        return self.learn(TrainingWindows.of(runs), spec) if self.learns else self

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        steps = Steps.of(runs)
        return steps.predicted(self.twist(steps, spec))

    @property
    def numbers(self) -> int:
        return 0 if self.coefficients is None else self.coefficients.size

    @property
    def known(self) -> np.ndarray:
        """The fitted coefficients.

        Raises:
            ValueError: the model is not fitted.
        """
        if self.coefficients is None:
            raise ValueError(f"{self.name}: not fitted; call `fit` first")
        return self.coefficients
