"""Evaluation of floor classifiers on held-out runs, by the seconds of signals.

Runs are dealt into folds, floor by floor, so that every run is held out once. A classifier picks
its settings by a cross-validation of the same kind among its training runs. Held-out runs are cut
into consecutive stretches of the longest time; in each of them the classifier starts anew, and its
answer is read after every one of the times. A stretch counts for a time if it is that long and the
robot moves in at least half of its rows up to it.
"""

import abc
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np
from jaxtyping import Int

from slipid.lab.benchmark.floors.result import (
    Answer,
    ClassifierRow,
    ClassifierTable,
    after_seconds,
    confusion,
)
from slipid.lab.benchmark.scores import FoldScore
from slipid.lab.benchmark.tuning import Tuned, best_candidate
from slipid.lab.benchmark.work import OF_FITS, OF_ROWS, BenchmarkOptions
from slipid.lab.systems.floors.interface import Beliefs, FloorClassifier, FloorSignals
from slipid.predict.slip_model import RobotSpec
from slipid.support.checkpoint import Checkpoint, key_of, source_hash
from slipid.support.content import Content
from slipid.support.jax_setup import setup_jax

SECONDS = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Times after which answers are read [s]."""
QUICK_SECONDS = (0.5, 1.0, 2.0)
FOLDS, INNER = 5, 2


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of the evaluation of classifiers.

    Attributes:
        seconds: times after which answers are read [s].
        folds: number of folds into which runs are dealt.
        held_out: number of folds that are held out in turn.
        inner: number of folds that pick settings; with one, the default settings are used.
        first_s: length from the start of held-out runs that is used [s].
    """

    seconds: tuple[float, ...] = SECONDS
    folds: int = FOLDS
    held_out: int = FOLDS
    inner: int = INNER
    first_s: float = np.inf

    @classmethod
    def quick(cls) -> "EvaluationSettings":
        """Return one fold, the first minute of its runs, short times and default settings."""
        return cls(seconds=QUICK_SECONDS, held_out=1, inner=1, first_s=60.0)


def folds_of(runs: Sequence[FloorSignals], count: int) -> Int[np.ndarray, " run"]:
    """Return the fold of every run; the runs of each floor are dealt to the folds in turn."""
    dealt: dict[str, int] = {}
    fold = []
    for run in runs:
        number = dealt.get(run.floor, 0)
        fold.append(number % count)
        dealt[run.floor] = number + 1
    return np.array(fold)


def answers_of(
    method: FloorClassifier, runs: Sequence[FloorSignals], spec: RobotSpec, seconds: Sequence[float]
) -> list[Answer]:
    """Return the answers of a fitted classifier to all stretches of runs."""
    stretches = [part for run in runs for part in run.segments(max(seconds))]
    beliefs = method.probability(stretches, spec)
    return [
        answer
        for stretch, belief in zip(stretches, beliefs, strict=True)
        for answer in answers_after(stretch, belief, method.labels, seconds)
    ]


def answers_after(
    stretch: FloorSignals, beliefs: Beliefs, labels: Sequence[str], seconds: Sequence[float]
) -> list[Answer]:
    """Return the answers after each of the times that count, see the top of this file."""
    elapsed, step = np.cumsum(stretch.dt), float(np.median(stretch.dt))
    out = []
    for after in seconds:
        last = int(np.argmin(np.abs(elapsed - after)))
        if elapsed[-1] < after - 0.6 * step or stretch.moving[: last + 1].mean() < 0.5:
            continue
        row = beliefs[last]
        right = row[labels.index(stretch.floor)] if stretch.floor in labels else 0.0
        named = labels[int(np.argmax(row))]
        out.append(Answer(stretch.name, stretch.floor, after, named, float(right)))
    return out


def tuned_classifier(
    method: FloorClassifier,
    runs: Sequence[FloorSignals],
    spec: RobotSpec,
    settings: EvaluationSettings,
) -> Tuned[FloorClassifier]:
    """Return the candidate with the highest accuracy in an inner cross-validation.

    The accuracy is the mean over all times; the first of equally good candidates is taken.
    """
    fold = folds_of(runs, settings.inner)

    def loss(candidate: FloorClassifier) -> float:
        answers: list[Answer] = []
        for k in range(settings.inner):
            fitted = candidate.fit(_some(runs, fold != k), spec)
            answers += answers_of(fitted, _some(runs, fold == k), spec, settings.seconds)
        each = [
            np.mean([a.named == a.floor for a in answers if a.seconds == after])
            for after in sorted({a.seconds for a in answers})
        ]
        return -float(np.mean(each))

    return best_candidate(method.candidates() if settings.inner > 1 else [method], loss)


def _some(runs: Sequence[FloorSignals], take: np.ndarray) -> list[FloorSignals]:
    return [run for run, t in zip(runs, take, strict=True) if t]


@dataclass(frozen=True)
class ScoredClassifier:
    """A classifier in one or several folds.

    Attributes:
        row: its row of the table, without comparisons.
        answers: its answers.
    """

    row: ClassifierRow
    answers: tuple[Answer, ...]


def evaluated(
    method: FloorClassifier,
    training: Sequence[FloorSignals],
    held_out: Sequence[FloorSignals],
    spec: RobotSpec,
    settings: EvaluationSettings,
) -> ScoredClassifier:
    """Return the result of one fold: settings picked, fitted, and answers on held-out runs."""
    began = time.perf_counter()
    found = tuned_classifier(method, training, spec, settings)
    tuned = time.perf_counter()
    fitted = found.method.fit(training, spec)
    ended = time.perf_counter()
    starts = [run.segments(settings.first_s)[0] for run in held_out]
    answers = answers_of(fitted, starts, spec, settings.seconds)
    row = ClassifierRow(
        method.name,
        settings=(found.settings,),
        numbers=fitted.numbers,
        fit_s=ended - tuned,
        tune_s=tuned - began,
        row_us=1e6 * (time.perf_counter() - ended) / max(sum(map(len, starts)), 1),
    )
    return ScoredClassifier(row, tuple(answers))


def joined(folds: Sequence[ScoredClassifier]) -> ScoredClassifier:
    """Return all folds of a classifier as one; its row is empty if it failed in one of them."""
    if failed := [fold for fold in folds if fold.row.absent]:
        return failed[0]

    def median(name: str) -> float:
        return float(np.median([getattr(fold.row, name) for fold in folds]))

    row = replace(
        folds[0].row,
        settings=tuple(word for fold in folds for word in fold.row.settings),
        numbers=int(median("numbers")),
        fit_s=median("fit_s"),
        tune_s=median("tune_s"),
        row_us=median("row_us"),
    )
    return ScoredClassifier(row, tuple(answer for fold in folds for answer in fold.answers))


def attempted(name: str, work: Callable[[], ScoredClassifier]) -> ScoredClassifier:
    """Return the result of some work; if it raises, an empty row with the reason."""
    try:
        return work()
    except Exception as error:  # other rows are evaluated all the same
        return ScoredClassifier(ClassifierRow(name, absent=FoldScore.of_error(error).absent), ())


def classifier_table(
    methods: Sequence[FloorClassifier],
    runs: Sequence[FloorSignals],
    spec: RobotSpec,
    about: str,
    settings: EvaluationSettings = EvaluationSettings(),
    reference: str = "slipid",
) -> ClassifierTable:
    """Return the cross-validated table of all classifiers on the same runs.

    The others are compared with the row named `reference`.
    """
    fold = folds_of(runs, settings.folds)

    def cross_validated(method: FloorClassifier) -> ScoredClassifier:
        return joined(
            [
                evaluated(method, _some(runs, fold != k), _some(runs, fold == k), spec, settings)
                for k in range(settings.held_out)
            ]
        )

    done = {m.name: attempted(m.name, partial(cross_validated, m)) for m in methods}
    return table_of(done, runs, about, settings, reference)


def table_of(
    done: dict[str, ScoredClassifier],
    runs: Sequence[FloorSignals],
    about: str,
    settings: EvaluationSettings,
    reference: str,
) -> ClassifierTable:
    """Return the table of all results, compared with the reference."""
    rival = (done[reference].answers or None) if reference in done else None
    rows = []
    for name, one in done.items():
        if one.row.absent:
            rows.append(one.row)
            continue
        after = after_seconds(one.answers, None if name == reference else rival)
        table = confusion(one.answers, max(settings.seconds))
        rows.append(replace(one.row, after=after, said=table))
    first = next((one.answers for one in done.values() if one.answers), ())
    if not first:
        raise ValueError("; ".join(f"{name}: {one.row.absent}" for name, one in done.items()))
    floor = [a.floor for a in first if a.seconds == min(settings.seconds)]
    chance = max(floor.count(name) for name in set(floor)) / len(floor)
    names = tuple(sorted({run.floor for run in runs}))
    return ClassifierTable(about, len({run.name for run in runs}), names, chance, tuple(rows))


@dataclass(frozen=True)
class FloorTask(abc.ABC):
    """Task of the benchmark that makes one table of classifiers and keeps it.

    Attributes:
        options: options of the benchmark.
        name: name of the task, and of its table in benchmark.json.
        folder: folder of its logs, below the data folder.
    """

    options: BenchmarkOptions
    name: ClassVar[str]
    folder: ClassVar[str]

    @property
    @abc.abstractmethod
    def rows(self) -> Sequence[str]:
        """Names of its classifiers."""

    @abc.abstractmethod
    def log_hash(self) -> str:
        """Return the hash of its logs."""

    @abc.abstractmethod
    def make(self) -> ClassifierTable:
        """Return the table of the requested classifiers."""

    @property
    def is_requested(self) -> bool:
        """True if its logs are available and any of its rows is requested."""
        requested = not self.options.only or bool(set(self.options.only) & set(self.rows))
        return requested and (self.options.data / self.folder).is_dir()

    @property
    def checkpoint(self) -> Checkpoint:
        """Checkpoint that keeps its table."""
        code = source_hash(*OF_FITS, *OF_ROWS)
        key = key_of(self.log_hash(), self.options.quick, self.options.only, code)
        return Checkpoint(self.options.out / "kept" / self.name / key[:12], key)

    def run(self) -> str:
        """Make the table, unless it is kept without failures, and return the task's name."""
        setup_jax(quiet=True)
        kept = self.checkpoint
        found = kept.load_json(self.name)
        if found is None or "failed" in found or any(row["absent"] for row in found["rows"]):
            try:
                kept.save_json(self.name, self.make().to_json())
            except Exception as error:  # other tasks are done all the same
                kept.save_json(self.name, {"failed": FoldScore.of_error(error).absent})
        return self.name

    def table(self) -> Content:
        """Return the kept table as in benchmark.json."""
        found: Content = self.checkpoint.load_json(self.name) or {"failed": "it was not kept"}
        return found
