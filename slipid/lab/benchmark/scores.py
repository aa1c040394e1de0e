"""Scores of the benchmark's predictions, against poses that the models have not seen.

What a row of the benchmark came to in one fold, or why it is not there.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

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

SLIPS = 0.2
"""A robot slips where its twist is off that of its wheels by more than this part of the latter."""
STANDS = 0.02
"""Rim speed below which a window says nothing of slip [m/s]."""


@dataclass(frozen=True)
class RunScore:
    """Errors of a prediction of one run.

    Attributes:
        name, floor: of the run; the floor with the load set-up.
        cluster: runs of one cluster share their errors.
        endpoint_error: distance of predicted and true end over the chord, or over the path.
        length_error: relative, of the chord, or of the path driven.
        heading_error_deg: at the end, at most 180.
        twist_error: rms of the windows' twist errors, a yaw rate times the base radius [m/s].
        covered90: whether the end lies in the 90 % region; None without one.
        scores, slips: of each window, how sure the method is of slip, and whether there was any.
        floor_right: part of the time in which the most probable floor was the right one; None of
            methods that tell no floors.
        energy_error: of the whole run's electric energy, relative; None where it is not predicted.
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

    def to_json(self) -> Content:
        return asdict(self)


def scored(run: Run, said: PredictedRun, spec: RobotSpec, over: Over) -> RunScore:
    """Score of a prediction of a run."""
    true = relative_to_start(run.pose)
    cov = None if said.end_covariance is None else said.end_covariance[None]
    (end,) = scores(said.path[None], true[None], cov, said.freedom)
    first = groups(run.signals.dt, WINDOW_S)
    off, slip, slips = _windows(run, said, spec, first)
    return RunScore(
        name=run.signals.name,
        floor=run.floor,
        cluster=int(clusters([float(np.degrees(run.heading))])[0]),
        endpoint_error=end.endpoint_error if over == "chord" else end.endpoint_error_over_path,
        length_error=abs(_length(said.path, over) / max(_length(true, over), 1e-9) - 1),
        heading_error_deg=end.heading_error_deg,
        twist_error=off,
        covered90=end.covered90,
        scores=[float(f"{x:.4g}") for x in slip.tolist()],
        slips=slips.tolist(),
        floor_right=_floor_right(run, said),
        energy_error=_energy_error(run, said, spec),
    )


def _length(path: Float[np.ndarray, "edge 3"], over: Over) -> float:
    """Straight-line displacement, or length of the path [m]."""
    return (chords if over == "chord" else lengths)(path[None])[0]


def _windows(
    run: Run, said: PredictedRun, spec: RobotSpec, first: np.ndarray
) -> tuple[float, Float[np.ndarray, " window"], Bool[np.ndarray, " window"]]:
    """Rms twist error [m/s]; how sure the method is of slip, and where there was any."""
    edges = np.append(first, len(run.signals))
    dt = np.diff(np.concatenate([[0.0], np.cumsum(run.signals.dt)])[edges])[:, None]
    true = body_increments(run.pose[edges]) / dt * spec.size
    told = body_increments(said.path[edges]) / dt * spec.size
    # joined as the paths are, so that a method that says what encoders say sees no slip at all
    by_wheels = path_of(run.signals.rolling(spec), run.signals.dt)
    rolling = body_increments(by_wheels[edges]) / dt * spec.size
    size = np.linalg.norm(rolling, axis=1)
    moves = size > STANDS
    most = np.maximum(size, STANDS)
    slips = np.linalg.norm(true - rolling, axis=1) > SLIPS * most
    if said.slipping is None:
        score = np.round(np.linalg.norm(told - rolling, axis=1) / most, 6)
    else:
        score = np.add.reduceat(said.slipping * run.signals.dt, first) / dt[:, 0]
    off = float(np.sqrt(np.mean(np.sum((told - true) ** 2, axis=1))))
    return off, score[moves], slips[moves]


def _floor_right(run: Run, said: PredictedRun) -> float | None:
    if said.floors is None or run.signals.floor is not None or run.floor == "unknown":
        return None
    names = list(said.floors)
    best = np.argmax(np.stack([said.floors[name] for name in names]), axis=0)
    known = {base_of(name) for name in names}
    # a floor that nobody has seen is rightly called unknown
    true = base_of(run.floor) if base_of(run.floor) in known else "unknown"
    right = np.array([base_of(names[k]) == true for k in best])
    return float((right * run.signals.dt).sum() / run.signals.dt.sum())


def _energy_error(run: Run, said: PredictedRun, spec: RobotSpec) -> float | None:
    if said.power is None or run.signals.current is None:
        return None
    spent = float((run.signals.power(spec) * run.signals.dt).sum())
    return abs(float((said.power * run.signals.dt).sum()) / max(spent, 1e-9) - 1)


@dataclass(frozen=True)
class FoldScore:
    """A method in one fold of one protocol.

    Attributes:
        runs: that it predicted.
        absent: why there are none: a channel that it needs and these logs lack, or what failed.
        failed: whether that is a failure.
        settings: that cross-validation picked, in words; tried: how many.
        numbers: how many were fitted.
        tune_s, fit_s: that it took to pick the settings, and to fit once [s].
        step_us: to predict one step of one run [microseconds].
        converged: of a fit that goes in rounds.
    """

    runs: tuple[RunScore, ...] = ()
    absent: str = ""
    failed: bool = False
    settings: str = ""
    tried: int = 1
    numbers: int = 0
    tune_s: float = 0.0
    fit_s: float = 0.0
    step_us: float = 0.0
    converged: bool = True

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def of_json(cls, content: dict[str, Any]) -> "FoldScore":
        return cls(**{**content, "runs": tuple(RunScore(**run) for run in content["runs"])})

    @classmethod
    def lacking(cls, channels: Iterable[str]) -> "FoldScore":
        """Of a method that needs what was not logged."""
        words = {"twist": "wheels that drive sideways", "command": "a commanded twist"}
        named = [words.get(name, f"a {name}") for name in sorted(channels)]
        return cls(absent=f"needs {' and '.join(named)}")

    @classmethod
    def of_error(cls, error: Exception) -> "FoldScore":
        """Of a method that ended in an error."""
        return cls(absent=f"{type(error).__name__}: {error}".splitlines()[0][:300], failed=True)
