"""Summaries over all folds: means over runs, bootstrap intervals and differences run by run.

`reading` compares slipid's end-point errors with those of the other rows in sentences.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.lab.benchmark.scores import FoldScore, RunScore
from slipid.lab.benchmark.slipid_rows import NAME
from slipid.support.content import Content

MOST_NAMED_ROWS = 4
"""Largest number of tied rows that a sentence names."""
DRAWS = 1000
"""Number of draws of the bootstrap."""
INTERVAL = (0.05, 0.95)
"""Quantiles of the draws at the ends of a 90 % interval."""
FEWEST_CLUSTERS = 2
"""Number of clusters on a floor below which its runs are resampled one by one."""
Weights = Float[np.ndarray, "draw run"]


class MeanInterval(NamedTuple):
    """A mean and the ends of its 90 % bootstrap interval."""

    value: float
    low: float
    high: float


RowSummary = Content
"""Row of a method in one protocol of one data set, in the form of benchmark.json.

Values that are not listed are means of the attribute of `RunScore` with the same name
(`coverage90` of `covered90`, `floor_accuracy` of `floor_right`), first over the runs of each floor
and then over floors, with their intervals; None if the method does not predict them.

- floors: mean end-point error of each floor, with its load set-up.
- behind: end-point error less that of slipid on the same resampled runs; None for slipid
  itself, and if slipid has no row.
- slip_auc: area under the receiver operating characteristic of slip detection, by windows;
  None if all windows slip, or if no window does.
- runs: number of runs.
- numbers: number of fitted parameters, median over folds.
- tune_s: time to pick the settings, median over folds [s].
- fit_s: time of one fit, median over folds [s].
- step_us: time to predict one step of one run, median over folds [microseconds].
- settings: settings picked in each fold.
- unconverged: number of folds whose fit did not converge.
- absent: reason why there are no runs, see `FoldScore`.
- failed: True if the reason is an error.
"""


def summary(
    folds: Mapping[str, Sequence[FoldScore[RunScore]]], reference: str
) -> dict[str, RowSummary]:
    """Return the summary of every row over its folds, compared with the row named `reference`."""
    scores = {name: FoldScore.of_folds(each) for name, each in folds.items()}
    done = {name: score.runs for name, score in scores.items() if score.runs}
    first = next(iter(done.values()), ())
    weights, base = Bootstrap.of(first), done.get(reference)
    out: dict[str, RowSummary] = {}
    for name, score in scores.items():
        # all rows of a table are compared on the same runs
        assert not score.runs or [r.name for r in score.runs] == [r.name for r in first]
        rival = None if name == reference else base
        out[name] = _summary(score, folds[name], rival, weights)
    return out


@dataclass(frozen=True, eq=False)
class Bootstrap:
    """Bootstrap draws of runs: on each floor, clusters of runs are resampled with replacement.

    On a floor with fewer than `FEWEST_CLUSTERS` clusters, single runs are resampled.

    Attributes:
        floor: index of the floor of each run.
        names: names of the floors.
        draws: weight of each run in each draw; in the first draw every run has weight 1.
    """

    floor: Int[np.ndarray, " run"]
    names: tuple[str, ...]
    draws: Weights

    @classmethod
    def of(cls, runs: Sequence[RunScore]) -> "Bootstrap":
        """Return draws of scored runs; a run with a negative cluster is a separate cluster."""
        sector = np.array([run.cluster for run in runs])
        alone = -1 - np.arange(len(runs))
        return cls.by([run.floor for run in runs], np.where(sector < 0, alone, sector))

    @classmethod
    def by(cls, floors: Sequence[str], cluster: np.ndarray) -> "Bootstrap":
        """Return draws of items, given the floor and the cluster of each item."""
        names = tuple(dict.fromkeys(floors))
        floor = np.array([names.index(name) for name in floors])
        rng = np.random.default_rng(0)
        draws = np.ones((DRAWS + 1, len(floors)))
        for k in range(len(names)):
            mine = np.flatnonzero(floor == k)
            kinds, of = np.unique(cluster[mine], return_inverse=True)
            # resample single runs if there are too few clusters to estimate their scatter
            if len(kinds) < FEWEST_CLUSTERS:
                kinds, of = mine, np.arange(len(mine))
            picked = rng.multinomial(len(kinds), np.full(len(kinds), 1 / len(kinds)), DRAWS)
            draws[1:, mine] = picked[:, of]
        return cls(floor, names, draws)

    def mean(self, x: Float[np.ndarray, " run"]) -> Float[np.ndarray, " draw"]:
        """Return the mean over floors of means over runs, in every draw; NaN values are ignored."""
        return np.nanmean([self.on(x, k) for k in range(len(self.names))], axis=0)

    def over_all(self, x: Float[np.ndarray, " run"]) -> Float[np.ndarray, " draw"]:
        """Return the mean over all runs, whatever their floor, in every draw."""
        return np.asarray(self.draws @ x / np.maximum(self.draws.sum(axis=1), 1e-12))

    def on(self, x: Float[np.ndarray, " run"], floor: int) -> Float[np.ndarray, " draw"]:
        """Return the mean over the runs on a floor, in every draw."""
        mine = (self.floor == floor) & np.isfinite(x)
        w = self.draws[:, mine]
        total = w.sum(axis=1)
        return np.where(total > 0, w @ x[mine] / np.maximum(total, 1e-12), np.nan)


def mean_interval(draws: Float[np.ndarray, " draw"]) -> MeanInterval:
    """Return the first draw (the original runs), with the 90 % interval of all later draws."""
    low, high = np.nanquantile(draws[1:], INTERVAL)
    return MeanInterval(float(draws[0]), float(low), float(high))


def _summary(
    score: FoldScore[RunScore],
    folds: Sequence[FoldScore[RunScore]],
    rival: Sequence[RunScore] | None,
    by: Bootstrap,
) -> RowSummary:
    """Return the row of a method, compared with the scores `rival` if there are any."""
    runs, ended = score.runs, folds if score.runs else ()

    def mean(name: str) -> MeanInterval | None:
        found = [getattr(run, name) for run in runs]
        x = np.array([np.nan if value is None else float(value) for value in found])
        return mean_interval(by.mean(x)) if np.isfinite(x).any() else None

    error = np.array([run.endpoint_error for run in runs])
    behind, floors = None, None
    if runs:
        floors = {name: mean_interval(by.on(error, k)) for k, name in enumerate(by.names)}
    if runs and rival:
        behind = mean_interval(by.mean(error - np.array([run.endpoint_error for run in rival])))
    return {
        "endpoint_error": mean("endpoint_error"),
        "floors": floors,
        "behind": behind,
        "length_error": mean("length_error"),
        "heading_error_deg": mean("heading_error_deg"),
        "twist_error": mean("twist_error"),
        "coverage90": mean("covered90"),
        "slip_auc": _auc(runs, by) if runs else None,
        "floor_accuracy": mean("floor_right"),
        "energy_error": mean("energy_error"),
        "runs": len(runs),
        "numbers": score.numbers,
        "tune_s": score.tune_s,
        "fit_s": score.fit_s,
        "step_us": score.step_us,
        "settings": [fold.settings for fold in ended],
        "unconverged": sum(not fold.converged for fold in ended),
        "absent": score.absent or ("" if runs else "no run"),
        "failed": score.failed,
    }


def _auc(runs: Sequence[RunScore], by: Bootstrap) -> MeanInterval | None:
    """Return the area under the slip detection curve over all windows; None if it is undefined.

    Its interval is computed from a fifth of the draws, to save time.
    """
    score = np.concatenate([run.scores for run in runs])
    slips = np.concatenate([np.asarray(run.slips, bool) for run in runs])
    if slips.all() or not slips.any():
        return None
    of = np.repeat(np.arange(len(runs)), [len(run.scores) for run in runs])
    areas = [area(score, slips, w[of]) for w in by.draws[: DRAWS // 5 + 1]]
    return mean_interval(np.array(areas))


def area(
    score: Float[np.ndarray, " window"],
    positive: Bool[np.ndarray, " window"],
    weight: Float[np.ndarray, " window"],
) -> float:
    """Return the weighted probability that a positive window scores higher than a negative one.

    This probability equals the area under the receiver operating characteristic; ties count half.
    """
    values, at = np.unique(score, return_inverse=True)
    up = np.bincount(at, weight * positive, len(values))
    down = np.bincount(at, weight * ~positive, len(values))
    both = up.sum() * down.sum()
    below = np.cumsum(down) - down
    return float(up @ (below + 0.5 * down) / both) if both > 0 else float("nan")


def reading(tables: Mapping[str, Mapping[str, Mapping[str, RowSummary]]]) -> list[str]:
    """Return a sentence per protocol and data set that compares slipid with the other rows."""
    return [
        sentence(name, protocol, found)
        for name, protocols in tables.items()
        for protocol, found in protocols.items()
    ]


def sentence(name: str, protocol: str, found: Mapping[str, RowSummary]) -> str:
    """Return a sentence that compares slipid's end-point error with the other rows of a table."""
    head = f"{name}, {protocol.replace('_', ' ')}: "
    slipid = found.get(NAME)
    if slipid is None or slipid["endpoint_error"] is None:
        why = "not requested" if slipid is None else slipid["absent"]
        return f"{head}slipid has no row ({why})"
    mine = _percent(slipid["endpoint_error"])
    errors = {
        row: s["endpoint_error"]
        for row, s in found.items()
        if s["endpoint_error"] is not None and not row.startswith(NAME)
    }
    if not errors:
        return f"{head}error of slipid {mine}; no other row to compare with"
    order = sorted(errors, key=lambda row: errors[row].value)
    behind = {row: b for row in order if (b := found[row]["behind"]) is not None}
    ahead = [row for row, b in behind.items() if b.high < 0]
    if ahead:
        also = f" (and {len(ahead) - 1} more)" if len(ahead) > 1 else ""
        return (
            f"{head}{ahead[0]}{also} is better than slipid: {_percent(errors[ahead[0]])} against "
            f"{mine}, {_points(behind[ahead[0]])}"
        )
    best = order[0]
    text = f"{head}error of slipid {mine}, of the best other row, {best}, {_percent(errors[best])}"
    tied = [row for row, b in behind.items() if b.low <= 0 <= b.high]
    if tied:
        more = f" and {len(tied) - MOST_NAMED_ROWS} more" if len(tied) > MOST_NAMED_ROWS else ""
        return f"{text}; no significant difference to {', '.join(tied[:MOST_NAMED_ROWS])}{more}"
    return f"{text}, {_points(behind[best])}" if best in behind else text


def _percent(x: MeanInterval) -> str:
    return f"{100 * x.value:.1f} %"


def _points(x: MeanInterval) -> str:
    """Return a difference in percentage points with its interval, as text."""
    return f"{100 * x.value:+.1f} points [{100 * x.low:+.1f}, {100 * x.high:+.1f}]"
