"""Tasks of the benchmark: each fits and scores slipid and every row in one fold of a data set."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from slipid.data.runs import Runs
from slipid.fitting.problem import Problem
from slipid.lab.benchmark import slipid_rows
from slipid.lab.benchmark.protocols import PROTOCOLS, BenchmarkProtocol, Split, base_of, splits
from slipid.lab.benchmark.rows import rows
from slipid.lab.benchmark.scores import FoldScore, RunScore, scored
from slipid.lab.benchmark.sets import SOURCES, DataSet, LogSource, read_set
from slipid.lab.benchmark.steps import RunBatch, in_order, run_batches
from slipid.lab.benchmark.tuning import tuned
from slipid.lab.systems.motion.features import common
from slipid.predict.slip_model import PredictedRun, Run, SlipModel
from slipid.search_space import Space
from slipid.support.checkpoint import Checkpoint, key_of, source_hash
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

MAP_ROW = "slipid_map"
"""Name of the row of slipid's estimator that is given the map of the floors."""


FIT_SOURCES = (
    *("parameter", "search_space", "model", "data", "fitting", "predict", "infer", "app"),
    "lab/benchmark/slipid_rows",
)
"""Packages and modules on which slipid's fits depend; saved fits are invalid if one of them
changes."""
ROW_SOURCES = ("lab/systems", "lab/paper2021", "lab/benchmark", "robot", "deploy")
"""Packages that the scores of all rows depend on in addition to `FIT_SOURCES`."""
QUICK_RUNS = 60
"""Largest number of runs of each data set in a quick benchmark."""
QUICK_KIND = "headings"
"""The only kind of split in a quick benchmark."""


@dataclass(frozen=True)
class BenchmarkOptions:
    """Options of a benchmark.

    Attributes:
        data: folder of the data sets.
        out: folder to write to.
        only: names of the requested rows; all if empty.
        quick: True for a short benchmark: some of the runs, one fold by headings, known floors.
    """

    data: Path
    out: Path
    only: tuple[str, ...] = ()
    quick: bool = False


@dataclass(frozen=True)
class FoldTask:
    """Task that fits and scores all rows in one fold of one data set.

    Attributes:
        options: options of the benchmark.
        source: name of the data set.
        kind: kind of split.
        fold: index of the fold.
    """

    options: BenchmarkOptions
    source: str
    kind: str
    fold: int

    @property
    def name(self) -> str:
        return f"{self.source}/{self.kind}_{self.fold}"

    def run(self) -> str:
        """Fit and score all rows that are missing in the checkpoint, and return the task's name."""
        setup_jax(quiet=True)
        kept = checkpoint_of(self, fit=False)
        found = {key: kept.load_json("_".join(key)) for key in keys_of(self)}
        # failed rows are tried again
        missing = [key for key, one in found.items() if one is None or one["failed"]]
        if missing:
            try:
                data: FoldData | FoldScore[RunScore] = fold_data(self)
            except Exception as error:  # all rows report the error, and other tasks still run
                data = FoldScore.of_error(error)
            for protocol, name in missing:
                score = data if isinstance(data, FoldScore) else _score(data, protocol, name)
                kept.save_json("_".join((protocol, name)), asdict(score))
        return self.name

    def rows(self) -> dict[tuple[str, str], FoldScore[RunScore]]:
        """Return the scores in the checkpoint, keyed by protocol and row."""
        kept = checkpoint_of(self, fit=False)
        found = {key: kept.load_json("_".join(key)) for key in keys_of(self)}
        return {key: FoldScore.of_json(one) for key, one in found.items() if one is not None}


def source_of(name: str) -> LogSource:
    """Return the log source with this name."""
    return next(source for source in SOURCES if source.name == name)


@lru_cache(maxsize=8)
def data_of(options: BenchmarkOptions, source: str) -> DataSet:
    """Return the data set of a source; each process reads it once."""
    found = read_set(source_of(source), options.data, options.out, Reporter(quiet=True))
    return found.thinned(QUICK_RUNS) if options.quick else found


@lru_cache(maxsize=8)
def problem_of(options: BenchmarkOptions, source: str) -> Problem:
    """Return slipid's fitting problem of all runs of a source; each process makes it once."""
    return data_of(options, source).job.problem()


def split_of(task: FoldTask) -> Split:
    """Return the split of runs of a task's fold."""
    found = splits(data_of(task.options, task.source).facts, task.kind)
    return next(split for split in found if split.fold == task.fold)


def checkpoint_of(task: FoldTask, fit: bool) -> Checkpoint:
    """Return a task's checkpoint of slipid's fit if `fit` is True, else that of its scores."""
    data = data_of(task.options, task.source)
    more = () if fit else (data.crossing_hash, source_hash(*ROW_SOURCES))
    split = split_of(task)
    marks = data.job.config.hash, data.job.data_hash, source_hash(*FIT_SOURCES)
    key = key_of(*marks, split.training, split.held_out, *more)
    # the folder name contains the key, so that results of other options are not overwritten
    return Checkpoint(task.options.out / "kept" / task.name / key[:12], key)


def keys_of(task: FoldTask) -> list[tuple[str, str]]:
    """Return the protocols and rows of a task, slipid's own rows first.

    Protocols with unknown floors need more than one floor.
    """
    options, data = task.options, data_of(task.options, task.source)
    own = [slipid_rows.NAME] + ([MAP_ROW] if task.kind == "all" else [])
    every = own + [method.name for method in rows(data.spec)]
    names = [name for name in every if not options.only or name in options.only]
    several = len({base_of(f.floor) for f in data.facts}) > 1 and not options.quick
    found = [k for k, p in PROTOCOLS.items() if p.split == task.kind and (p.floor_known or several)]
    return [(protocol, name) for protocol in found for name in names]


@dataclass(frozen=True, eq=False)
class FoldData:
    """Runs and slipid's fit for all rows of one fold.

    Attributes:
        data: the data set.
        fit: slipid's fit, or an empty score with the reason why there is none.
        training: training runs, whose signals name the floor.
        batches: held-out runs, in batches with equal numbers of steps.
        held_out: logs of the held-out runs.
    """

    data: DataSet
    fit: slipid_rows.SlipidFit | FoldScore[RunScore]
    training: tuple[Run, ...]
    batches: tuple[RunBatch, ...]
    held_out: Runs

    @property
    def runs(self) -> list[Run]:
        """Held-out runs of all batches."""
        return [run for batch in self.batches for run in batch.runs]


def fold_data(task: FoldTask) -> FoldData:
    """Return the runs and slipid's fit of a fold.

    Poses are corrected by the camera model that slipid fitted to the training runs, or by that of
    the config if slipid cannot be fitted.
    """
    data, split = data_of(task.options, task.source), split_of(task)
    fit: slipid_rows.SlipidFit | FoldScore[RunScore]
    try:
        kept = checkpoint_of(task, fit=True)
        problem = problem_of(task.options, task.source)
        fit = slipid_rows.fit_slipid(data.job, problem, split.training, kept)
        robot = fit.contact.robot
    except Exception as error:  # Without slipid's fit, the other rows can still be scored.
        fit = FoldScore.of_error(error)
        robot = Space(data.job.robot, data.job.choices).template

    def batches(numbers: np.ndarray) -> list[RunBatch]:
        found = run_batches(data.logged.subset(numbers), robot, data.source.poses_per_step)
        return [_with_facts(batch, data, numbers) for batch in found]

    training = tuple(run.with_floor(True) for run in in_order(batches(split.training)))
    if task.kind != "all":
        held_out = data.logged.subset(split.held_out)
        return FoldData(data, fit, training, tuple(batches(split.held_out)), held_out)
    assert data.crossing is not None
    crossing = run_batches(data.crossing, robot, data.source.poses_per_step)
    return FoldData(data, fit, training, tuple(crossing), data.crossing)


def _with_facts(batch: RunBatch, data: DataSet, numbers: np.ndarray) -> RunBatch:
    """Return the batch with floors, headings and speeds of its runs as used by the splits.

    Floors include the load set-up; heading and speed follow from the commanded motion.
    """
    facts = [data.facts[numbers[k]] for k in batch.numbers]
    runs = [
        replace(run, floor=f.floor, heading=float(np.radians(f.heading_deg)), speed=f.speed)
        for run, f in zip(batch.runs, facts, strict=True)
    ]
    return replace(batch, runs=tuple(runs))


def _score(data: FoldData, protocol: str, name: str) -> FoldScore[RunScore]:
    """Return the score of a row in a protocol; an empty score gives the reason for its absence."""
    rules = PROTOCOLS[protocol]
    runs = [run.with_floor(rules.floor_known) for run in data.runs]
    try:
        if name in (slipid_rows.NAME, MAP_ROW):
            return _slipid(data, rules, runs, name)
        method = next(m for m in rows(data.data.spec) if m.name == name)
        has = common(runs) | ({"twist"} if data.data.spec.determines_twist else set())
        if lacks := method.needs - has:
            return FoldScore.lacking(lacks)
        return _published(data, rules, runs, method)
    except Exception as error:  # the other rows are scored even if this one fails
        return FoldScore.of_error(error)


def _published(
    data: FoldData, protocol: BenchmarkProtocol, runs: list[Run], method: SlipModel
) -> FoldScore[RunScore]:
    """Tune and fit a published method, and return its score on the held-out runs."""
    spec = data.data.spec
    training = [run.with_floor(protocol.floor_known) for run in data.training]
    began = time.perf_counter()
    found = tuned(method, training, spec, protocol.split)
    picked = time.perf_counter()
    fitted = found.method.fit(training, spec)
    ended = time.perf_counter()
    score = _timed(data, runs, lambda: fitted.predict([run.signals for run in runs], spec))
    return replace(
        score,
        settings=found.settings,
        numbers=fitted.numbers,
        tune_s=picked - began,
        fit_s=ended - picked,
    )


def _slipid(
    data: FoldData, protocol: BenchmarkProtocol, runs: list[Run], name: str
) -> FoldScore[RunScore]:
    """Return the score of slipid in a protocol.

    Runs are predicted by its estimator if floors are unknown or the runs have a gyro, and
    otherwise by its fitted force balance.
    """
    fit, known = data.fit, protocol.floor_known
    if isinstance(fit, FoldScore):
        return fit
    if name == MAP_ROW and data.data.map is None:
        return FoldScore.lacking(["map"])
    floor_map = data.data.map if name == MAP_ROW else None
    floors = slipid_rows.FloorKnowledge(known, protocol.unseen_floors, floor_map)
    has_gyro = all(run.signals.gyro is not None for run in runs)

    def predict() -> list[PredictedRun]:
        if not known or has_gyro:
            return slipid_rows.estimator_runs(fit, data.batches, data.held_out, floors)
        forecasts = [slipid_rows.forecast(fit, b, data.data.spec) for b in data.batches]
        return [run for of_batch in forecasts for run in of_batch]

    predict()  # compiles the functions, so that the timed call measures execution only
    score = _timed(data, runs, predict)
    return replace(score, numbers=fit.numbers, fit_s=fit.seconds, converged=fit.converged)


def _timed(
    data: FoldData, runs: Sequence[Run], predict: Callable[[], list[PredictedRun]]
) -> FoldScore[RunScore]:
    """Return the scores of the predictions, with the time that one step of one run took."""
    began = time.perf_counter()
    predicted = predict()
    took = time.perf_counter() - began
    spec, over = data.data.spec, data.data.source.over
    scores = [scored(run, one, spec, over) for run, one in zip(runs, predicted, strict=True)]
    steps = sum(len(run.signals) for run in runs)
    return FoldScore(runs=tuple(scores), step_us=1e6 * took / max(steps, 1))
