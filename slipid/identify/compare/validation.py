"""Open-loop prediction of runs a fit has not seen, beside every rung it was compared with."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from slipid.data.runs import Runs
from slipid.data.windows import Windows
from slipid.identify.compare import open_loop as replay
from slipid.identify.compare.slip_models import Rung
from slipid.identify.fit import likelihood as lk
from slipid.model.robot import Robot
from slipid.search_space import Space
from slipid.support.errors import DataError

SCHEMA = "slipid.validation/1"


@dataclass(frozen=True, eq=False)
class Predictor:
    """What a prediction needs of a fit.

    Attributes:
        robot: fitted numbers.
        space: of the free ones.
        z: where they are in it.
        covariance: of z.
        variance: of every noise component by name, and of what sessions share; none is none.
        rungs: fitted on the same runs.
    """

    robot: Robot
    space: Space
    z: Float[np.ndarray, " free"]
    covariance: Float[np.ndarray, "free free"]
    variance: dict[str, float]
    rungs: Sequence[Rung]


@dataclass(frozen=True)
class Score:
    """What a model's prediction of a run is worth.

    Attributes:
        predicted_end: pose at the end (x, y [m], yaw [rad]).
        endpoint_error: distance to the camera's end, over the chord.
        length_error: of the predicted chord, relative.
        heading_error_deg: at the end, absolute.
        level: probability of the region whose edge the end lies on, None for a model without.
        covered90: whether that is at most 0.9.
        energy_score: [m].
        log_density: of the logged poses [nats]; None where it was not asked for.
    """

    predicted_end: Sequence[float]
    endpoint_error: float
    length_error: float
    heading_error_deg: float
    level: float | None
    covered90: bool | None
    energy_score: float
    log_density: float | None = None


@dataclass(frozen=True)
class Judged:
    """A run and the scores of every model on it.

    Attributes:
        name, surface, load, session: of the run.
        heading_deg, speed: as commanded [deg], [m/s]; None where that is not known.
        chord: the camera's straight-line displacement [m].
        measured_end: pose at the end (x, y [m], yaw [rad]).
        models: score by model.
    """

    name: str
    surface: str
    load: str
    heading_deg: float | None
    speed: float | None
    chord: float
    measured_end: Sequence[float]
    models: dict[str, Score]
    session: str | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain values; what was not asked for is left out."""
        return {k: v for k, v in asdict(self).items() if v is not None or k != "session"} | {
            "models": {name: _asked(asdict(score)) for name, score in self.models.items()}
        }

    @classmethod
    def of_json(cls, content: Mapping[str, Any]) -> "Judged":
        """The run from what `to_json` gave."""
        models = {name: Score(**score) for name, score in content["models"].items()}
        return cls(**{**content, "models": models})


def _asked(score: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in score.items() if v is not None or k != "log_density"}


@dataclass(frozen=True)
class Summary:
    """Scores of a model over the runs on a floor; attributes as of `Score`."""

    endpoint_error_mean: float
    endpoint_error_median: float
    length_error_mean: float
    heading_error_median_deg: float
    coverage90: float | None
    energy_score: float
    runs: int


@dataclass(frozen=True)
class Validation:
    """Runs a fit has predicted."""

    runs: tuple[Judged, ...]

    @property
    def summary(self) -> dict[str, dict[str, Summary]]:
        """Means by floor and model; a floor with another load set-up is a floor of its own."""
        return {
            name: {m: _mean([run.models[m] for run in runs]) for m in runs[0].models}
            for name, runs in by_floor(self.runs).items()
        }

    def to_json(self) -> dict[str, Any]:
        """Content of the validation file."""
        summary = {
            floor: {model: asdict(one) for model, one in models.items()}
            for floor, models in self.summary.items()
        }
        runs = [run.to_json() for run in self.runs]
        return {"schema": SCHEMA, "summary": summary, "runs": runs}

    @property
    def table(self) -> str:
        """Mean end-point error in percent, one line per floor, one column per model."""
        floors = self.summary
        models = list(next(iter(floors.values())))
        first = f"{'end-point error, %':18}" + "".join(f"{m:>16}" for m in models)
        lines = [f"{first}{'runs':>6}"]
        for floor, by in floors.items():
            cells = "".join(f"{100 * by[m].endpoint_error_mean:16.2f}" for m in models)
            lines.append(f"{floor:18}{cells}{by[models[0]].runs:6d}")
        return "\n".join(lines)


def validation(fit: Predictor, data: Runs) -> Validation:
    """Prediction of runs of known floors by a fit, beside every rung.

    As in `cross_validation`, every run is predicted as of a session of its own: what its session
    shares widens its region by the variance found in fitting, whether or not other runs of that
    session were fitted.

    Args:
        fit: of other runs.
        data: runs to predict, each from its first pose after the wheels moved 10 mm.

    Raises:
        DataError: a run on a floor or with a load set-up that was not identified.
    """
    _known(fit.robot, data)
    runs: dict[int, Judged] = {}
    for w in replay.cuts(data, fit.robot):
        tracks = {"identified": _contact(fit.robot, w)}
        for rung in fit.rungs:
            tracks[rung.name] = replay.follow(fit.robot, w, rung.increments(w, fit.robot))
        of_parameters = replay.parameter_covariance(
            fit.space, fit.z, fit.covariance, w, tracks["identified"]
        )
        cov = replay.end_covariance(fit.robot, w, tracks["identified"], fit.variance, of_parameters)
        for name, track in tracks.items():
            score(runs, data, name, track, cov if name == "identified" else None)
    return Validation(tuple(runs[k] for k in range(len(data))))


def _contact(robot: Robot, w: Windows) -> replay.Tracks:
    b = lk.batch(w, robot)
    return replay.follow(robot, w, np.asarray(replay.contact_increments(robot, b)))


def _known(robot: Robot, data: Runs) -> None:
    for log in data.logs:
        if log.surface not in robot.surfaces.labels:
            known = ", ".join(robot.surfaces.labels)
            raise DataError(
                f"{log.name}: surface '{log.surface}' was not identified; identified: {known}"
            )
        if log.load not in robot.body.loads:
            known = ", ".join(robot.body.loads)
            raise DataError(
                f"{log.name}: load set-up '{log.load}' was not identified; identified: {known}"
            )


def score(
    runs: dict[int, Judged],
    data: Runs,
    model: str,
    tracks: replay.Tracks,
    cov: Float[np.ndarray, "run 2 2"] | None,
) -> None:
    """Write what a model's tracks are worth into the scores of their runs.

    Args:
        runs: by number in `data`; those that are met for the first time are added.
        data: the runs.
        model: its name.
        tracks: of some of the runs.
        cov: of the ends, None for a model without.
    """
    gap = tracks.gap
    level, energy = replay.scores(gap[:, :2], cov)
    ahead = np.linalg.norm((tracks.predicted[:, -1] - tracks.predicted[:, 0])[:, :2], axis=1)
    for n, k in enumerate(tracks.run.tolist()):
        log, chord = data.logs[k], float(tracks.chord[n])
        if k not in runs:
            runs[k] = Judged(
                name=log.name,
                surface=str(log.surface),
                load=log.load,
                heading_deg=_number(np.degrees(data.heading[k])),
                speed=_number(data.speed[k]),
                chord=chord,
                measured_end=tracks.measured[n, -1].tolist(),
                models={},
            )
        runs[k].models[model] = Score(
            predicted_end=tracks.predicted[n, -1].tolist(),
            endpoint_error=float(np.hypot(*gap[n, :2])) / max(chord, 1e-9),
            length_error=abs(float(ahead[n]) / max(chord, 1e-9) - 1.0),
            heading_error_deg=abs(float(np.degrees(gap[n, 2]))),
            level=None if level is None else float(level[n]),
            covered90=None if level is None else bool(level[n] <= 0.9),
            energy_score=float(energy[n]),
        )


def _number(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


def by_floor(runs: Sequence[Judged]) -> dict[str, list[Judged]]:
    """Runs of every floor, those of other load set-ups by themselves.

    A set-up other than the one as built, else the most common, is written `<floor>@<load>`.
    """
    loads = [run.load for run in runs]
    main = "as_built" if "as_built" in loads else max(sorted(set(loads)), key=loads.count)
    groups: dict[str, list[Judged]] = {}
    for run in runs:
        name = run.surface if run.load == main else f"{run.surface}@{run.load}"
        groups.setdefault(name, []).append(run)
    return dict(sorted(groups.items()))


def _mean(scores: Sequence[Score]) -> Summary:
    error = [s.endpoint_error for s in scores]
    covered = [s.covered90 for s in scores if s.covered90 is not None]
    return Summary(
        endpoint_error_mean=float(np.mean(error)),
        endpoint_error_median=float(np.median(error)),
        length_error_mean=float(np.mean([s.length_error for s in scores])),
        heading_error_median_deg=float(np.median([s.heading_error_deg for s in scores])),
        coverage90=float(np.mean(covered)) if covered else None,
        energy_score=float(np.mean([s.energy_score for s in scores])),
        runs=len(scores),
    )
