"""Open-loop prediction of runs by a fit and by every other slip model, and their scores."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from slipid.data.runs import Runs
from slipid.model.robot import Robot
from slipid.predict import open_loop as replay
from slipid.predict.predictive import ForceBalance
from slipid.predict.score import Score, chords, lengths, scores, setups
from slipid.predict.slip_models import FloorModels
from slipid.support.content import Content
from slipid.support.errors import DataError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCHEMA = "slipid.validation/1"
CONTACT = "identified"
"""Name of the force balance's scores."""
SAME_LAG_S = 0.005
"""Largest difference of two lags for which windows cut for one lag serve for the other [s]."""


@dataclass(frozen=True)
class ScoredRun:
    """A run and the scores of every model on it.

    Attributes:
        name: name of the run.
        surface: floor of the run.
        load: load set-up of the run.
        heading_deg: commanded heading [deg], None if unknown.
        speed: commanded speed [m/s], None if unknown.
        chord: straight-line displacement measured by the camera [m].
        path: path length measured by the camera [m].
        measured_end: measured pose at the end (x, y [m], yaw [rad]).
        models: scores, keyed by model.
        session: session of the run.
    """

    name: str
    surface: str
    load: str
    heading_deg: float | None
    speed: float | None
    chord: float
    path: float
    measured_end: Sequence[float]
    models: dict[str, Score]
    session: str | None = None

    def to_json(self) -> Content:
        return asdict(self, dict_factory=plain_values)

    @classmethod
    def of_json(cls, content: Content) -> "ScoredRun":
        models = {name: Score(**score) for name, score in content["models"].items()}
        return cls(**{**content, "models": models})


def plain_values(values: Iterable[tuple[str, object]]) -> Content:
    """Return a dict of the values; `session` and `log_density` are omitted if they are None."""
    return {k: v for k, v in values if v is not None or k not in ("session", "log_density")}


@dataclass(frozen=True)
class FloorSummary:
    """Mean or median scores of a model over the runs on a floor; `Score` defines the scores."""

    endpoint_error_mean: float
    endpoint_error_median: float
    endpoint_error_over_path_mean: float
    endpoint_error_over_path_median: float
    length_error_mean: float
    heading_error_median_deg: float
    coverage90: float | None
    energy_score: float
    runs: int


@dataclass(frozen=True)
class Validation:
    """Runs that a fit predicted open loop, model by model; `print` shows them by floor and model.

    Attributes:
        runs: runs with the scores of every model.
        new: number of these runs that were not fitted.
    """

    runs: tuple[ScoredRun, ...]
    new: int = 0

    def __str__(self) -> str:
        from slipid.report.answers import show_validation
        from slipid.report.page import text_of

        return text_of(show_validation, self.to_json())

    @property
    def which(self) -> str:
        """Sentence about the number of runs that were not fitted."""
        return f"{self.new} of {len(self.runs)} runs were not fitted"

    def plot(self) -> "Figure":
        """Plot the end-point errors of every model."""
        from slipid.plots.compare import validation_figure

        return validation_figure(self.to_json(), self.which)

    @property
    def summary(self) -> dict[str, dict[str, FloorSummary]]:
        """Mean scores, keyed by floor (with the load set-up as in `by_floor`) and model."""
        return {
            name: {m: _mean([run.models[m] for run in runs]) for m in runs[0].models}
            for name, runs in by_floor(self.runs).items()
        }

    def to_json(self) -> Content:
        summary = {
            floor: {model: asdict(one) for model, one in models.items()}
            for floor, models in self.summary.items()
        }
        runs = [run.to_json() for run in self.runs]
        return {"schema": SCHEMA, "summary": summary, "runs": runs}


def validation(
    fit: ForceBalance | None,
    models: Sequence[FloorModels],
    data: Runs,
    new: int = 0,
    seen: Robot | None = None,
    chosen: Mapping[str, str] = MappingProxyType({}),
) -> Validation:
    """Return the scores of runs on known floors, predicted by a fit and by every slip model.

    As in `folds`, every run is predicted as if it were the only run of its session: the session
    effect is unknown and widens the region by its fitted variance, even if other runs of the
    session were fitted. A run begins at its first pose after the wheels have moved by 10 mm.

    Args:
        fit: the force balance; None where only kinematics were calibrated.
        models: other slip models, fitted floor by floor.
        data: runs on known floors.
        new: number of the runs that were not fitted.
        seen: robot with the pose sensor by which the other models are judged, None for the robot
            of the force balance.
        chosen: name of the selected model, keyed by floor; its scores are repeated as those of the
            model `selected`.

    Raises:
        DataError: the floor or the load set-up of a run was not identified.
    """
    own = seen if seen is not None or fit is None else fit.robot
    assert own is not None, "a robot with a pose sensor is needed where there is no force balance"
    _known(own, data)
    runs: dict[int, ScoredRun] = {}
    robot = own if fit is None else fit.robot
    cuts = replay.replay_windows(data, robot)
    if fit is not None:
        for w in cuts:
            add_scores(runs, data, fit.name, *fit.ends(w))
    if abs(float(own.camera.lag - robot.camera.lag)) > SAME_LAG_S:
        cuts = replay.replay_windows(data, own)
    for w in cuts:
        late = w.at_lag(float(own.camera.lag))
        for model in models:
            tracks = replay.tracks_from_increments(own, w, model.increments(late, own))
            add_scores(runs, data, model.name, tracks, None)
    for run in runs.values():
        if name := chosen.get(run.surface):
            run.models["selected"] = run.models[CONTACT if name == "contact" else name]
    return Validation(tuple(runs[k] for k in range(len(data))), new)


def _known(robot: Robot, data: Runs) -> None:
    for log in data.logs:
        for what, name, known in (
            ("surface", log.surface, robot.surfaces.labels),
            ("load set-up", log.load, robot.body.loads),
        ):
            if name not in known:
                raise DataError(
                    f"{log.name}: {what} '{name}' was not identified; "
                    f"identified: {', '.join(known)}"
                )


def add_scores(
    runs: dict[int, ScoredRun],
    data: Runs,
    model: str,
    tracks: replay.Tracks,
    cov: Float[np.ndarray, "run 2 2"] | None,
) -> None:
    """Add the scores of a model's tracks to `runs`.

    Keys of `runs` are indices of runs in `data`; missing runs are added. `cov` holds the scale
    matrices of the end points, None for a model without uncertainty.
    """
    found = scores(tracks.predicted, tracks.measured, cov)
    chord, path = chords(tracks.measured), lengths(tracks.measured)
    for n, k in enumerate(tracks.run.tolist()):
        log = data.logs[k]
        if k not in runs:
            runs[k] = ScoredRun(
                name=log.name,
                surface=str(log.surface),
                load=log.load,
                heading_deg=finite(np.degrees(data.heading[k])),
                speed=finite(data.speed[k]),
                chord=chord[n],
                path=path[n],
                measured_end=tracks.measured[n, -1].tolist(),
                models={},
            )
        runs[k].models[model] = found[n]


def finite(x: float) -> float | None:
    """Return x, or None if it is not finite."""
    return float(x) if np.isfinite(x) else None


def by_floor(runs: Sequence[ScoredRun]) -> dict[str, list[ScoredRun]]:
    """Return the runs in groups, keyed by the names that `score.setups` gives them.

    A name is the floor, or `<floor>@<load>` if the load set-up is not the main one.
    """
    groups: dict[str, list[ScoredRun]] = {}
    for name, run in zip(
        setups([r.surface for r in runs], [r.load for r in runs]), runs, strict=True
    ):
        groups.setdefault(name, []).append(run)
    return dict(sorted(groups.items()))


def _mean(each: Sequence[Score]) -> FloorSummary:
    def all_of(name: str) -> np.ndarray:
        return np.array([getattr(s, name) for s in each if getattr(s, name) is not None], float)

    covered = all_of("covered90")
    return FloorSummary(
        endpoint_error_mean=float(np.mean(all_of("endpoint_error"))),
        endpoint_error_median=float(np.median(all_of("endpoint_error"))),
        endpoint_error_over_path_mean=float(np.mean(all_of("endpoint_error_over_path"))),
        endpoint_error_over_path_median=float(np.median(all_of("endpoint_error_over_path"))),
        length_error_mean=float(np.mean(all_of("length_error"))),
        heading_error_median_deg=float(np.median(all_of("heading_error_deg"))),
        coverage90=float(np.mean(covered)) if covered.size else None,
        energy_score=float(np.mean(all_of("energy_score"))),
        runs=len(each),
    )
