"""Ojeda et al. 2006: rim speeds are corrected by motor currents while all wheels slip.

    dv_i = k0 + k1 I~_i         |v_i| <- max(|v_i| - dv_i, 0)     while all-wheel slip is flagged
    flagged where mean_i I~_i > mean + 3 sigma of the hard floor,  xi = back v

v_i is the rim speed of drive i by its encoder, I~_i its current after a first-order low pass, xi
the corrected twist of the body and `back` the matrix from rim speeds to the twist. k0 and k1 belong
to a floor, are shared by all wheels, and are fitted in one of three ways:

    ojeda_continuous   the pose is known all the time: recursive least squares in the body's
                       displacement in windows of half a second, forgetting factor 0.995
    ojeda_sporadic     the position is known occasionally: least squares in the position at the end
                       of each segment, here each run, relative to its start
    ojeda_gyro         no pose: least squares in the encoders' yaw rate less the gyro's

The hard floor is the training floor on which encoders have the smallest errors. The threshold for
slip comes from the currents on the hard floor and is used on all floors. If all training runs are
on one floor, the quarter of the runs with the smallest encoder errors replaces the hard floor;
little slip is flagged then.

The method handles floors itself: it has k0 and k1 for each training floor, and a pair fitted to all
runs for runs whose floor is not given or was not trained. Tuned: the low pass's time constant.

Liberties:
    - The equations are restated, not copied: the length of windows, the prior variance, the order
      of the runs and the solvers are ours. The authors' correction for the pitch of the ground does
      not apply here and is omitted.
    - The original corrects the velocity of rovers along their direction of motion; here the rim
      speed of each drive is corrected, which also works for omni robots. A correction never
      reverses a wheel.
    - Statistics of the hard floor are over all steps in which the robot moves, in any direction.
      The hard floor is found from training poses, also for `ojeda_gyro`.
    - `ojeda_continuous` learns online in the order of the runs, as published, and stops after the
      last run. A forgetting factor of 0.995 per window keeps about the last 100 s of flagged slip.
    - In `ojeda_sporadic` the end position is not linear in k0 and k1; it is fitted by a trust
      region method. The heading comes from the corrected rim speeds.
    - If the gyro does not identify both k0 and k1 (straight runs of a skid steer), dv is zero at
      the hard floor's mean current.
    - The slip score `slipping` is the excess of the mean current over the hard floor's mean, in
      sigma.

Source: Ojeda, Cruz, Reina, Borenstein 2006, "Current-Based Slippage Detection and Odometry
Correction for Mobile Robots and Planetary Rovers", IEEE Transactions on Robotics 22(2).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, final

import numpy as np
from jaxtyping import Bool, Float

from slipid.predict.slip_model import (
    Channel,
    PredictedRun,
    RobotSpec,
    Run,
    RunSignals,
    SlipModel,
    Twists,
    relative_to_start,
)
from slipid.predict.steps import Steps, TrainingWindows, scaled_least_squares

Line = Float[np.ndarray, "2"]
"""Coefficients k0 [m/s] and k1 [m/s/A] of the correction."""
Tuning = Literal["continuous", "sporadic", "gyro"]
FORGETTING = 0.995
"""Factor by which the weight of a window falls with each later window."""
SLIP_SIGMAS = 3.0
"""Slip is flagged if the wheels' mean current exceeds its mean on the hard floor by more than this
multiple of its standard deviation there."""
LEAST_RIM_SPEED = 0.02
"""Mean rim speed above which the robot counts as moving [m/s]."""
PRIOR_VARIANCE = 1e6
"""Prior variance of k0 [m^2/s^2] and k1 [m^2/s^2/A^2], so large that it has almost no effect."""


@dataclass(frozen=True)
class HardFloor:
    """Mean and std over time of the wheels' mean smoothed current on the hard floor [A]."""

    mean: float
    std: float

    def sigmas(self, current: Float[np.ndarray, "step drive"]) -> Float[np.ndarray, " step"]:
        """Return the excess of the wheels' mean current over the hard floor's mean, in std."""
        return np.asarray((current.mean(axis=1) - self.mean) / self.std)


@dataclass(frozen=True, eq=False)
class FlaggedSteps:
    """Steps of some runs with smoothed currents and slip flags.

    Attributes:
        steps: steps of the runs.
        rim: rim speed of each drive [m/s].
        current: smoothed current of each drive [A].
        flagged: True in steps in which all wheels are flagged as slipping.
    """

    steps: Steps
    rim: Float[np.ndarray, "step drive"]
    current: Float[np.ndarray, "step drive"]
    flagged: Bool[np.ndarray, " step"]

    def features(self, middle: float = 0.0) -> Float[np.ndarray, "step drive 2"]:
        """Return derivatives of each rim speed's reduction with respect to k0 and k1.

        `middle` [A] is subtracted from currents; k0 is then the reduction at this current.
        """
        sign = np.sign(self.rim) * self.flagged[:, None]
        return np.stack([sign, sign * (self.current - middle)], axis=-1)

    def twist(self, line: Float[np.ndarray, "*step 2"], spec: RobotSpec) -> Twists:
        """Return the corrected body twist of every step.

        `line` has k0 and k1, either one pair for all steps or one for each step.
        """
        less = self.flagged[:, None] * (line[..., :1] + line[..., 1:] * self.current)
        rim = np.sign(self.rim) * np.maximum(np.abs(self.rim) - less, 0.0)
        return np.asarray(rim @ spec.back.T)


@final
@dataclass(frozen=True)
class Ojeda(SlipModel):
    """Slip correction by currents, as the module's docstring describes it.

    Attributes:
        tuning: one of the three ways to fit k0 and k1.
        time_constant: time constant of the low pass [s].
        hard: currents on the hard floor; None before a fit.
        lines: k0 and k1 keyed by floor; the pair under the key None is for unknown floors.
    """

    tuning: Tuning = "continuous"
    needs: frozenset[Channel] = field(default=frozenset({"current"}), kw_only=True)
    time_constant: float = 0.3
    hard: HardFloor | None = None
    lines: Mapping[str | None, Float[np.ndarray, "2"]] = field(default_factory=dict)

    def candidates(self) -> Sequence["Ojeda"]:
        return [replace(self, time_constant=seconds) for seconds in (0.3, 1.0)]

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> "Ojeda":
        hard = self._hard(hard_runs(runs, spec), spec)
        lines: dict[str | None, Line] = {None: self._line(runs, hard, spec)}
        floors = list(dict.fromkeys(run.floor for run in runs))
        for floor in floors if len(floors) > 1 else ():
            lines[floor] = self._line([run for run in runs if run.floor == floor], hard, spec)
        return replace(self, hard=hard, lines=lines)

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        if self.hard is None:
            raise ValueError(f"{self.name} was not fitted; expected a call of fit before predict")
        flagged = self._flagged(runs, self.hard, spec)
        line = np.stack([self.lines.get(run.floor, self.lines[None]) for run in runs])
        twist = flagged.twist(np.repeat(line, flagged.steps.length, axis=0), spec)
        return flagged.steps.predicted(twist, self.hard.sigmas(flagged.current))

    @property
    def numbers(self) -> int:
        return 2 * len(self.lines) + 2 * (self.hard is not None)

    def _hard(self, runs: Sequence[Run], spec: RobotSpec) -> HardFloor:
        steps = Steps.of([run.signals for run in runs])
        current = steps.smoothed(steps.signals.along(spec), self.time_constant).mean(axis=1)
        moving = np.abs(steps.signals.speed).mean(axis=1) * spec.wheel_radius > LEAST_RIM_SPEED
        used = current[moving] if moving.any() else current
        return HardFloor(float(used.mean()), max(float(used.std()), 1e-6))

    def _flagged(
        self, runs: Sequence[RunSignals], hard: HardFloor, spec: RobotSpec
    ) -> FlaggedSteps:
        steps = Steps.of(runs)
        rim = steps.signals.speed * spec.wheel_radius
        current = steps.smoothed(steps.signals.along(spec), self.time_constant)
        return FlaggedSteps(steps, rim, current, hard.sigmas(current) > SLIP_SIGMAS)

    def _line(self, runs: Sequence[Run], hard: HardFloor, spec: RobotSpec) -> Line:
        """Return k0 [m/s] and k1 [m/s/A] fitted to runs; zeros if no slip was flagged."""
        steps = self._flagged([run.signals for run in runs], hard, spec)
        if not steps.flagged.any():
            return np.zeros(2)
        if self.tuning == "sporadic":
            return sporadic(steps, runs, spec)
        w = TrainingWindows.of(runs)
        if self.tuning == "continuous":
            parts, gap = w.rows(spec.back @ steps.features(), spec)
            used = parts.any(axis=(1, 2))
            return forgetful(parts[used], gap[used], FORGETTING, PRIOR_VARIANCE)
        return by_gyro(steps, w, hard.mean, spec)


def hard_runs(runs: Sequence[Run], spec: RobotSpec) -> list[Run]:
    """Return the runs on the floor on which encoders have the smallest mean error.

    If all runs are on one floor, return the quarter of them with the smallest errors.
    """
    steps = Steps.of([run.signals for run in runs])
    rolling = steps.signals.rolling(spec)
    gap = np.linalg.norm((steps.ends(rolling) - true_ends(runs)) * spec.size, axis=1)
    length = np.linalg.norm(rolling * spec.size, axis=1) * steps.signals.dt
    error = gap / np.maximum(np.add.reduceat(length, steps.first), 1e-9)
    floors = np.array([run.floor for run in runs])
    names = list(dict.fromkeys(floors.tolist()))
    if len(names) > 1:
        hard = min(names, key=lambda name: float(error[floors == name].mean()))
        return [run for run in runs if run.floor == hard]
    best = np.argsort(error)[: max(1, round(0.25 * len(runs)))]
    return [runs[k] for k in best]


def true_ends(runs: Sequence[Run]) -> Float[np.ndarray, "run 3"]:
    """Return the pose at each run's end relative to its start [m, m, rad]."""
    return np.stack([relative_to_start(run.pose)[-1] for run in runs])


def forgetful(
    parts: Float[np.ndarray, "window row k"],
    gap: Float[np.ndarray, "window row"],
    forgetting: float,
    variance: float,
) -> Float[np.ndarray, " k"]:
    """Return the result of recursive least squares with forgetting.

    The recursion starts at zero with the given prior variance. For N windows, its result is the
    minimiser k of sum_n forgetting^(N-1-n) |parts_n k - gap_n|^2 + forgetting^N |k|^2 / variance,
    which is computed directly.
    """
    count = len(gap)
    weight = np.repeat(forgetting ** (0.5 * np.arange(count - 1, -1, -1)), gap.shape[1])
    a, b = parts.reshape(-1, parts.shape[2]) * weight[:, None], gap.ravel() * weight
    prior = forgetting**count / variance * np.eye(a.shape[1])
    return np.linalg.solve(a.T @ a + prior, a.T @ b)


def sporadic(steps: FlaggedSteps, runs: Sequence[Run], spec: RobotSpec) -> Line:
    """Return k0 and k1 fitted to the position at the end of each run."""
    from scipy.optimize import least_squares

    place = true_ends(runs)[:, :2]

    def gap(line: np.ndarray) -> np.ndarray:
        return np.asarray((steps.steps.ends(steps.twist(line, spec))[:, :2] - place).ravel())

    return np.asarray(least_squares(gap, np.zeros(2), x_scale="jac").x)


def by_gyro(steps: FlaggedSteps, w: TrainingWindows, middle: float, spec: RobotSpec) -> Line:
    """Return k0 and k1 fitted only to yaw rates; `middle` is the hard floor's mean current [A].

    Raises:
        ValueError: the signals have no gyro.
    """
    signals = steps.steps.signals
    if signals.gyro is None:
        raise ValueError(f"{signals.name}: no gyro; expected a logged gyro for this method")
    parts = w.means(spec.back[2] @ steps.features(middle)) * w.dt[:, None]
    gap = w.means(signals.rolling(spec)[:, 2] - signals.gyro) * w.dt
    offset, gain = scaled_least_squares(parts, gap)
    return np.array([offset - gain * middle, gain])


def ojeda_rows() -> list[SlipModel]:
    """Return the three rows of this method, unfitted."""
    return [
        Ojeda("ojeda_continuous", "continuous"),
        Ojeda("ojeda_sporadic", "sporadic"),
        Ojeda("ojeda_gyro", "gyro", needs=frozenset({"current", "gyro"})),
    ]
