"""Summaries of a trial's runs, by controller."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float

from slipid.robot.closed_loop import PathMetrics

Interval = tuple[float, float]
"""Lower and upper end of a 90 % interval, by bootstrap over starts."""


@dataclass(frozen=True)
class TrialRun:
    """One run of one controller with its errors.

    Attributes:
        controller: name of the controller.
        start: start pose [m, m, rad].
        seed: seed of all random numbers.
        metrics: path errors of the true poses.
        believed_error_mm: error of the estimated position at the end [mm].
    """

    controller: str
    start: tuple[float, float, float]
    seed: int
    metrics: PathMetrics
    believed_error_mm: float

    def to_json(self) -> dict[str, object]:
        """Return the run in the form of trial.json."""
        about = {"controller": self.controller, "start": list(self.start), "seed": self.seed}
        return {**about, **asdict(self.metrics), "believed_error_mm": self.believed_error_mm}


@dataclass(frozen=True)
class MedianRatio:
    """Ratio of a controller's median error to that of the controller `encoder`, with interval."""

    value: float
    interval90: Interval


@dataclass(frozen=True)
class ControllerSummary:
    """Summary of one controller over its starts.

    Attributes:
        median: medians of errors by name, see `columns`; without those that a plant does not
            measure (the twin's energy).
        interval90: intervals of the medians, by name.
        runs: number of runs.
        finished_share: share of the runs that reached the end of the path.
        worse_share: share of the starts with a larger closure error than the controller `encoder`;
            None without that controller.
        to_encoder: ratios of medians to those of `encoder`; None without that controller.
    """

    median: Mapping[str, float]
    interval90: Mapping[str, Interval]
    runs: int
    finished_share: float
    worse_share: float | None
    to_encoder: Mapping[str, MedianRatio] | None

    def to_json(self) -> dict[str, object]:
        """Return the summary in the form of trial.json."""
        rest = asdict(self)
        if self.to_encoder is None:
            del rest["to_encoder"], rest["worse_share"]
        return {**rest.pop("median"), **rest}


Columns = Mapping[str, Float[np.ndarray, " run"]]


def summaries(runs: Sequence[TrialRun], draws: int = 2000) -> dict[str, ControllerSummary]:
    """Return the summary of every controller, with 90 % bootstrap intervals over starts."""
    names = list(dict.fromkeys(run.controller for run in runs))
    of = {name: [run for run in runs if run.controller == name] for name in names}
    table = {name: columns(of[name]) for name in names}
    rng = np.random.default_rng(0)
    count = min(len(c["closure_error_median"]) for c in table.values())
    again = rng.integers(count, size=(draws, count))
    base = table["encoder"]["closure_error_median"] if "encoder" in table else None
    out: dict[str, ControllerSummary] = {}
    for name, mine in table.items():
        closes, worse = mine["closure_error_median"], None
        if base is not None:
            shared = min(len(closes), len(base))
            worse = float(np.mean(closes[:shared] > base[:shared]))
        known = {k: v for k, v in mine.items() if np.all(np.isfinite(v))}
        out[name] = ControllerSummary(
            median={k: float(np.median(v)) for k, v in known.items()},
            interval90={k: _interval(np.median(v[again], axis=1)) for k, v in known.items()},
            runs=len(of[name]),
            finished_share=float(np.mean([run.metrics.finished for run in of[name]])),
            worse_share=worse,
            to_encoder=_ratios(mine, table["encoder"], again) if "encoder" in table else None,
        )
    return out


def best_controllers(runs: Sequence[TrialRun], draws: int = 2000) -> tuple[str, ...]:
    """Return the controllers that may have the smallest closure error, the lowest median first.

    The others are those whose errors are not clearly larger: the 90 % bootstrap interval of the
    difference of medians, over the same starts, does not lie above 0. Only controllers with the
    smallest number of unfinished runs are considered.
    """
    names = list(dict.fromkeys(run.controller for run in runs))
    of = {name: [run for run in runs if run.controller == name] for name in names}
    unfinished = {name: sum(not run.metrics.finished for run in of[name]) for name in names}
    complete = [name for name in names if unfinished[name] == min(unfinished.values())]
    closes = {name: np.array([run.metrics.closure_mm for run in of[name]]) for name in complete}
    best = min(complete, key=lambda name: float(np.median(closes[name])))
    count = min(len(v) for v in closes.values())
    again = np.random.default_rng(0).integers(count, size=(draws, count))

    def surely_worse(name: str) -> bool:
        gap = np.median(closes[name][again], axis=1) - np.median(closes[best][again], axis=1)
        return _interval(gap)[0] > 0

    return (best, *(name for name in complete if name != best and not surely_worse(name)))


def columns(runs: Sequence[TrialRun]) -> Columns:
    """Return the errors of every run by name.

    `first_side_along_track_mm` and `heading_error_deg` are magnitudes; `first_side_travelled` is
    the share of the first side that was travelled. The first side of a curve is its first quarter.
    """
    m = [run.metrics for run in runs]
    side, whole = np.array([(x.along_track_mm[0], x.sides_mm[0]) for x in m]).T
    return {
        "first_side_along_track_mm": np.abs(side),
        "first_side_travelled": 1 + side / whole,
        "closure_error_median": np.array([x.closure_mm for x in m]),
        "cross_track_rmse": np.array([x.cross_track_rmse_mm for x in m]),
        "heading_error_deg": np.abs([x.heading_error_deg for x in m]),
        "path_length_mm": np.array([x.path_length_mm for x in m]),
        "energy_j": np.array([np.nan if x.energy_j is None else x.energy_j for x in m]),
        "effort": np.array([x.effort for x in m]),
        "seconds": np.array([x.seconds for x in m]),
        "believed_error_mm": np.array([run.believed_error_mm for run in runs]),
    }


def _ratios(mine: Columns, base: Columns, again: np.ndarray) -> dict[str, MedianRatio]:
    out = {}
    for key in ("closure_error_median", "cross_track_rmse", "first_side_along_track_mm"):
        a, b = np.median(mine[key][again], axis=1), np.median(base[key][again], axis=1)
        value = float(np.median(mine[key]) / max(float(np.median(base[key])), 1e-9))
        out[key] = MedianRatio(value, _interval(a / np.maximum(b, 1e-9)))
    return out


def _interval(values: np.ndarray) -> Interval:
    low, high = np.quantile(values, [0.05, 0.95]).tolist()
    return low, high
