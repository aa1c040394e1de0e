"""Scores of the benchmark's predictions against poses of held-out runs."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from slipid.lab.benchmark.protocols import base_of
from slipid.lab.benchmark.sets import Over
from slipid.predict.score import chords, clusters, lengths, scores
from slipid.predict.slip_model import (
    WINDOW_S,
    PredictedRun,
    RobotSpec,
    Run,
    body_increments,
    groups,
    path_of,
    relative_to_start,
)
from slipid.support.content import Content

SLIP_THRESHOLD = 0.2
"""A window counts as slipping if the body's twist differs from the twist of the rolling wheels by
more than this fraction of the latter."""
REST_SPEED = 0.02
"""Windows in which the twist of the rolling wheels has at most this norm are not used for slip
detection [m/s]."""


@dataclass(frozen=True)
class RunScore:
    """Errors of a prediction of one run.

    Attributes:
        name: name of the run.
        floor: floor of the run, with the load set-up.
        cluster: index of the cluster of runs with correlated errors, which are left out together.
        endpoint_error: distance between predicted and true end, divided by the true chord or by the
            true path length.
        length_error: relative error of the chord, or of the path length.
        heading_error_deg: magnitude of the heading error at the end, at most 180 [deg].
        twist_error: rms error of the twist over windows, with yaw rates multiplied by the base
            radius [m/s].
        covered90: True if the true end lies in the predicted 90 % region; None without a region.
        scores: slip score of each moving window; higher if the method predicts more slip.
        slips: True for each moving window in which the robot slips.
        floor_right: fraction of the time in which the most probable floor is the true one; None for
            methods without floor probabilities.
        energy_error: relative error of the run's electric energy; None if it is not predicted.
    """

    name: str
    floor: str
    cluster: int
    endpoint_error: float
    length_error: float
    heading_error_deg: float
    twist_error: float
    covered90: bool | None
    scores: Sequence[float]
    slips: Sequence[bool]
    floor_right: float | None
    energy_error: float | None


def scored(run: Run, predicted: PredictedRun, spec: RobotSpec, over: Over) -> RunScore:
    """Return the errors of a prediction of a run; `over` is the denominator of end-point errors."""
    true = relative_to_start(run.pose)
    cov = None if predicted.end_covariance is None else predicted.end_covariance[None]
    (end,) = scores(predicted.path[None], true[None], cov, predicted.freedom)
    first = groups(run.signals.dt, WINDOW_S)
    off, slip, slips = _windows(run, predicted, spec, first)
    return RunScore(
        name=run.signals.name,
        floor=run.floor,
        cluster=int(clusters([float(np.degrees(run.heading))])[0]),
        endpoint_error=end.endpoint_error if over == "chord" else end.endpoint_error_over_path,
        length_error=abs(_length(predicted.path, over) / max(_length(true, over), 1e-9) - 1),
        heading_error_deg=end.heading_error_deg,
        twist_error=off,
        covered90=end.covered90,
        scores=[float(f"{x:.4g}") for x in slip.tolist()],
        slips=slips.tolist(),
        floor_right=_floor_right(run, predicted),
        energy_error=_energy_error(run, predicted, spec),
    )


def _length(path: Float[np.ndarray, "edge 3"], over: Over) -> float:
    """Return the chord or the path length of a path, according to `over` [m]."""
    return (chords if over == "chord" else lengths)(path[None])[0]


def _windows(
    run: Run, predicted: PredictedRun, spec: RobotSpec, first: np.ndarray
) -> tuple[float, Float[np.ndarray, " window"], Bool[np.ndarray, " window"]]:
    """Return the rms twist error [m/s], and slip scores and true slips of the moving windows.

    `first` has the index of the first step of each window.
    """
    edges = np.append(first, len(run.signals))
    dt = np.diff(np.concatenate([[0.0], np.cumsum(run.signals.dt)])[edges])[:, None]
    true = body_increments(run.pose[edges]) / dt * spec.size
    estimate = body_increments(predicted.path[edges]) / dt * spec.size
    # the rolling twist is integrated in the same way as predicted paths, so that the predicted path
    # of encoders has a slip score of exactly 0
    by_wheels = path_of(run.signals.rolling(spec), run.signals.dt)
    rolling = body_increments(by_wheels[edges]) / dt * spec.size
    size = np.linalg.norm(rolling, axis=1)
    moving = size > REST_SPEED
    most = np.maximum(size, REST_SPEED)
    slips = np.linalg.norm(true - rolling, axis=1) > SLIP_THRESHOLD * most
    if predicted.slipping is None:
        score = np.round(np.linalg.norm(estimate - rolling, axis=1) / most, 6)
    else:
        score = np.add.reduceat(predicted.slipping * run.signals.dt, first) / dt[:, 0]
    off = float(np.sqrt(np.mean(np.sum((estimate - true) ** 2, axis=1))))
    return off, score[moving], slips[moving]


def _floor_right(run: Run, predicted: PredictedRun) -> float | None:
    if predicted.floors is None or run.signals.floor is not None or run.floor == "unknown":
        return None
    names = list(predicted.floors)
    best = np.argmax(np.stack([predicted.floors[name] for name in names]), axis=0)
    known = {base_of(name) for name in names}
    # The correct answer for a floor without training runs is "unknown".
    true = base_of(run.floor) if base_of(run.floor) in known else "unknown"
    right = np.array([base_of(names[k]) == true for k in best])
    return float((right * run.signals.dt).sum() / run.signals.dt.sum())


def _energy_error(run: Run, predicted: PredictedRun, spec: RobotSpec) -> float | None:
    if predicted.power is None or run.signals.current is None:
        return None
    spent = float((run.signals.power(spec) * run.signals.dt).sum())
    return abs(float((predicted.power * run.signals.dt).sum()) / max(spent, 1e-9) - 1)


Scored = TypeVar("Scored")


@dataclass(frozen=True)
class FoldScore(Generic[Scored]):
    """Scores of a method in one fold of one protocol, or in several folds.

    Attributes:
        runs: scores of the held-out runs, or answers of a classifier of floors.
        absent: reason why there are no scores: a channel that is missing in these logs, or an
            error; empty if there are scores.
        failed: True if `absent` names an error.
        settings: settings selected by cross-validation, in words.
        numbers: number of fitted parameters.
        tune_s: time to select the settings [s].
        fit_s: time of one fit [s].
        step_us: time to predict one step of one run [microseconds].
        converged: True if the fit converged.
    """

    runs: tuple[Scored, ...] = ()
    absent: str = ""
    failed: bool = False
    settings: str = ""
    numbers: int = 0
    tune_s: float = 0.0
    fit_s: float = 0.0
    step_us: float = 0.0
    converged: bool = True

    @classmethod
    def of_json(cls, content: Content) -> "FoldScore[RunScore]":
        """Return the scores read back from JSON content."""
        runs = tuple(RunScore(**run) for run in content["runs"])
        return FoldScore(**{**content, "runs": runs})

    @classmethod
    def lacking(cls, channels: Iterable[str]) -> "FoldScore":
        """Return the empty result of a method that needs `channels`, which were not logged."""
        words = {"twist": "wheels that drive sideways", "command": "a commanded twist"}
        named = [words.get(name, f"a {name}") for name in sorted(channels)]
        return cls(absent=f"needs {' and '.join(named)}")

    @classmethod
    def of_error(cls, error: Exception) -> "FoldScore":
        """Return the empty result of a method that raised this error."""
        return cls(absent=f"{type(error).__name__}: {error}".splitlines()[0][:300], failed=True)

    @classmethod
    def of_folds(cls, folds: Sequence["FoldScore[Scored]"]) -> "FoldScore[Scored]":
        """Return all scores of a method, with the medians of its costs, but without its settings.

        A method that is absent in one fold is absent altogether, since its mean over the remaining
        folds could not be compared with the means of other methods over all runs.
        """

        def median(name: str) -> float:
            return float(np.median([getattr(fold, name) for fold in folds]))

        if absent := next((fold.absent for fold in folds if fold.absent), ""):
            return cls(absent=absent, failed=any(fold.failed for fold in folds))
        return cls(
            runs=tuple(run for fold in folds for run in fold.runs),
            numbers=int(median("numbers")),
            tune_s=median("tune_s"),
            fit_s=median("fit_s"),
            step_us=median("step_us"),
        )
