"""Ojeda et al. 2006: rim speeds corrected by motor currents wherever all wheels slip.

    dv_i = k0 + k1 I~_i         |v_i| <- max(|v_i| - dv_i, 0)     while all-wheel slip is flagged
    flagged where mean_i I~_i > mean + 3 sigma of the hard floor,  xi = back v

v_i is the rim speed of a drive by its encoder, I~_i the current through a first-order low pass.
The two numbers are those of a floor, shared by all wheels, and found in one of three ways:

    ojeda_continuous   the pose is known all the time: recursive least squares in the body's
                       displacement, window by window of half a second, forgetting 0.995
    ojeda_sporadic     the place is known now and then: least squares in the place at the end of
                       each segment, here each run, seen from its start
    ojeda_gyro         no pose: least squares in the encoders' yaw rate less the gyro's

The hard floor is the one among the training floors on which encoders err least; the currents on it
are known to all floors, as if they had been measured once before. If all training runs are on one
floor, which says nothing about a harder one, it is the quarter of the runs in which encoders err
least: then little is flagged.

So it treats floors itself: two numbers for each floor that it was trained on, and two from all runs
together where the floor is not told or not known. Tuned: the low pass's time constant.

Liberties:
    - The equations are restated, not copied: length of a window, variance before learning, order of
      the runs and solvers are ours. The authors' correction for the pitch of the ground has nothing
      to do here and is left out.
    - The original corrects rovers along their direction of motion; here every drive is corrected
      along its own, so that omni robots are too. A wheel is never turned backwards.
    - Statistics of the hard floor are over all steps in which the robot moves, in any direction.
      Which floor is hard is told by training poses, also to `ojeda_gyro`.
    - `ojeda_continuous` learns online in the order in which runs come, as published, and stops
      learning after the last: 0.995 per window remembers the last 100 s that were flagged.
    - `ojeda_sporadic` solves for the place after integration, which is not linear, by a trust
      region; it uses the heading of the corrected wheels.
    - Where the gyro does not tell both numbers (straight runs of a skid steer), dv is zero at the
      hard floor's mean current.
    - `slipping` is how many sigma the mean current is above the hard floor's mean.

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
"""k0 [m/s] and k1 [m/s/A]."""
Tuning = Literal["continuous", "sporadic", "gyro"]
FORGETTING = 0.995
SIGMAS = 3.0
"""Above the hard floor's mean, where slip is flagged."""
MOVING = 0.02
"""Mean rim speed above which the robot moves [m/s]."""
PRIOR = 1e6
"""Variance of the two numbers before anything is learnt, in their own units."""


@dataclass(frozen=True)
class HardFloor:
    """Mean and std over time of the wheels' mean smoothed current on the hard floor [A]."""

    mean: float
    std: float

    def sigmas(self, current: Float[np.ndarray, "step drive"]) -> Float[np.ndarray, " step"]:
        """How far the wheels' mean current is above the hard floor's, in its stds."""
        return np.asarray((current.mean(axis=1) - self.mean) / self.std)


@dataclass(frozen=True, eq=False)
class FlaggedSteps:
    """What is computed of some runs before the two numbers come in.

    Attributes:
        rim: rim speed of each drive [m/s].
        current: smoothed [A].
        flagged: where all wheels slip.
    """

    steps: Steps
    rim: Float[np.ndarray, "step drive"]
    current: Float[np.ndarray, "step drive"]
    flagged: Bool[np.ndarray, " step"]

    def features(self, middle: float = 0.0) -> Float[np.ndarray, "step drive 2"]:
        """What k0 and k1 take from each rim speed; currents count from the middle [A]."""
        way = np.sign(self.rim) * self.flagged[:, None]
        return np.stack([way, way * (self.current - middle)], axis=-1)

    def twist(self, line: Float[np.ndarray, "*step 2"], spec: RobotSpec) -> Twists:
        """Corrected body twist of every step by k0 and k1, one pair or one in each step."""
        less = self.flagged[:, None] * (line[..., :1] + line[..., 1:] * self.current)
        rim = np.sign(self.rim) * np.maximum(np.abs(self.rim) - less, 0.0)
        return np.asarray(rim @ spec.back.T)


@final
@dataclass(frozen=True)
class Ojeda(SlipModel):
    """See the head of this module; do not fit it floor by floor, it does that itself.

    Attributes:
        tuning: which of the three ways.
        time_constant: of the low pass [s].
        hard: the hard floor, once fitted.
        lines: the two numbers of each floor, None for floors unknown.
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
            raise ValueError(f"{self.name}: not fitted")
        scene = self._scene(runs, self.hard, spec)
        line = np.stack([self.lines.get(run.floor, self.lines[None]) for run in runs])
        twist = scene.twist(np.repeat(line, scene.steps.length, axis=0), spec)
        return scene.steps.predicted(twist, self.hard.sigmas(scene.current))

    @property
    def numbers(self) -> int:
        return 2 * len(self.lines) + 2 * (self.hard is not None)

    def _hard(self, runs: Sequence[Run], spec: RobotSpec) -> HardFloor:
        steps = Steps.of([run.signals for run in runs])
        current = steps.smoothed(steps.signals.along(spec), self.time_constant).mean(axis=1)
        moves = np.abs(steps.signals.speed).mean(axis=1) * spec.wheel_radius > MOVING
        seen = current[moves] if moves.any() else current
        return HardFloor(float(seen.mean()), max(float(seen.std()), 1e-6))

    def _scene(self, runs: Sequence[RunSignals], hard: HardFloor, spec: RobotSpec) -> FlaggedSteps:
        steps = Steps.of(runs)
        rim = steps.signals.speed * spec.wheel_radius
        current = steps.smoothed(steps.signals.along(spec), self.time_constant)
        return FlaggedSteps(steps, rim, current, hard.sigmas(current) > SIGMAS)

    def _line(self, runs: Sequence[Run], hard: HardFloor, spec: RobotSpec) -> Line:
        """k0 [m/s] and k1 [m/s/A] of some runs; zero where no slip was flagged."""
        scene = self._scene([run.signals for run in runs], hard, spec)
        if not scene.flagged.any():
            return np.zeros(2)
        if self.tuning == "sporadic":
            return sporadic(scene, runs, spec)
        w = TrainingWindows.of(runs)
        if self.tuning == "continuous":
            return continuous(scene, w, spec)
        return by_gyro(scene, w, hard.mean, spec)


def hard_runs(runs: Sequence[Run], spec: RobotSpec) -> list[Run]:
    """Those on the floor where encoders err least; of one floor, the quarter that errs least."""
    steps = Steps.of([run.signals for run in runs])
    rolling = steps.signals.rolling(spec)
    gap = np.linalg.norm((steps.ends(rolling) - true_ends(runs)) * spec.size, axis=1)
    way = np.linalg.norm(rolling * spec.size, axis=1) * steps.signals.dt
    error = gap / np.maximum(np.add.reduceat(way, steps.first), 1e-9)
    floors = np.array([run.floor for run in runs])
    names = list(dict.fromkeys(floors.tolist()))
    if len(names) > 1:
        hard = min(names, key=lambda name: float(error[floors == name].mean()))
        return [run for run in runs if run.floor == hard]
    best = np.argsort(error)[: max(1, round(0.25 * len(runs)))]
    return [runs[k] for k in best]


def true_ends(runs: Sequence[Run]) -> Float[np.ndarray, "run 3"]:
    """Pose at each run's end, seen from its start [m, m, rad]."""
    return np.stack([relative_to_start(run.pose)[-1] for run in runs])


def continuous(scene: FlaggedSteps, w: TrainingWindows, spec: RobotSpec) -> Line:
    """By the pose at all times; only windows with slip flagged count."""
    rows = w.rows(spec.back @ scene.features(), spec)
    told = rows.parts.any(axis=(1, 2))
    return forgetful(rows.parts[told], rows.gap[told], FORGETTING, PRIOR)


def forgetful(
    parts: Float[np.ndarray, "window row k"],
    gap: Float[np.ndarray, "window row"],
    forgetting: float,
    variance: float,
) -> Float[np.ndarray, " k"]:
    """Where recursive least squares that forgets ends, if it starts from zero with a variance.

    Of N windows that is the least of sum_n forgetting^(N-1-n) |parts_n k - gap_n|^2
    + forgetting^N |k|^2 / variance, which needs no recursion.
    """
    count = len(gap)
    weight = np.repeat(forgetting ** (0.5 * np.arange(count - 1, -1, -1)), gap.shape[1])
    a, b = parts.reshape(-1, parts.shape[2]) * weight[:, None], gap.ravel() * weight
    prior = forgetting**count / variance * np.eye(a.shape[1])
    return np.linalg.solve(a.T @ a + prior, a.T @ b)


def sporadic(scene: FlaggedSteps, runs: Sequence[Run], spec: RobotSpec) -> Line:
    """By the place at the end of each run."""
    from scipy.optimize import least_squares

    place = true_ends(runs)[:, :2]

    def gap(line: np.ndarray) -> np.ndarray:
        return np.asarray((scene.steps.ends(scene.twist(line, spec))[:, :2] - place).ravel())

    return np.asarray(least_squares(gap, np.zeros(2), x_scale="jac").x)


def by_gyro(scene: FlaggedSteps, w: TrainingWindows, middle: float, spec: RobotSpec) -> Line:
    """By the yaw rate alone; the middle is the hard floor's mean current [A]."""
    heard = scene.steps.signals
    if heard.gyro is None:
        raise ValueError(f"{heard.name}: no gyro; this method needs one")
    parts = w.means(spec.back[2] @ scene.features(middle)) * w.dt[:, None]
    gap = w.means(heard.rolling(spec)[:, 2] - heard.gyro) * w.dt
    offset, gain = scaled_least_squares(parts, gap)
    return np.array([offset - gain * middle, gain])


def ojeda_rows() -> list[SlipModel]:
    """The three rows, unfitted."""
    return [
        Ojeda("ojeda_continuous", "continuous"),
        Ojeda("ojeda_sporadic", "sporadic"),
        Ojeda("ojeda_gyro", "gyro", needs=frozenset({"current", "gyro"})),
    ]
