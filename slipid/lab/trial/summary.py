"""Summaries of a trial's runs, by controller."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float, Int

from slipid.robot.closed_loop import PathMetrics
from slipid.support.content import Content

DRAWS = 2000
"""Number of draws of the bootstrap over starts."""
FEWEST_STARTS = 5
"""Number of starts below which a summary has no intervals: with 4, they would hold 80 % of 90 %.

With 5 to 8 starts, 90 % intervals of medians hold 85 to 87 %, with more of them 88 to 90 %; those
of ratios and differences of two medians hold 90 to 94 % (4000 trials with log-normal errors).
"""
COMPARED = ("closure_error_median", "cross_track_rmse", "first_side_along_track_mm")
"""Errors (defined in `columns`) whose medians are compared with those of controller `encoder`."""
SENSORS = {"gyro": "a gyro", "map": "a map of the floors", "true pose": "the true pose"}
"""Text about what a controller needs, keyed by the names in `ControllerRow.needs`."""


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


def summaries(runs: Sequence[TrialRun]) -> dict[str, Content]:
    """Return the summary of every controller over its starts, in the form of trial.json.

    A summary has the medians of the errors, keyed by the names of `columns`, without those that a
    plant does not measure (the twin's energy); `interval90`, their 90 % intervals by bootstrap over
    starts, None with fewer than `FEWEST_STARTS`; `runs`, the number of runs; and `finished_share`,
    the fraction of runs that reached the end of the path. `recovery_share` is the fraction of runs
    in which the controller began to free a robot that was stuck, and `freed_share` the fraction of
    those in which it drove on each time; None without such a run. If the controller `encoder` was
    driven, a summary also has `worse_share`, the fraction of starts with a larger closure error
    than `encoder`'s, and `to_encoder`, the ratios of medians to those of `encoder`, each with its
    `value` and `interval90`. If the controller `calibrated` was driven, `to_calibrated` has the
    mean difference of the closure error to that of `calibrated` from the same starts, and its
    standard error [mm].
    """
    of = _by_controller(runs)
    table = {name: columns(mine) for name, mine in of.items()}
    again, base, calibrated = _resampled(of), table.get("encoder"), table.get("calibrated")
    out: dict[str, Content] = {}
    for name, mine in table.items():
        known = {k: v for k, v in mine.items() if np.all(np.isfinite(v))}
        out[name] = {
            **{k: float(np.median(v)) for k, v in known.items()},
            "interval90": {
                k: _interval(np.median(v[again], axis=1), again.shape[1]) for k, v in known.items()
            },
            "runs": len(of[name]),
            "finished_share": float(np.mean([run.metrics.finished for run in of[name]])),
            **_recoveries(of[name]),
        }
        if base is not None:
            pairs = zip(mine["closure_error_median"], base["closure_error_median"], strict=False)
            out[name]["worse_share"] = float(np.mean([own > other for own, other in pairs]))
            out[name]["to_encoder"] = {k: _ratio(mine[k], base[k], again) for k in COMPARED}
        if calibrated is not None:
            key, count = "closure_error_median", again.shape[1]
            apart = mine[key][:count] - calibrated[key][:count]
            error = float(np.std(apart, ddof=1) / np.sqrt(count)) if count > 1 else float("inf")
            out[name]["to_calibrated"] = {
                "mean_difference_mm": float(np.mean(apart)),
                "standard_error_mm": error if np.isfinite(error) else None,
            }
    return out


def _recoveries(runs: Sequence[TrialRun]) -> Content:
    """Return the shares of runs with recoveries, and of those that drove on."""
    drove_on = [
        run.metrics.freed == run.metrics.recoveries for run in runs if run.metrics.recoveries
    ]
    return {
        "recovery_share": len(drove_on) / len(runs),
        "freed_share": float(np.mean(drove_on)) if drove_on else None,
    }


def verdict(runs: Sequence[TrialRun], needs: Mapping[str, Sequence[str]], has_gyro: bool) -> str:
    """Return a sentence that names the controller that closes best, and what it needs.

    The best controllers without these needs follow, until one needs only encoders and ammeters.

    Args:
        runs: runs of all controllers to compare.
        needs: what each controller needs, see `ControllerRow.needs`, keyed by its name.
        has_gyro: True if the logs of the robot have a gyro.
    """
    parts, without = [], []
    while True:
        left = [run for run in runs if not set(needs[run.controller]) & set(without)]
        if not left:
            break
        best, *equal = best_controllers(left)
        lack = "" if has_gyro or "gyro" not in needs[best] else ", which your logs do not have"
        text = best
        if needs[best]:
            text += f" (with {' and '.join(SENSORS[name] for name in needs[best])}{lack})"
        if equal:
            text += f", not distinguished from {', '.join(equal)}"
        names = " and without ".join(SENSORS[name] for name in without)
        parts.append(f"without {names}: {text}" if without else f"closes best: {text}")
        if not needs[best]:
            break
        without += needs[best]
    return "; ".join(parts)


def best_controllers(runs: Sequence[TrialRun]) -> tuple[str, ...]:
    """Return the controllers that may have the smallest closure error, the lowest median first.

    After the controller with the lowest median come those that are not clearly worse: the 90 %
    bootstrap interval of the difference of medians, over the same starts, does not lie above 0, or
    there are fewer than `FEWEST_STARTS`.
    Only controllers with the smallest number of unfinished runs are considered.
    """
    of = _by_controller(runs)
    unfinished = {name: sum(not run.metrics.finished for run in mine) for name, mine in of.items()}
    complete = {n: mine for n, mine in of.items() if unfinished[n] == min(unfinished.values())}
    closes = {n: np.array([run.metrics.closure_mm for run in r]) for n, r in complete.items()}
    best = min(closes, key=lambda name: float(np.median(closes[name])))
    again = _resampled(complete)

    def surely_worse(name: str) -> bool:
        gap = np.median(closes[name][again], axis=1) - np.median(closes[best][again], axis=1)
        ends = _interval(gap, len(closes[best]))
        return ends is not None and ends[0] > 0

    return (best, *(name for name in closes if name != best and not surely_worse(name)))


def _by_controller(runs: Sequence[TrialRun]) -> dict[str, list[TrialRun]]:
    names = dict.fromkeys(run.controller for run in runs)
    return {name: [run for run in runs if run.controller == name] for name in names}


def _resampled(of: Mapping[str, Sequence[TrialRun]]) -> Int[np.ndarray, "draw start"]:
    """Return start indices, drawn with replacement from the starts that all controllers drove."""
    count = min(map(len, of.values()))
    return np.random.default_rng(0).integers(count, size=(DRAWS, count))


def columns(runs: Sequence[TrialRun]) -> dict[str, Float[np.ndarray, " run"]]:
    """Return the errors of every run, keyed by the errors' names.

    `first_side_along_track_mm` and `heading_error_deg` are magnitudes; `first_side_travelled` is
    the fraction of the first side that was driven. The first side of a curve is its first quarter.
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


def _ratio(mine: np.ndarray, base: np.ndarray, again: np.ndarray) -> Content:
    """Return the ratio of two medians of errors, with its interval."""
    a, b = (np.median(x[again], axis=1) for x in (mine, base))
    value = float(np.median(mine) / max(float(np.median(base)), 1e-9))
    return {"value": value, "interval90": _interval(a / np.maximum(b, 1e-9), again.shape[1])}


def _interval(values: np.ndarray, starts: int) -> list[float] | None:
    """Return the ends of the 90 % interval of bootstrap draws; None if there are too few starts."""
    if starts < FEWEST_STARTS:
        return None
    return [float(x) for x in np.quantile(values, [0.05, 0.95])]
