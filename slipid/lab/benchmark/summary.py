"""Summaries over all folds: means over runs, their intervals and differences run by run.

Errors of runs in similar directions are correlated, so that a floor has fewer independent errors
than runs. Intervals come from a jackknife: with the estimate T of all runs, and T_g without the
g-th of the G clusters of a floor,

    s^2 = sum over floors of v,   v = (G - 1) / G sum_g (T_g - T)^2

and the interval is T -+ t s, on a scale on which its ends cannot leave the range of the quantity
(`Scale`). t is a quantile of Student's distribution with (sum v)^2 / sum (v^2 / d) degrees of
freedom (Satterthwaite 1946, Biometrics Bulletin 2(6)), where d + 1 = (sum n_g)^2 / sum n_g^2 is the
effective number of a floor's clusters, which have n_g runs. Source for the jackknife: MacKinnon,
Nielsen and Webb 2023, J. Applied Econometrics 38(5).

`reading` compares slipid's end-point errors with those of the other rows in sentences.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import expit, logit
from scipy.stats import t as student

from slipid.lab.benchmark.scores import FoldScore, RunScore
from slipid.lab.benchmark.slipid_rows import NAME
from slipid.support.content import Content

MOST_NAMED_ROWS = 4
"""Largest number of tied rows that a sentence names."""
CONFIDENCE = 0.9
"""Nominal probability that an interval contains the true value."""
FEWEST_CLUSTERS = 5
"""Number of clusters on a floor below which a mean over this floor has no interval."""
TOO_FEW = f"no interval, since the runs form fewer than {FEWEST_CLUSTERS} clusters"
"""Reason why a mean has no interval."""
Scale = Literal["any", "positive", "share"]
"""Range of a quantity: any number, positive numbers, or numbers between 0 and 1.

Intervals are symmetric for the quantity itself, for its logarithm, or for its log odds."""
Weights = Float[np.ndarray, "estimate run"]


class MeanInterval(NamedTuple):
    """A mean and the ends of its 90 % interval, None if there are too few clusters."""

    value: float
    low: float | None
    high: float | None


RowSummary = Content
"""Row of a method in one protocol of one data set, in the form of benchmark.json.

Values that are not listed are means of the attribute of `RunScore` with the same name
(`coverage90` of `covered90`, `floor_accuracy` of `floor_right`), first over the runs of each floor
and then over floors, with their intervals; None if the method does not predict them.

- floors: mean end-point error of each floor, with its load set-up.
- behind: end-point error less that of slipid on the same runs; None for slipid
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
    weights, base = Jackknife.of(first), done.get(reference)
    out: dict[str, RowSummary] = {}
    for name, score in scores.items():
        # all rows of a table are compared on the same runs
        assert not score.runs or [r.name for r in score.runs] == [r.name for r in first]
        rival = None if name == reference else base
        out[name] = _summary(score, folds[name], rival, weights)
    return out


@dataclass(frozen=True, eq=False)
class Jackknife:
    """Weights of runs with which estimates are repeated, each time without one cluster.

    Attributes:
        floor: index of the floor of each run.
        names: names of the floors.
        weights: weight of each run in each estimate. In the first estimate every run has weight 1.
            In each other one, the runs of one cluster have weight 0, and those of the G - 1 other
            clusters of the same floor G / (G - 1), so that the weight of the floor stays the same.
        left_out: index of the floor of each estimate's cluster, without the first estimate.
        degrees: degrees of freedom of each floor; 0 with a single cluster.
    """

    floor: Int[np.ndarray, " run"]
    names: tuple[str, ...]
    weights: Weights
    left_out: Int[np.ndarray, " cluster"]
    degrees: Float[np.ndarray, " floor"]

    @classmethod
    def of(cls, runs: Sequence[RunScore]) -> "Jackknife":
        """Return weights of scored runs; a run with a negative cluster is a separate cluster."""
        sector = np.array([run.cluster for run in runs])
        alone = -1 - np.arange(len(runs))
        return cls.by([run.floor for run in runs], np.where(sector < 0, alone, sector))

    @classmethod
    def by(cls, floors: Sequence[str], cluster: np.ndarray) -> "Jackknife":
        """Return weights of items, given the floor and the cluster of each item."""
        names = tuple(dict.fromkeys(floors))
        floor = np.array([names.index(name) for name in floors])
        rows, left_out, degrees = [np.ones(len(floors))], [], []
        for k in range(len(names)):
            kinds, counts = np.unique(cluster[floor == k], return_counts=True)
            degrees.append(counts.sum() ** 2 / (counts**2).sum() - 1.0)
            for kind in kinds if len(kinds) > 1 else ():
                whole = np.where(cluster == kind, 0.0, len(kinds) / (len(kinds) - 1))
                rows.append(np.where(floor == k, whole, 1.0))
                left_out.append(k)
        return cls(floor, names, np.array(rows), np.array(left_out, int), np.array(degrees))

    def mean(self, x: Float[np.ndarray, " run"]) -> Float[np.ndarray, " estimate"]:
        """Return the mean over floors of means over runs; floors without any value are ignored.

        NaN values are ignored too, unless a floor's only values are those of the cluster that is
        left out: its mean is then unknown.
        """
        return np.mean([self.on(x, k) for k in self.known(x)], axis=0)

    def known(self, x: Float[np.ndarray, " run"]) -> list[int]:
        """Return the indices of the floors with a value."""
        return [k for k in range(len(self.names)) if np.isfinite(x[self.floor == k]).any()]

    def over_all(self, x: Float[np.ndarray, " run"]) -> Float[np.ndarray, " estimate"]:
        """Return the mean over all runs, whatever their floor."""
        return np.asarray(self.weights @ x / self.weights.sum(axis=1))

    def on(self, x: Float[np.ndarray, " run"], floor: int) -> Float[np.ndarray, " estimate"]:
        """Return the mean over the runs on a floor; NaN values are ignored."""
        mine = (self.floor == floor) & np.isfinite(x)
        w = self.weights[:, mine]
        total = w.sum(axis=1)
        return np.where(total > 0, w @ x[mine] / np.maximum(total, 1e-12), np.nan)

    def interval(
        self,
        estimates: Float[np.ndarray, " estimate"],
        scale: Scale = "any",
        floors: Sequence[int] | None = None,
    ) -> MeanInterval:
        """Return the first estimate with its interval, of a quantity on some floors or on all.

        The interval is missing if there are too few clusters, and for a share of exactly 0 or 1,
        which has no scatter from which its error could be estimated.
        """
        value = float(estimates[0])
        mine = list(range(len(self.names)) if floors is None else floors)
        count = np.array([(self.left_out == k).sum() for k in mine])
        change = (estimates[1:] - value) ** 2
        sums = np.array([change[self.left_out == k].sum() for k in mine])
        variance = sums * (1 - 1 / np.maximum(count, 1))
        too_few = count.min() < 2 or (count - 1).sum() < FEWEST_CLUSTERS - 1
        if too_few or not np.isfinite(sums).all() or (scale == "share" and value in (0.0, 1.0)):
            return MeanInterval(value, None, None)
        if not variance.any():
            return MeanInterval(value, value, value)
        freedom = variance.sum() ** 2 / (variance**2 / self.degrees[mine]).sum()
        quantile = float(student.isf((1 - CONFIDENCE) / 2, max(freedom, 1.0)))
        return _around(value, quantile * float(np.sqrt(variance.sum())), scale)


def _around(value: float, half: float, scale: Scale) -> MeanInterval:
    """Return the interval around a value that is symmetric on the scale of the quantity.

    `half` is half its width on the scale of the value itself, if it is narrow.
    """
    sides = np.array([-1.0, 1.0])
    if scale == "positive":
        low, high = value * np.exp(sides * half / value)
    elif scale == "share":
        low, high = expit(logit(value) + sides * half / (value * (1 - value)))
    else:
        low, high = value + sides * half
    return MeanInterval(value, float(low), float(high))


def _summary(
    score: FoldScore[RunScore],
    folds: Sequence[FoldScore[RunScore]],
    rival: Sequence[RunScore] | None,
    by: Jackknife,
) -> RowSummary:
    """Return the row of a method, compared with the scores `rival` if there are any."""
    runs, ended = score.runs, folds if score.runs else ()

    def mean(name: str, scale: Scale = "positive") -> MeanInterval | None:
        found = [getattr(run, name) for run in runs]
        x = np.array([np.nan if value is None else float(value) for value in found])
        known = by.known(x) if runs else []
        return by.interval(by.mean(x), scale, known) if known else None

    error = np.array([run.endpoint_error for run in runs])
    behind, floors = None, None
    if runs:
        floors = {
            name: by.interval(by.on(error, k), "positive", [k]) for k, name in enumerate(by.names)
        }
    if runs and rival:
        behind = by.interval(by.mean(error - np.array([run.endpoint_error for run in rival])))
    return {
        "endpoint_error": mean("endpoint_error"),
        "floors": floors,
        "behind": behind,
        "length_error": mean("length_error"),
        "heading_error_deg": mean("heading_error_deg"),
        "twist_error": mean("twist_error"),
        "coverage90": mean("covered90", "share"),
        "slip_auc": _auc(runs, by) if runs else None,
        "floor_accuracy": mean("floor_right", "share"),
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


def _auc(runs: Sequence[RunScore], by: Jackknife) -> MeanInterval | None:
    """Return the area under the slip detection curve over all windows; None if it is undefined."""
    score = np.concatenate([run.scores for run in runs])
    slips = np.concatenate([np.asarray(run.slips, bool) for run in runs])
    if slips.all() or not slips.any():
        return None
    of = np.repeat(np.arange(len(runs)), [len(run.scores) for run in runs])
    return by.interval(np.array([area(score, slips, w[of]) for w in by.weights]), "share")


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
    paired = {row: b for row in order if (b := found[row]["behind"]) is not None}
    behind = {row: b for row, b in paired.items() if b.low is not None}
    ahead = [row for row, b in behind.items() if b.high < 0]
    if ahead:
        also = f" (and {len(ahead) - 1} more)" if len(ahead) > 1 else ""
        return (
            f"{head}{ahead[0]}{also} is better than slipid: {_percent(errors[ahead[0]])} against "
            f"{mine}, {_points(behind[ahead[0]])}"
        )
    best = order[0]
    text = f"{head}error of slipid {mine}, of the best other row, {best}, {_percent(errors[best])}"
    if paired and not behind:
        return f"{text}; {TOO_FEW}"
    tied = [row for row, b in behind.items() if b.low <= 0 <= b.high]
    if tied:
        more = f" and {len(tied) - MOST_NAMED_ROWS} more" if len(tied) > MOST_NAMED_ROWS else ""
        return f"{text}; no significant difference to {', '.join(tied[:MOST_NAMED_ROWS])}{more}"
    return f"{text}, {_points(behind[best])}" if best in behind else text


def _percent(x: MeanInterval) -> str:
    return f"{100 * x.value:.1f} %"


def _points(x: MeanInterval) -> str:
    """Return a difference in percentage points with its interval, as text."""
    ends = (f"{100 * end:+.1f}" for end in (x.low, x.high) if end is not None)
    return f"{100 * x.value:+.1f} points [{', '.join(ends) or '-'}]"
