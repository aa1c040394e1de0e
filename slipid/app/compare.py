"""Comparison of slip models on held-out runs, and open-loop prediction of runs by a fit.

This is the work of `slipid compare` and `slipid validate` except their pictures.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Int

from slipid.app.calibrate import calibrated, read_calibration
from slipid.app.config import Config, read_config, shape_of, single_floor_sections
from slipid.app.floor_maps import map_files
from slipid.app.identify import with_mixed_runs
from slipid.app.logs import config_of_fit, read_dataset
from slipid.app.problem import (
    ConfigFitTask,
    FitTask,
    lag_from_motion,
    read_fit_task,
    with_mixed,
    without_short_runs,
)
from slipid.data.check.columns import refuse_misordered
from slipid.data.check.findings import by_reason
from slipid.data.check.stuck import refuse_stuck
from slipid.data.runs import Runs
from slipid.data.windows import steady_duration
from slipid.fitting.calibration.estimate import calibrate
from slipid.fitting.multi_floor import multi_floor_runs
from slipid.fitting.optimise import Optimum, optimise
from slipid.fitting.problem import FitState, Problem
from slipid.infer.fit_file import load
from slipid.infer.result import Fit
from slipid.infer.result_folder import FIT, IDENTIFIED
from slipid.infer.summary import summarise
from slipid.predict.folds import Fold, folds_of, judge, like_held_out
from slipid.predict.kinematics import nominal
from slipid.predict.ranking import ranking, transfer
from slipid.predict.selection import calibrated_model
from slipid.predict.slip_models import FloorModels
from slipid.predict.validation import ScoredRun, Validation, validation
from slipid.search_space import Space
from slipid.support.checkpoint import Checkpoint, key_of, versions
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.files import writable, write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

SCHEMA = "slipid.comparison/1"
FOLDS = "folds"
"""Name of the folder, inside the result folder, with the checkpoints of finished folds."""
_Task = TypeVar("_Task", bound=FitTask)


def compare(
    config_path: Path, data: Path, out: Path, questions: Sequence[str], report: Reporter
) -> Content:
    """Return the comparison of slip models on held-out runs, and write it as comparison.json.

    Folds whose results are in `out` already are not fitted again.

    Args:
        config_path: the config.
        data: folder of the logs.
        out: folder to write to.
        questions: kinds of folds, each one of `slipid.predict.folds.QUESTIONS`.
        report: reporter of the progress.

    Raises:
        DataError: config, logs or questions are wrong; in this case nothing was written.
    """
    setup_jax(quiet=True)
    config = read_config(config_path)
    read = task = with_mixed(read_fit_task(config, data, report), data, report)
    refuse_misordered(task.logs)
    refuse_stuck(task.dataset, task.robot.geometry)
    folds_by_question = {name: folds_of(task.dataset, name) for name in dict.fromkeys(questions)}
    for name in [name for name, fold in folds_by_question.items() if (fold < 0).all()]:
        report.line(f"skipped: {name}: no floor has runs in two folds")
        del folds_by_question[name]
    if not folds_by_question:
        raise DataError(
            f"{config.path}: no run can be held out; expected runs with several headings or speeds"
        )
    task = task.started_from(calibrated(task, report).calibration)
    report.stage("cutting windows")
    problem = task.problem()
    writable(out)
    maps = sorted((name, file.read_bytes()) for name, file in map_files(config).items())
    names = problem.space.names, problem.noise.names
    kept = Checkpoint(out / FOLDS, key_of(config.hash, task.data_hash, *names, maps))
    problem, whole = _of_all_runs(task, problem, kept, report)
    robot = problem.space.tree(np.asarray(whole["z"], float))
    results = _folds(read, problem, folds_by_question, kept, report)
    surfaces = transfer(problem.windows, robot) if problem.windows.has_current else {}
    content: Content = {
        "schema": SCHEMA,
        "questions": {name: _answer(folds) for name, folds in results.items()},
        "surfaces": surfaces,
        "data": {
            "hash": task.data_hash,
            "runs": len(task.dataset),
            "over_several_floors": {
                "runs": sum(len(of) for of, _ in task.mixed),
                "refused": whole["refused"],
            },
            "skipped": list(task.skipped),
        },
        "config": {"name": config.path.name, "sha256": config.hash},
        "versions": versions(),
        "runs": {name: _rows(folds) for name, folds in results.items()},
    }
    report.stage("writing")
    write_json(out / "comparison.json", content)
    return content


def _rows(folds: Sequence[Content]) -> list[Content]:
    return [row for fold in folds for row in fold["rows"]]


def _answer(folds: Sequence[Content]) -> Content:
    """Return the ranking on each floor for one kind of folds, and the cost of each slip model."""
    floors = ranking([ScoredRun.of_json(row) for row in _rows(folds)])
    return {
        "folds": len(folds),
        "converged": all(fold["converged"] for fold in folds),
        "floors": {floor: asdict(one) for floor, one in floors.items()},
        "cost": _cost(folds),
    }


def _cost(folds: Sequence[Content]) -> Content:
    """Return, for each slip model, the number of fitted parameters and the times per fold [s].

    The times are those of the fit and of the prediction.
    """
    out = {}
    for model, numbers in folds[0]["numbers"].items():
        seconds = [fold["seconds"][model] for fold in folds]
        out[model] = {
            "numbers": numbers,
            "fit_s": float(np.median([s["fit"] for s in seconds])),
            "predict_s": float(np.median([s["predict"] for s in seconds])),
        }
    return out


def _of_all_runs(
    task: ConfigFitTask, problem: Problem, kept: Checkpoint, report: Reporter
) -> tuple[Problem, Content]:
    """Return the likelihood of all runs, and the content of the checkpoint of the fit to them.

    Runs over several floors are part of the likelihood unless they contradict the other runs. The
    content has the search vector `z` of the fit, that of the robot `near` which their windows were
    cut, and the reason why they were `refused`; None if this does not apply.

    Args:
        task: the fit task.
        problem: likelihood of the runs on one floor each.
        kept: checkpoint of finished fits.
        report: reporter of the progress.
    """

    def whole() -> Content:
        optimum = _fit(task, report)(problem)
        if not task.mixed:
            return {"z": optimum.state.z, "near": None, "refused": None}
        alone = summarise(problem, optimum, task.dataset, task.choices, task.settings.seed)
        fit, _, optimum = with_mixed_runs(alone, task, problem, optimum, report)
        return {
            "z": optimum.state.z,
            "near": fit.mixed and fit.mixed["near"],
            "refused": fit.refused and fit.refused["reason"],
        }

    report.stage("fitting all runs")
    found = finished(kept, "all_runs", whole)
    if found["near"] is not None:
        near = problem.space.tree(np.asarray(found["near"], float))
        problem = problem.with_multi_floor(multi_floor_runs(task.mixed, near))
    return problem, found


def _fit(task: ConfigFitTask, report: Reporter) -> Callable[..., Optimum]:
    """Return `optimise` with the limits of a task, which reports its progress."""

    def tell(state: FitState) -> None:
        report.note(f"{state.stage}, round {state.round}")

    limits = task.settings
    return partial(optimise, most_rounds=limits.rounds, tolerance=limits.tolerance, tell=tell)


def _folds(
    task: ConfigFitTask,
    problem: Problem,
    folds_by_question: Mapping[str, Fold],
    kept: Checkpoint,
    report: Reporter,
) -> dict[str, list[Content]]:
    """Return the results of all folds, keyed by the kind of fold.

    Runs over several floors are cut into windows once, for the fit to all runs.

    Args:
        task: the fit task, not started from a calibration.
        problem: likelihood of all runs.
        folds_by_question: index of each run's fold, keyed by the kind of fold.
        kept: checkpoint of finished fits.
        report: reporter of the progress.
    """
    fit = _fit(task, report)

    others = [data for data, _ in task.mixed]

    def one(name: str, held_out: np.ndarray) -> Content:
        beside, own = None, without(task, held_out)
        alone = own.problem()
        if problem.multi_floor is not None:
            runs = like_held_out(task.dataset, held_out, others, name)
            beside = runs[problem.multi_floor.windows.run]
            alone = alone.with_multi_floor(problem.multi_floor)
        found = judge(alone, own.choices, task.dataset, name, held_out, fit, beside)
        return found.to_json()

    work: dict[tuple[str, int], Callable[[], Content]] = {
        (name, k): partial(one, name, np.flatnonzero(fold == k))
        for name, fold in folds_by_question.items()
        for k in sorted({int(f) for f in fold if f >= 0})
    }
    report.stage("fitting every fold")
    done: dict[str, list[Content]] = {name: [] for name in folds_by_question}
    for count, ((name, k), make) in enumerate(work.items(), start=1):
        done[name].append(finished(kept, f"{name}_{k}", make))
        report.advance(count, len(work), f"{count} of {len(work)} folds, {name}")
    return done


def without(task: _Task, held_out: Int[np.ndarray, " some"]) -> _Task:
    """Return a task that was prepared without any measurement of held-out runs.

    The prior of the lag, the start of the fit and the length of the windows, which runs show, are
    those of the other runs. The held-out runs stay in the task and are cut into such windows, too.

    Args:
        task: fit task of all runs, not started from a calibration.
        held_out: indices of the held-out runs.
    """
    rest = task.dataset.subset(np.setdiff1d(np.arange(len(task.dataset)), held_out))
    split = len(task.choices) - task.user_choices
    known = [c for c in task.choices[:split] if c.pattern != "camera.lag"]
    given = any(fnmatchcase("camera.lag", c.pattern) for c in task.choices[split:])
    lag = [] if given else lag_from_motion(rest)
    choices = (*lag, *known, *task.choices[split:])
    longest = task.settings.longest_window_s or steady_duration(rest)
    settings = task.settings.model_copy(update={"longest_window_s": longest})
    found = calibrate(rest, Space(task.robot, choices), choices)
    return replace(task, choices=choices, settings=settings).started_from(found)


def finished(kept: Checkpoint, name: str, make: Callable[[], Content]) -> Content:
    """Return the result under a name in a checkpoint; if it is missing, compute and save it first.

    The result is always read from the checkpoint, so that it is the same after an interrupt.
    """
    content: Content | None = kept.load_json(name)
    if content is None:
        kept.save_json(name, make())
        content = kept.load_json(name)
        assert content is not None
    return content


def validate(
    out: Path, data: Path, report: Reporter, glob: str | None = None
) -> tuple[Fit, Runs, Validation]:
    """Return a fit, runs to predict, and their predictions by the fit and by all simpler models.

    Args:
        out: folder that `slipid identify` wrote.
        data: folder of the logs of the runs.
        report: reporter of the progress.
        glob: pattern of the paths of the logs, relative to `data`; None for those of the config.

    Raises:
        DataError: there is no fit, or the logs cannot be read or predicted.
    """
    setup_jax(quiet=True)
    fit = load(out)
    _, dataset = _judged(out, data, report, glob)
    if again := len(dataset) - fit.new_runs(dataset):
        report.line(
            f"{again} of {len(dataset)} runs were used in the fit: their errors say little about "
            "new runs"
        )
    report.stage("predicting")
    try:
        return fit, dataset, fit.validate(dataset)
    except DataError:
        raise
    except ValueError as error:
        raise DataError(f"{out / 'fit.json'}: {error}") from error


def validate_calibration(
    out: Path, data: Path, report: Reporter, glob: str | None = None
) -> Validation:
    """Return the predictions of runs by the kinematics that `identify --only calibration` wrote.

    Arguments and errors are those of `validate`.
    """
    setup_jax(quiet=True)
    found = read_calibration(out)
    if "contact" in found.models.values():
        raise DataError(
            f"{out / FIT}: missing, though {IDENTIFIED} beside it is of a fit; "
            "run `slipid identify` again"
        )
    config, dataset = _judged(out, data, report, glob)
    shape, fitted = shape_of(config), set(found.runs)
    new = sum(log.name not in fitted for log in dataset.logs)
    report.stage("predicting")
    models = [FloorModels(nominal(shape)), calibrated_model(found.calibration, shape)]
    return validation(None, models, dataset, new, found.seen(shape, dataset), found.models)


def _judged(out: Path, data: Path, report: Reporter, glob: str | None) -> tuple[Config, Runs]:
    """Return the config in a result folder, and the runs that it or a pattern names."""
    config = config_of_fit(out)
    logs, others = config.content.logs, config.content.validate_.logs
    sections = single_floor_sections([*others, *logs] if glob is not None else others or logs)
    report.stage("reading logs")
    dataset, skipped = read_dataset(config, sections, data, report, glob)
    dataset, short = without_short_runs(config, dataset)
    skipped += short
    refuse_misordered(dataset.logs)
    for sentence in by_reason(skipped):
        report.line(sentence)
    return config, dataset
