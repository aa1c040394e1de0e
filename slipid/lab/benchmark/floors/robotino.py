"""Floor classification on the Robotino runs of 2022, from wheel speeds and current magnitudes.

Runs are split by headings, as elsewhere in the benchmark, and start where the wheels have moved a
centimetre; none of them contains a stop or a second start. The row of slipid is the deployed
estimator with its default settings, from a fit to the training runs with their poses. It is given
the load set-up of a run, which a real robot knows as well. The other rows use neither poses nor
loads, and are fitted to runs with all loads together.
"""

import time
from collections.abc import Sequence
from functools import partial

import numpy as np

from slipid.lab.benchmark.floors.protocol import (
    EvaluationSettings,
    FloorTask,
    answers_after,
    attempted,
    evaluated,
    table_of,
)
from slipid.lab.benchmark.floors.result import Answer, ClassifierTable
from slipid.lab.benchmark.protocols import base_of, splits
from slipid.lab.benchmark.scores import FoldScore
from slipid.lab.benchmark.slipid_rows import NAME, FloorKnowledge, estimator_runs
from slipid.lab.benchmark.work import BenchmarkOptions, FoldData, FoldTask, data_of, fold_data
from slipid.lab.systems.floors.cosine_energy import CosineEnergyClassifier
from slipid.lab.systems.floors.interface import FloorClassifier, FloorSignals
from slipid.lab.systems.floors.learned import GaussianClassifier, tree_classifiers
from slipid.predict.slip_model import PredictedRun, Run

SOURCE, KIND = "robotino2022", "headings"
SECONDS = (0.5, 1.0, 2.0, 4.0)
"""Times after which answers are read [s]; steps last about 0.3 s, runs 6 s or more."""
ABOUT = "Robotino on four floors, straight runs: wheel speeds and magnitudes of currents"


def robotino_classifiers() -> list[FloorClassifier]:
    """Return the classifiers other than slipid that need no accelerometer."""
    trees = [row for row in tree_classifiers() if "vibration" not in row.channels]
    return [CosineEnergyClassifier(), GaussianClassifier(), *trees]


def robotino_table(options: BenchmarkOptions) -> ClassifierTable:
    """Return the table of all classifiers, or of those requested, on the Robotino's runs.

    If a checkpoint has a fit of slipid to the same runs, the fit is reused.
    """
    data = data_of(options, SOURCE)
    inner = 1 if options.quick else 2
    settings = EvaluationSettings(seconds=SECONDS, inner=inner, first_s=max(SECONDS))
    folds: dict[str, list[FoldScore[Answer]]] = {}
    every: list[FloorSignals] = []
    for split in splits(data.facts, KIND)[: 1 if options.quick else None]:
        fold = fold_data(FoldTask(options, SOURCE, KIND, split.fold))
        training, held_out = ([floor_signals(r) for r in rs] for rs in (fold.training, fold.runs))
        every += held_out
        work = {NAME: partial(_slipid, fold, held_out)}
        for method in robotino_classifiers():
            work[method.name] = partial(evaluated, method, training, held_out, data.spec, settings)
        for name, one in work.items():
            if not options.only or name in options.only:
                folds.setdefault(name, []).append(attempted(one))
    return table_of(folds, every, ABOUT, settings, NAME)


def floor_signals(run: Run) -> FloorSignals:
    """Return the signals of a run that floor classifiers use, without its pose.

    Raises:
        ValueError: the run has no currents.
    """
    signals = run.signals
    if signals.current is None:
        raise ValueError(
            f"{signals.name}: no currents; expected currents, which floor classifiers need"
        )
    return FloorSignals(
        name=signals.name,
        floor=base_of(run.floor),
        time=np.cumsum(signals.dt),
        speed=signals.speed,
        current=np.abs(signals.current),
        gyro=signals.gyro,
    )


def _slipid(fold: FoldData, runs: list[FloorSignals]) -> FoldScore[Answer]:
    """Return the result of slipid's estimator on the held-out runs of a fold."""
    fit = fold.fit
    if isinstance(fit, FoldScore):
        return FoldScore(absent=fit.absent, failed=True)
    began = time.perf_counter()
    predicted = estimator_runs(fit, fold.batches, fold.held_out, FloorKnowledge())
    took = time.perf_counter() - began
    answers: list[Answer] = []
    for run, one in zip(runs, predicted, strict=True):
        labels, beliefs = beliefs_of(one)
        answers += answers_after(run, beliefs, labels, SECONDS)
    step_us = 1e6 * took / sum(map(len, runs))
    return FoldScore(tuple(answers), numbers=fit.numbers, fit_s=fit.seconds, step_us=step_us)


def beliefs_of(predicted: PredictedRun) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the known floors and their probabilities, given that the true floor is one of them."""
    assert predicted.floors is not None
    labels = tuple(name for name in predicted.floors if name != "unknown")
    each = np.stack([predicted.floors[name] for name in labels], axis=1)
    return labels, each / each.sum(axis=1, keepdims=True)


class RobotinoFloorTask(FloorTask):
    """Task that makes the table of the Robotino on four floors."""

    name = "robotino_floors"
    folder = SOURCE

    @property
    def rows(self) -> Sequence[str]:
        return [NAME, *(method.name for method in robotino_classifiers())]

    def log_hash(self) -> str:
        return data_of(self.options, SOURCE).job.data_hash

    def make(self) -> ClassifierTable:
        return robotino_table(self.options)
