"""Cross-validation of every slip model: the folds of runs, and the scores of each fold.

If headings are held out, all runs of a heading are in the same fold, at every speed and on every
floor, so that a held-out heading is not fitted on any floor. Neither are runs over several floors
with this commanded heading.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.data.runs import Runs
from slipid.fitting.optimise import Optimum, optimise
from slipid.fitting.problem import Problem, fixed_viscosities
from slipid.predict import open_loop as replay
from slipid.predict.fitted_slip_model import fit_with_noise
from slipid.predict.predictive import PredictiveModel, force_balance_of
from slipid.predict.score import setups
from slipid.predict.slip_models import slip_models
from slipid.predict.validation import ScoredRun, add_scores, plain_values
from slipid.search_space import Choice
from slipid.support.content import Content
from slipid.support.errors import DataError

Fold = Int[np.ndarray, " run"]


@dataclass(frozen=True)
class FoldKey:
    """Properties of a run by which folds are made.

    Attributes:
        floor: floor, followed by the load set-up if it is not the main one (`score.setups`).
        heading_deg: commanded direction of travel [deg], nan if unknown.
        speed: commanded speed [m/s], nan if unknown.
    """

    floor: str
    heading_deg: float
    speed: float


def fold_keys(data: Runs) -> list[FoldKey]:
    """Return the fold keys of all runs; unknown directions and speeds are nan."""
    where = setups(data.surface, [log.load for log in data.logs])
    heading, speed = np.degrees(data.heading).tolist(), data.speed.tolist()
    return [FoldKey(*key) for key in zip(where, heading, speed, strict=True)]


def _by_heading(keys: Sequence[FoldKey], of: Callable[[Float[np.ndarray, " run"]], Fold]) -> Fold:
    """Return the fold `of(heading)` of every commanded heading [deg], -1 for unknown headings."""
    heading = np.array([f.heading_deg for f in keys], float)
    known = np.isfinite(heading)
    return np.where(known, of(np.where(known, heading, 0.0)), -1)


def sectors(keys: Sequence[FoldKey]) -> Fold:
    """Return the fold of every run: the 60 deg sector of its commanded heading, -1 if unknown."""
    return _by_heading(keys, lambda h: (np.floor((h % 360.0 + 1e-6) / 60.0) % 6).astype(int))


def random_headings(keys: Sequence[FoldKey]) -> Fold:
    """Return the fold of every run: one of six, drawn at random for every 5 deg of heading.

    Runs without a commanded heading have fold -1.
    """
    dealt = np.random.default_rng(0).permutation(72) % 6
    return _by_heading(keys, lambda h: dealt[np.round(h / 5.0).astype(int) % 72])


def speeds(keys: Sequence[FoldKey], most: int | None = None) -> Fold:
    """Return the fold of every run by its commanded speed, -1 for runs that are never held out.

    Every speed is a fold; if there are more than twice `most` speeds, the folds are `most` groups
    of equally many speeds. Never held out are turns on the spot, runs without a commanded speed,
    and runs with a floor and load set-up all of whose runs are in one fold.
    """
    speed = np.round([f.speed for f in keys], 3)
    where, known = np.array([f.floor for f in keys]), np.isfinite(speed) & (speed > 0)
    every = np.unique(speed[known])
    edges = every[1:]
    if most is not None and len(every) > 2 * most:
        edges = np.quantile(every, np.arange(1, most) / most)
    fold = np.where(known, np.searchsorted(edges, speed, "right"), -1)
    for floor in np.unique(where):
        if len(np.unique(fold[(where == floor) & (fold >= 0)])) < 2:
            fold[where == floor] = -1
    return fold


QUESTIONS: dict[str, Callable[[Sequence[FoldKey]], Fold]] = {
    "sectors": sectors,
    "speeds": speeds,
    "random": random_headings,
}
"""Functions that assign runs to folds, keyed by the question that the comparison answers.

Held out together are the runs of a 60 degree sector of headings, of one speed, or of random
headings.
"""


def inner_folds(data: Runs, question: str, judged: np.ndarray) -> Fold:
    """Return the folds of the inner cross-validation with which a model selects its settings.

    The inner folds hold out runs as the question does. A sector next to a judged sector gets fold
    -1 (never held out) if at least two other sectors remain: both sectors together would leave a
    gap twice as wide as that of the question.

    Args:
        data: all runs.
        question: a key of `QUESTIONS`.
        judged: indices of the runs that are judged, which are not used for training.
    """
    fold = QUESTIONS[question](fold_keys(data))
    if question != "sectors":
        return fold
    left_out = np.unique(fold[judged])
    beside = np.isin(fold, [(left_out + 1) % 6, (left_out - 1) % 6])
    inner = np.where(beside, -1, fold)
    rest = np.setdiff1d(inner, [-1, *left_out.tolist()])
    return inner if len(rest) > 1 else fold


def folds_of(data: Runs, question: str, parts: int | None = None) -> Fold:
    """Return the fold of every run; -1 for runs that are always fitted and never judged.

    Runs with fold -1 lack the property by which runs are held out, or holding out their fold would
    leave no run of their floor and load set-up. If `parts` is given, folds whose numbers have the
    same remainder modulo `parts` are merged.

    Raises:
        DataError: the question is unknown.
        ValueError: there are fewer than two parts.
    """
    if question not in QUESTIONS:
        raise DataError(
            f"folds '{question}': no such question; expected one of {', '.join(QUESTIONS)}"
        )
    if parts is not None and parts < 2:
        raise ValueError(f"folds in {parts} parts; expected 2 or more")
    keys = fold_keys(data)
    fold = QUESTIONS[question](keys)
    if parts is not None:
        fold = np.where(fold < 0, fold, fold % parts)
    group = np.array([f.floor for f in keys])
    for name in np.unique(group):
        if len(np.unique(fold[group == name])) < 2:
            fold[group == name] = -1
    return fold


def like_held_out(
    data: Runs, judged: np.ndarray, others: Sequence[Runs], question: str
) -> Bool[np.ndarray, " other"]:
    """Return True for the runs of other sets whose heading or speed a fold of `data` holds out.

    Runs without a commanded heading or speed are not among them.

    Args:
        data: runs of the fold.
        judged: indices of the held-out runs.
        others: other sets of runs, in the order of the result.
        question: key of `QUESTIONS` by which runs are held out.
    """
    heading = np.degrees(np.concatenate([runs.heading for runs in others]))
    speed = np.concatenate([runs.speed for runs in others])
    if question == "speeds":
        return np.isin(np.round(speed, 3), np.round(data.speed[judged], 3))
    keys = [FoldKey("", *both) for both in zip(heading.tolist(), speed.tolist(), strict=True)]
    held_out = QUESTIONS[question](fold_keys(data))[judged]
    return np.isin(QUESTIONS[question](keys), held_out[held_out >= 0])


@dataclass(frozen=True)
class FoldResult:
    """Scores of all models on the runs of a fold, and how the fit of the force balance ended.

    Attributes:
        rows: scores of every run.
        seconds: time to `fit` and to `predict` [s], keyed by model.
        numbers: number of fitted parameters, keyed by model and floor.
        converged: True if the fit of the force balance converged.
        reason: reason why the fit of the force balance stopped.
    """

    rows: tuple[ScoredRun, ...]
    seconds: dict[str, dict[str, float]]
    numbers: dict[str, dict[str, int]]
    converged: bool
    reason: str

    def to_json(self) -> Content:
        return asdict(self, dict_factory=plain_values)


@dataclass(frozen=True, eq=False)
class FoldModels:
    """Every model, fitted to the runs that a fold does not hold out.

    Attributes:
        problem: problem of the runs on one floor each.
        optimum: result of the fit of the force balance.
        models: the fitted models, the force balance first.
        seconds: time to fit [s], keyed by model.
    """

    problem: Problem
    optimum: Optimum
    models: tuple[PredictiveModel, ...]
    seconds: dict[str, float]


def fit_fold(
    problem: Problem,
    choices: Sequence[Choice],
    data: Runs,
    question: str,
    judged: np.ndarray,
    fit: Callable[..., Optimum] = optimise,
    beside: Bool[np.ndarray, " segment"] | None = None,
) -> FoldModels:
    """Return every slip model, fitted to all runs except `judged`; arguments as in `judge`.

    No measurement of the held-out runs is used, but for what the problem was made with: the priors,
    the start, and the lag and duration for which windows were cut. If the problem has runs over
    several floors, the force balance is fitted to the other runs first and then to all; the other
    slip models only take its camera.
    """
    fitted = np.setdiff1d(np.arange(len(data)), judged)
    problem = problem_of_runs(problem, choices, data, fitted)
    keep = np.isin(problem.windows.run, fitted).astype(float)
    alone, kept = problem, problem.full_weight
    kept[: len(keep)] = keep
    if beside is not None:
        kept[len(keep) :] = ~beside
    began = time.perf_counter()
    if problem.multi_floor is None:
        optimum = fit(problem, keep=keep)
    else:
        alone = problem.with_multi_floor(None)
        first = fit(alone, keep=keep)
        start = replace(problem.carried_over(first.state, alone), round=0)
        optimum = fit(problem, keep=kept, start=start)
    contact = force_balance_of(problem, optimum.state, optimum.covariance, kept)
    models: list[PredictiveModel] = [contact]
    seconds = {contact.name: time.perf_counter() - began}
    together, shape = inner_folds(data, question, judged), problem.robot.geometry
    for model in slip_models(shape, problem.windows.has_current, together):
        began = time.perf_counter()
        models.append(fit_with_noise(model, contact, alone, keep))
        seconds[model.name] = time.perf_counter() - began
    return FoldModels(alone, optimum, tuple(models), seconds)


def problem_of_runs(
    problem: Problem, choices: Sequence[Choice], data: Runs, fitted: np.ndarray
) -> Problem:
    """Return the problem, with viscosities that the runs `fitted` cannot determine fixed near zero.

    `fitted` holds indices of runs of `data`; see `fixed_viscosities`.
    """
    fixed = fixed_viscosities(data, fitted)
    return problem.holding(fixed, choices) if fixed else problem


def judge(
    problem: Problem,
    choices: Sequence[Choice],
    data: Runs,
    question: str,
    judged: np.ndarray,
    fit: Callable[..., Optimum] = optimise,
    beside: Bool[np.ndarray, " segment"] | None = None,
) -> FoldResult:
    """Fit every slip model to the runs outside one fold, and return its scores on the fold's runs.

    Args:
        problem: problem of all the runs of `data`, made with the choices.
        choices: the user's choices for parameters.
        data: all runs.
        question: key of `QUESTIONS` by which runs are held out, and by which models select their
            settings on the other runs.
        judged: indices of the held-out runs.
        fit: function that fits the problem.
        beside: True for segments of runs over several floors that are held out, too.
    """
    fold = fit_fold(problem, choices, data, question, judged, fit, beside)
    problem, optimum = fold.problem, fold.optimum
    seconds = {name: {"fit": spent} for name, spent in fold.seconds.items()}
    part = data.subset(judged)
    runs: dict[int, ScoredRun] = {}
    cuts = replay.replay_windows(part, fold.models[0].robot)
    for model in fold.models:
        began = time.perf_counter()
        for w in cuts:
            add_scores(runs, part, model.name, *model.ends(w))
        seconds[model.name]["predict"] = time.perf_counter() - began
        density = model.log_density(problem)
        for k, number in enumerate(judged):
            of_run = float(density[problem.windows.run == number].sum())
            runs[k].models[model.name] = replace(runs[k].models[model.name], log_density=of_run)
    return FoldResult(
        rows=tuple(replace(runs[k], session=name) for k, name in enumerate(part.session)),
        seconds=seconds,
        numbers={model.name: model.numbers for model in fold.models},
        converged=bool(optimum.converged),
        reason=optimum.reason,
    )
