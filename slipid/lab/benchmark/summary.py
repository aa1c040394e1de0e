"""Folds put together: means over runs, intervals by resampling, and differences run by run."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.lab.benchmark.scores import FoldScore, RunScore

DRAWS = 1000
"""Of the bootstrap."""
INTERVAL = (0.05, 0.95)
FEW = 2
"""Clusters on a floor below which its runs are resampled one by one."""
Weights = Float[np.ndarray, "draw run"]


class MeanInterval(NamedTuple):
    """A mean and its 90 % interval by resampling."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class RowSummary:
    """A row in one protocol of one data set; attributes as of `RunScore` where they are its means.

    Means are over the runs of each floor, then over floors. What a method does not say is None.

    Attributes:
        floors: mean end-point error of each floor, with its load set-up.
        behind: end-point error less that of slipid, the same runs resampled in both; None of
            slipid itself, and where it is not there.
        slip_auc: area under the receiver operating characteristic of slip detection, by windows;
            None where robots always or never slip.
        runs: how many.
        numbers, tune_s, fit_s, step_us: median over folds.
        settings: that were picked in each fold.
        unconverged: folds in which a fit in rounds did not come to rest.
        absent: why there are no runs, see `FoldScore`.
    """

    endpoint_error: MeanInterval | None = None
    floors: Mapping[str, MeanInterval] | None = None
    behind: MeanInterval | None = None
    length_error: MeanInterval | None = None
    heading_error_deg: MeanInterval | None = None
    twist_error: MeanInterval | None = None
    coverage90: MeanInterval | None = None
    slip_auc: MeanInterval | None = None
    floor_accuracy: MeanInterval | None = None
    energy_error: MeanInterval | None = None
    runs: int = 0
    numbers: int = 0
    tune_s: float = 0.0
    fit_s: float = 0.0
    step_us: float = 0.0
    settings: tuple[str, ...] = ()
    unconverged: int = 0
    absent: str = ""
    failed: bool = False


def summary(folds: Mapping[str, Sequence[FoldScore]], reference: str) -> dict[str, RowSummary]:
    """Every row by its folds; the reference is the row that the others are compared with.

    A row that is absent in some fold is absent altogether: its runs would be others.
    """
    there = {name: each for name, each in folds.items() if each and not any(r.absent for r in each)}
    done = {name: [run for row in each for run in row.runs] for name, each in there.items()}
    out: dict[str, RowSummary] = {}
    first = next(iter(done.values()), [])
    if first:
        weights = Bootstrap.of(first)
        base = done.get(reference)
        for name, runs in done.items():
            assert [run.name for run in runs] == [run.name for run in first]
            rival = None if name == reference else base
            out[name] = _summary(there[name], runs, rival, weights)
    for name, each in folds.items():
        if name not in out:
            said = next((row for row in each if row.absent), FoldScore(absent="no run"))
            out[name] = RowSummary(absent=said.absent, failed=any(row.failed for row in each))
    return {name: out[name] for name in folds}


@dataclass(frozen=True, eq=False)
class Bootstrap:
    """Runs resampled with replacement, whole clusters of a floor at a time if there are enough.

    Attributes:
        floor: number of the floor of each run; names: of the floors.
        draws: how often each run counts in each draw; the first draw is the runs as they are.
    """

    floor: Int[np.ndarray, " run"]
    names: tuple[str, ...]
    draws: Weights

    @classmethod
    def of(cls, runs: Sequence[RunScore]) -> "Bootstrap":
        """Runs by their clusters; a run whose cluster is negative is one by itself."""
        sector = np.array([run.cluster for run in runs])
        alone = -1 - np.arange(len(runs))
        return cls.by([run.floor for run in runs], np.where(sector < 0, alone, sector))

    @classmethod
    def by(cls, floors: Sequence[str], cluster: np.ndarray) -> "Bootstrap":
        """Whatever is on these floors and in these clusters, one of each."""
        names = tuple(dict.fromkeys(floors))
        floor = np.array([names.index(name) for name in floors])
        rng = np.random.default_rng(0)
        draws = np.ones((DRAWS + 1, len(floors)))
        for k in range(len(names)):
            mine = np.flatnonzero(floor == k)
            kinds, of = np.unique(cluster[mine], return_inverse=True)
            if len(kinds) < FEW:  # clusters too few to say how they scatter
                kinds, of = mine, np.arange(len(mine))
            picked = rng.multinomial(len(kinds), np.full(len(kinds), 1 / len(kinds)), DRAWS)
            draws[1:, mine] = picked[:, of]
        return cls(floor, names, draws)

    def mean(self, x: Float[np.ndarray, " run"]) -> Float[np.ndarray, " draw"]:
        """Mean over floors of means over runs, in every draw; runs that are nan do not count."""
        return np.nanmean([self.on(x, k) for k in range(len(self.names))], axis=0)

    def over_all(self, x: Float[np.ndarray, " run"]) -> Float[np.ndarray, " draw"]:
        """Mean over all runs, whatever their floor, in every draw."""
        return np.asarray(self.draws @ x / np.maximum(self.draws.sum(axis=1), 1e-12))

    def on(self, x: Float[np.ndarray, " run"], floor: int) -> Float[np.ndarray, " draw"]:
        """Mean over the runs on a floor, in every draw."""
        mine = (self.floor == floor) & np.isfinite(x)
        w = self.draws[:, mine]
        total = w.sum(axis=1)
        return np.where(total > 0, w @ x[mine] / np.maximum(total, 1e-12), np.nan)


def mean_interval(draws: Float[np.ndarray, " draw"]) -> MeanInterval:
    """The first draw, and the interval that the others span."""
    low, high = np.nanquantile(draws[1:], INTERVAL)
    return MeanInterval(float(draws[0]), float(low), float(high))


def _summary(
    rows: Sequence[FoldScore],
    runs: Sequence[RunScore],
    rival: Sequence[RunScore] | None,
    by: Bootstrap,
) -> RowSummary:
    def mean(of: Callable[[RunScore], float | bool | None]) -> MeanInterval | None:
        x = np.array([np.nan if (v := of(run)) is None else float(v) for run in runs])
        return mean_interval(by.mean(x)) if np.isfinite(x).any() else None

    error = np.array([run.endpoint_error for run in runs])
    behind = None
    if rival is not None:
        behind = mean_interval(by.mean(error - np.array([run.endpoint_error for run in rival])))

    def median(name: str) -> float:
        return float(np.median([getattr(row, name) for row in rows]))

    return RowSummary(
        endpoint_error=mean_interval(by.mean(error)),
        floors={name: mean_interval(by.on(error, k)) for k, name in enumerate(by.names)},
        behind=behind,
        length_error=mean(lambda run: run.length_error),
        heading_error_deg=mean(lambda run: run.heading_error_deg),
        twist_error=mean(lambda run: run.twist_error),
        coverage90=mean(lambda run: run.covered90),
        slip_auc=_auc(runs, by),
        floor_accuracy=mean(lambda run: run.floor_right),
        energy_error=mean(lambda run: run.energy_error),
        runs=len(runs),
        numbers=int(median("numbers")),
        tune_s=median("tune_s"),
        fit_s=median("fit_s"),
        step_us=median("step_us"),
        settings=tuple(row.settings for row in rows),
        unconverged=sum(not row.converged for row in rows),
    )


def _auc(runs: Sequence[RunScore], by: Bootstrap) -> MeanInterval | None:
    """Area under the curve of slip detection over all windows, in a part of the draws."""
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
    """Weighted probability that a positive has a higher score than a negative; ties count half."""
    values, at = np.unique(score, return_inverse=True)
    up = np.bincount(at, weight * positive, len(values))
    down = np.bincount(at, weight * ~positive, len(values))
    both = up.sum() * down.sum()
    below = np.cumsum(down) - down
    return float(up @ (below + 0.5 * down) / both) if both > 0 else float("nan")
