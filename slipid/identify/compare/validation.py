"""Open-loop prediction of runs a fit has not seen, beside every rung it was compared with."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from slipid.data.runs import Runs
from slipid.identify.compare import open_loop as replay
from slipid.identify.compare.predictive import Contact
from slipid.identify.compare.rung import Rung
from slipid.model.robot import Robot
from slipid.support.content import Content
from slipid.support.errors import DataError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCHEMA = "slipid.validation/1"


@dataclass(frozen=True)
class Score:
    """What a model's prediction of a run is worth.

    The pose at the end is x, y [m] and yaw [rad]; the end-point error is over the chord, and over
    the path, which means something on closed paths, too; the length error is relative. `level` is
    the probability of the region whose edge the end lies on, `covered90` whether that is at most
    0.9, both None for a model without. The energy score is in m, the log density of the logged
    poses in nats, None where it was not asked for.
    """

    predicted_end: Sequence[float]
    endpoint_error: float
    endpoint_error_over_path: float
    length_error: float
    heading_error_deg: float
    level: float | None
    covered90: bool | None
    energy_score: float
    log_density: float | None = None


@dataclass(frozen=True)
class Judged:
    """A run and the scores of every model on it.

    Heading and speed are as commanded [deg], [m/s], None where not known; the chord is the camera's
    straight-line displacement [m], the path its way [m], the measured end a pose (x, y [m],
    yaw [rad]).
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
        return asdict(self, dict_factory=told)

    @classmethod
    def of_json(cls, content: Content) -> "Judged":
        models = {name: Score(**score) for name, score in content["models"].items()}
        return cls(**{**content, "models": models})


def told(values: Iterable[tuple[str, object]]) -> Content:
    """Plain values without what was not asked for."""
    return {k: v for k, v in values if v is not None or k not in ("session", "log_density")}


@dataclass(frozen=True)
class Summary:
    """Scores of a model over the runs on a floor; attributes as of `Score`."""

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
    """Runs that a fit predicted open loop, model by model; `print` shows the mean errors.

    Attributes:
        runs: with the scores of every model.
        new: how many of them the fit has not seen.
    """

    runs: tuple[Judged, ...]
    new: int = 0

    def __str__(self) -> str:
        return self.table

    @property
    def which(self) -> str:
        """A line on how many runs the fit has not seen."""
        return f"{self.new} of {len(self.runs)} runs are new to the fit"

    def plot(self) -> "Figure":
        """End-point errors of every model."""
        from slipid.plots.compare import ladder_figure

        return ladder_figure(self.to_json(), self.which)

    @property
    def summary(self) -> dict[str, dict[str, Summary]]:
        """Means by floor and model; a floor with another load set-up is a floor of its own."""
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


def validation(fit: Contact, rungs: Sequence[Rung], data: Runs, new: int = 0) -> Validation:
    """Prediction of runs of known floors by a fit, beside every rung fitted on the same runs.

    The fit has not seen `new` of the runs.

    As in `folds`, every run is predicted as of a session of its own: what its session
    shares widens its region by the variance found in fitting, whether or not other runs of that
    session were fitted. A run begins at its first pose after the wheels moved 10 mm.

    Raises:
        DataError: a run on a floor or with a load set-up that was not identified.
    """
    _known(fit.robot, data)
    runs: dict[int, Judged] = {}
    for w in replay.cuts(data, fit.robot):
        score(runs, data, fit.name, *fit.ends(w))
        for rung in rungs:
            tracks = replay.follow(fit.robot, w, rung.increments(w, fit.robot))
            score(runs, data, rung.name, tracks, None)
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


def score(
    runs: dict[int, Judged],
    data: Runs,
    model: str,
    tracks: replay.Tracks,
    cov: Float[np.ndarray, "run 2 2"] | None,
) -> None:
    """Write what a model's tracks are worth into the scores of their runs.

    `runs` go by their number in `data`; those that are met for the first time are added. `cov` is
    of the ends, None for a model without.
    """
    gap = tracks.gap
    level, energy = replay.scores(gap[:, :2], cov)
    path = tracks.path.tolist()
    ahead = np.linalg.norm((tracks.predicted[:, -1] - tracks.predicted[:, 0])[:, :2], axis=1)
    for n, k in enumerate(tracks.run.tolist()):
        log, chord = data.logs[k], float(tracks.chord[n])
        if k not in runs:
            runs[k] = Judged(
                name=log.name,
                surface=str(log.surface),
                load=log.load,
                heading_deg=finite(np.degrees(data.heading[k])),
                speed=finite(data.speed[k]),
                chord=chord,
                path=path[n],
                measured_end=tracks.measured[n, -1].tolist(),
                models={},
            )
        runs[k].models[model] = Score(
            predicted_end=tracks.predicted[n, -1].tolist(),
            endpoint_error=float(np.hypot(*gap[n, :2])) / max(chord, 1e-9),
            endpoint_error_over_path=float(np.hypot(*gap[n, :2])) / max(path[n], 1e-9),
            length_error=abs(float(ahead[n]) / max(chord, 1e-9) - 1.0),
            heading_error_deg=abs(float(np.degrees(gap[n, 2]))),
            level=None if level is None else float(level[n]),
            covered90=None if level is None else bool(level[n] <= 0.9),
            energy_score=float(energy[n]),
        )


def finite(x: float) -> float | None:
    """A number, None for one that is not."""
    return float(x) if np.isfinite(x) else None


def main_load(loads: Sequence[str]) -> str:
    """The set-up as built, else the most common."""
    return "as_built" if "as_built" in loads else max(sorted(set(loads)), key=loads.count)


def by_floor(runs: Sequence[Judged]) -> dict[str, list[Judged]]:
    """Runs of every floor, those of other load set-ups by themselves.

    A set-up other than the one as built, else the most common, is written `<floor>@<load>`.
    """
    main = main_load([run.load for run in runs])
    groups: dict[str, list[Judged]] = {}
    for run in runs:
        name = run.surface if run.load == main else f"{run.surface}@{run.load}"
        groups.setdefault(name, []).append(run)
    return dict(sorted(groups.items()))


def _mean(scores: Sequence[Score]) -> Summary:
    def all_of(name: str) -> np.ndarray:
        return np.array([getattr(s, name) for s in scores if getattr(s, name) is not None], float)

    covered = all_of("covered90")
    return Summary(
        endpoint_error_mean=float(np.mean(all_of("endpoint_error"))),
        endpoint_error_median=float(np.median(all_of("endpoint_error"))),
        endpoint_error_over_path_mean=float(np.mean(all_of("endpoint_error_over_path"))),
        endpoint_error_over_path_median=float(np.median(all_of("endpoint_error_over_path"))),
        length_error_mean=float(np.mean(all_of("length_error"))),
        heading_error_median_deg=float(np.median(all_of("heading_error_deg"))),
        coverage90=float(np.mean(covered)) if covered.size else None,
        energy_score=float(np.mean(all_of("energy_score"))),
        runs=len(scores),
    )
