"""Open-loop prediction of runs a fit has not seen, beside every rung it was compared with."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from slipid.data.dataset import Dataset, Windows
from slipid.data.log import DataError
from slipid.identify import likelihood as lk
from slipid.identify import replay
from slipid.identify.ladder import Rung
from slipid.model.robot import Robot
from slipid.parameter import Space

SCHEMA = "slipid.validation/1"


@dataclass(frozen=True, eq=False)
class Frozen:
    """What of a fit a prediction needs.

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


def validation(fit: Frozen, data: Dataset) -> dict[str, Any]:
    """Validation file for runs of known floors: one row per run and model, and a summary per floor.

    As in `slipid.identify.compare`, every run is predicted as of a session of its own: what its
    session shares widens its region by the variance found in fitting, whether or not other runs of
    that session were fitted.

    Args:
        fit: of other runs.
        data: runs to predict, each from its first pose after the wheels moved 10 mm.

    Raises:
        DataError: a run on a floor or with a load set-up that was not identified.
    """
    _known(fit.robot, data)
    rows: list[dict[str, Any]] = [{} for _ in data.logs]
    for w in replay.cuts(data, fit.robot):
        tracks = {"identified": _contact(fit.robot, w)}
        for rung in fit.rungs:
            tracks[rung.name] = replay.follow(fit.robot, w, rung.increments(w, fit.robot))
        of_parameters = replay.parameter_covariance(
            fit.space, fit.z, fit.covariance, w, tracks["identified"]
        )
        cov = replay.end_covariance(fit.robot, w, tracks["identified"], fit.variance, of_parameters)
        for name, track in tracks.items():
            score(rows, data, name, track, cov if name == "identified" else None)
    return {"schema": SCHEMA, "summary": summary(rows), "runs": rows}


def _contact(robot: Robot, w: Windows) -> replay.Tracks:
    b = lk.batch(w, robot)
    return replay.follow(robot, w, np.asarray(replay.contact_increments(robot, b)))


def _known(robot: Robot, data: Dataset) -> None:
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
    rows: list[dict[str, Any]],
    data: Dataset,
    model: str,
    tracks: replay.Tracks,
    cov: Float[np.ndarray, "run 2 2"] | None,
) -> None:
    """Write what a model's tracks are worth into the rows of their runs.

    Args:
        rows: of every run of `data`.
        cov: of the ends, None for a model without.
    """
    gap = tracks.gap
    level, energy = replay.scores(gap[:, :2], cov)
    ahead = np.linalg.norm((tracks.predicted[:, -1] - tracks.predicted[:, 0])[:, :2], axis=1)
    for n, k in enumerate(tracks.run):
        log, chord = data.logs[int(k)], float(tracks.chord[n])
        row = rows[int(k)]
        row.setdefault("name", log.name)
        row.setdefault("surface", log.surface)
        row.setdefault("load", log.load)
        row.setdefault("heading_deg", _number(np.degrees(data.heading[int(k)])))
        row.setdefault("speed", _number(data.speed[int(k)]))
        row.setdefault("chord", chord)
        row.setdefault("measured_end", tracks.measured[n, -1].tolist())
        row.setdefault("models", {})[model] = {
            "predicted_end": tracks.predicted[n, -1].tolist(),
            "endpoint_error": float(np.hypot(*gap[n, :2])) / max(chord, 1e-9),
            "length_error": abs(float(ahead[n]) / max(chord, 1e-9) - 1.0),
            "heading_error_deg": abs(float(np.degrees(gap[n, 2]))),
            "level": None if level is None else float(level[n]),
            "covered90": None if level is None else bool(level[n] <= 0.9),
            "energy_score": float(energy[n]),
        }


def _number(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Summary per floor; runs with another load set-up than the first are a floor of their own.

    A set-up other than the most common is written `<floor>@<load>`.
    """
    return {
        name: {model: _mean([r["models"][model] for r in group]) for model in group[0]["models"]}
        for name, group in by_floor(rows).items()
    }


def by_floor(rows: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Rows of every floor, those of other load set-ups by themselves."""
    loads = [row["load"] for row in rows]
    main = max(sorted(set(loads)), key=loads.count)
    if "as_built" in loads:
        main = "as_built"
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        name = row["surface"] if row["load"] == main else f"{row['surface']}@{row['load']}"
        groups.setdefault(name, []).append(row)
    return dict(sorted(groups.items()))


def _mean(scores: list[dict[str, Any]]) -> dict[str, Any]:
    def column(key: str) -> np.ndarray:
        return np.array([s[key] for s in scores], float)

    covered = [s["covered90"] for s in scores]
    return {
        "endpoint_error_mean": float(column("endpoint_error").mean()),
        "endpoint_error_median": float(np.median(column("endpoint_error"))),
        "length_error_mean": float(column("length_error").mean()),
        "heading_error_median_deg": float(np.median(column("heading_error_deg"))),
        "coverage90": None if covered[0] is None else float(np.mean(covered)),
        "energy_score": float(column("energy_score").mean()),
        "runs": len(scores),
    }


def text_table(report: dict[str, Any]) -> str:
    """Mean end-point error in percent, one line per floor, one column per model."""
    models = list(next(iter(report["summary"].values())))
    lines = [f"{'end-point error, %':18}" + "".join(f"{m:>16}" for m in models) + f"{'runs':>6}"]
    for floor, by in report["summary"].items():
        cells = "".join(f"{100 * by[m]['endpoint_error_mean']:16.2f}" for m in models)
        lines.append(f"{floor:18}{cells}{by[models[0]]['runs']:6d}")
    return "\n".join(lines)
