"""Ranking of slip models by held-out runs, and transfer of slip curves between floors.

The transfer tests whether a curve of slip over current is valid on a floor it was not fitted to:
one curve s = b0 + b1 |I| for all wheels is fitted to all floors but one and judged on the remaining
floor. The curve is compared with a constant slip fitted to the same floors, and with a curve fitted
to the remaining floor itself.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import binom

from slipid.data.runs import Runs
from slipid.data.windows import Windows
from slipid.fitting.problem import Problem
from slipid.model.robot import Robot
from slipid.predict.folds import folds_of, judge
from slipid.predict.score import Score, clusters, main_load, mean_error
from slipid.predict.slip_model import body_twist
from slipid.predict.validation import ScoredRun, by_floor, finite
from slipid.search_space import Choice
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SURE_STDS, SMALL_NATS = 2.0, 4.0
"""Smallest relevant difference of two models: in standard errors, and in nats over all runs.

Below four nats in total, models predict equally well and the standard error of their difference is
unreliable: a model with one superfluous parameter, for example, loses a little in every run.
Source: Sivula, Magnusson, Matamoros and Vehtari 2020, arXiv:2008.10296."""


@dataclass(frozen=True)
class RankedModel:
    """Score of a model on a floor, and its difference to the best model.

    Attributes:
        elpd: mean log predictive density [nats per run], see `ranking`.
        difference: difference to the best model [nats per run].
        se: standard error of the difference over runs.
        se_clustered: standard error of the difference over sectors of headings.
        verdict: `best`, `tied` or `worse`.
        endpoint_error: mean end-point error, divided by the straight-line displacement of the run.
        endpoint_error_se: standard error of `endpoint_error` over sectors of headings.
        energy_score: mean of `Score.energy_score` over runs [m].
        coverage50, coverage90: fraction of runs that ended in their 50 % or 90 % region.
        heading_error_median_deg: median heading error [deg].
    """

    elpd: float
    difference: float
    se: float | None
    se_clustered: float | None
    verdict: str
    endpoint_error: float
    endpoint_error_se: float | None
    energy_score: float
    coverage50: float
    coverage90: float
    heading_error_median_deg: float


@dataclass(frozen=True)
class Ranking:
    """Ranking of the models on a floor.

    Attributes:
        runs: number of runs.
        clusters: number of sectors of headings.
        best: name of the best model.
        sentence: summary in one sentence, for people.
        band50, band90: range in which the coverage of calibrated forecasts lies, see `_band`.
        models: scores of every model, keyed by name.
    """

    runs: int
    clusters: int
    best: str
    sentence: str
    band50: tuple[float, float]
    band90: tuple[float, float]
    models: dict[str, RankedModel]


def ranking(runs: Sequence[ScoredRun]) -> dict[str, Ranking]:
    """Return, for every floor, the models' scores, their differences to the best one, and verdicts.

    The score is the expected log predictive density of a run's logged poses [nats per run], where
    every run is predicted by a fit that does not include it. A model is tied with the best one if
    the difference is less than `SURE_STDS` clustered standard errors or, summed over all runs, less
    than `SMALL_NATS` nats.
    """
    return {floor: _floor(floor, mine) for floor, mine in by_floor(runs).items()}


def _floor(floor: str, runs: Sequence[ScoredRun]) -> Ranking:
    names, cluster = list(runs[0].models), clusters([run.heading_deg for run in runs])
    scores = {m: [run.models[m] for run in runs] for m in names}
    density = {m: np.array([s.log_density for s in scores[m]], float) for m in names}
    best = max(names, key=lambda m: float(density[m].mean()))
    models = {m: _ranked(scores[m], density[m] - density[best], m == best, cluster) for m in names}
    return Ranking(
        runs=len(runs),
        clusters=len(np.unique(cluster)),
        best=best,
        sentence=_sentence(floor, best, models),
        band50=_band(len(runs), 0.5),
        band90=_band(len(runs), 0.9),
        models=models,
    )


def _ranked(
    scores: Sequence[Score], behind: np.ndarray, is_best: bool, cluster: np.ndarray
) -> RankedModel:
    """Return the ranked model with the given scores.

    Args:
        scores: scores of every run.
        behind: log density of every run less that of the best model [nats].
        is_best: True for the best model itself.
        cluster: sector of headings of every run.
    """
    difference, se, clustered = mean_error(behind, cluster)
    far, _, far_se = mean_error(np.array([s.endpoint_error for s in scores]), cluster)
    level = np.array([s.level for s in scores], float)
    is_clear = (
        abs(difference) >= SURE_STDS * clustered and abs(difference) * len(scores) >= SMALL_NATS
    )
    return RankedModel(
        elpd=float(np.mean([s.log_density for s in scores if s.log_density is not None])),
        difference=difference,
        se=finite(se),
        se_clustered=finite(clustered),
        verdict="best" if is_best else "worse" if is_clear else "tied",
        endpoint_error=far,
        endpoint_error_se=finite(far_se),
        energy_score=float(np.mean([s.energy_score for s in scores])),
        coverage50=float(np.mean(level <= 0.5)),
        coverage90=float(np.mean(level <= 0.9)),
        heading_error_median_deg=float(np.median([s.heading_error_deg for s in scores])),
    )


def _band(runs: int, share: float) -> tuple[float, float]:
    """Return the 99 % interval of a calibrated model's coverage over a number of runs.

    `share` is the probability of the forecast regions.
    """
    low, high = (float(binom.ppf(q, runs, share)) / runs for q in (0.005, 0.995))
    return low, high


def _sentence(floor: str, best: str, models: Mapping[str, RankedModel]) -> str:
    order = sorted((m for m in models if m != best), key=lambda m: -models[m].difference)
    if not order:
        return f"{floor}: no other model to compare with {_name(best)}"
    apart = {m: f"{_name(m)} ({_apart(models[m])})" for m in order}
    tied = [apart.pop(m) for m in order if models[m].verdict == "tied"]
    if tied:
        rest = f"; worse: {next(iter(apart.values()))}" if apart else ""
        return f"{floor}: the data cannot distinguish {_name(best)} from {' or '.join(tied)}{rest}"
    return (
        f"{floor}: {_name(best)} is best; next {_name(order[0])}, {_apart(models[order[0]])} "
        "nats per run worse"
    )


def _apart(model: RankedModel) -> str:
    se = model.se_clustered
    return f"{-model.difference:.1f} +- {'?' if se is None else format(se, '.1f')}"


def _name(model: str) -> str:
    return "contact equilibrium" if model == "identified" else model


@dataclass(frozen=True)
class Comparison:
    """Ranking of slip models on each floor; `print` shows a sentence per floor.

    Attributes:
        floors: ranking, keyed by floor.
        question: key of `folds.QUESTIONS`, by which runs were held out together.
    """

    floors: dict[str, Ranking]
    question: str

    def __str__(self) -> str:
        return "\n".join(floor.sentence for floor in self.floors.values())

    def plot(self) -> "Figure":
        """Plot every model's difference to the best one, and its end-point error."""
        from slipid.plots.compare import SHOWN, compare_figure

        floors = {name: asdict(floor) for name, floor in self.floors.items()}
        return compare_figure(floors, SHOWN[self.question])


def compared(
    problem: Problem,
    choices: Sequence[Choice],
    data: Runs,
    question: str,
    parts: int,
    quiet: bool = False,
) -> Comparison:
    """Compare all slip models, fold by fold; `problem` is that of all runs.

    Further arguments, and errors, are those of `Fit.compare`.
    """
    fold = folds_of(data, question, parts)
    if (fold < 0).all():
        raise DataError("no run can be held out; expected several headings or speeds")
    rows: list[ScoredRun] = []
    with Reporter(quiet=quiet) as report:
        for k in sorted(set(fold[fold >= 0].tolist())):
            report.stage(f"{question}: without part {k + 1} of {fold.max() + 1}")
            rows += judge(problem, choices, data, question, np.flatnonzero(fold == k)).rows
    return Comparison(ranking(rows), question)


LEAST_SPEED_RATIO = 0.2
"""Smallest fraction of the fastest wheel's speed at which a wheel is used in a window."""
VARIANTS: dict[str, tuple[float, bool, bool]] = {
    "all": (LEAST_SPEED_RATIO, False, False),
    "slower wheels too": (0.1, False, False),
    "fast wheels only": (0.5, False, False),
    "as built only": (LEAST_SPEED_RATIO, True, False),
    "0 < s <= 1, I > 0.25 A only": (LEAST_SPEED_RATIO, False, True),
}
"""Rows that `transfer` uses, keyed by the name of the choice.

A choice holds the smallest wheel speed relative to the fastest wheel's, True for only the main load
set-up, and True for the filter of the 2021 paper: 0 < s <= 1 and I > 0.25 A.

The filter truncates the slip and therefore underestimates the remaining errors.
"""


def transfer(w: Windows, robot: Robot) -> dict[str, Content]:
    """Return leave-one-floor-out errors of slip, keyed by `VARIANTS`; empty for a single floor.

    The errors of a variant are the slip less the curve fitted to the other floors (`pooled`), the
    slip less the mean slip on the other floors (`constant`), and the slip less the curve fitted to
    the floor itself (`per_surface`); `count` is the number of rows. Each error is given as the root
    mean square over all `rows`, as the root mean square over the rows of `each` floor, and as the
    mean of the values in `each` (`floors`).

    A row is one wheel in one window, with the slip s = 1 - J xi / (r w), where xi is the body twist
    from the camera in corrected metres, and the mean magnitude I of the wheel's current.
    """
    if len(set(w.surface)) < 2:
        return {}
    w = w.at_lag(float(robot.camera.lag))
    forward = np.asarray(robot.geometry.forward()) / float(robot.geometry.wheel_radius)
    speed = w.turn / w.dt[..., None]
    slip = 1 - (body_twist(w, robot) @ forward.T) / np.where(speed == 0.0, np.nan, speed)
    share = np.abs(speed) / np.abs(speed).max(axis=-1, keepdims=True)
    amps = np.abs(w.current)
    floor = np.broadcast_to(np.asarray(w.surface)[:, None, None], slip.shape)
    load = np.broadcast_to(np.asarray(w.load)[:, None, None], slip.shape)
    main = main_load(w.load)
    out = {}
    for name, (least, one_load, cut) in VARIANTS.items():
        rows = (share >= least) & np.isfinite(slip) & ((load == main) | (not one_load))
        if cut:
            rows &= (slip > 0) & (slip <= 1) & (amps > 0.25)
        if len(set(floor[rows].tolist())) > 1:
            out[name] = errors_by_floor(slip[rows], amps[rows], floor[rows])
    return out


def errors_by_floor(slip: np.ndarray, amps: np.ndarray, floor: np.ndarray) -> Content:
    """Return the errors for given rows of slip, current [A] and floor; see `transfer`."""
    pooled, constant, own = {}, {}, {}
    line = np.stack([np.ones_like(amps), amps], axis=-1)
    for name in sorted(set(floor.tolist())):
        mine = floor == name
        others = np.linalg.lstsq(line[~mine], slip[~mine], rcond=None)[0]
        alone = np.linalg.lstsq(line[mine], slip[mine], rcond=None)[0]
        pooled[name] = slip[mine] - line[mine] @ others
        constant[name] = slip[mine] - slip[~mine].mean()
        own[name] = slip[mine] - line[mine] @ alone
    out: Content = {}
    for name, gaps in {"pooled": pooled, "constant": constant, "per_surface": own}.items():
        each = {floor: float(np.sqrt(np.mean(gap**2))) for floor, gap in gaps.items()}
        rows = float(np.sqrt(np.mean(np.concatenate(list(gaps.values())) ** 2)))
        out[name] = {"rows": rows, "floors": float(np.mean(list(each.values()))), "each": each}
    return out | {"count": len(slip)}
