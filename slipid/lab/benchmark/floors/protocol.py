"""Evaluation of floor classifiers on held-out runs, after different lengths of signals.

The runs of each floor are distributed over folds, so that every run is held out once. The settings
of a classifier are selected by a cross-validation of the same kind among its training runs. Answers
are evaluated after several times, such as 0.5 s and 8 s (`SECONDS`). Held-out runs are divided into
consecutive stretches whose length is the longest of these times. The classifier is restarted in
each stretch, and its answer is evaluated after each of the times. A stretch is used for a time if
it is at least that long and the robot moves in at least half of its rows up to that time.
"""

import abc
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
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
from slipid.lab.benchmark.work import FIT_SOURCES, ROW_SOURCES, BenchmarkOptions
from slipid.lab.systems.floors.interface import Beliefs, FloorClassifier, FloorSignals
from slipid.predict.slip_model import RobotSpec
from slipid.support.checkpoint import Checkpoint, key_of, source_hash
from slipid.support.content import Content
from slipid.support.jax_setup import setup_jax

SECONDS = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Times from the start of a stretch after which answers are evaluated [s]."""
QUICK_SECONDS = (0.5, 1.0, 2.0)
"""These times in a quick evaluation [s]."""
FOLDS, INNER = 5, 2
"""Numbers of folds: of the evaluation, and of the inner cross-validation that selects settings."""


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of the evaluation of classifiers.

    Attributes:
        seconds: times from the start of a stretch after which answers are read [s].
        folds: number of folds into which runs are dealt.
        held_out: number of folds that are held out in turn; all, or fewer to save time.
        inner: number of folds of the inner cross-validation that picks settings; with one fold,
            the default settings are used.
        first_s: only this much of each held-out run is used, from its start [s].
    """

    seconds: tuple[float, ...] = SECONDS
    folds: int = FOLDS
    held_out: int = FOLDS
    inner: int = INNER
    first_s: float = np.inf

    @classmethod
    def quick(cls) -> "EvaluationSettings":
        """Return settings for one fold, the first minute of its runs, short times, no tuning."""
        return cls(seconds=QUICK_SECONDS, held_out=1, inner=1, first_s=60.0)


def folds_of(runs: Sequence[FloorSignals], count: int) -> Int[np.ndarray, " run"]:
    """Return the fold index of every run; the runs of each floor are dealt to folds in turn."""
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
    """Return the answers of a fitted classifier in all stretches of the runs."""
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
    """Return the answers in one stretch after each of the times for which the stretch is used.

    The module's docstring defines the times for which a stretch is used.

    Args:
        stretch: signals of the stretch.
        beliefs: floor probabilities after each of its rows.
        labels: floor of each column of `beliefs`.
        seconds: times after which answers are read [s].
    """
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

    The accuracy is averaged over all times (`settings.seconds`); the first of equally good
    candidates is taken.
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
    """Result of a classifier in one or several folds.

    Attributes:
        row: row of the table, with costs and settings but without accuracies.
        answers: answers to all stretches of the held-out runs.
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
    """Return a classifier's result in one fold: tuned, fitted and applied to the held-out runs."""
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
    """Return the results of all folds of a classifier as one result.

    If the classifier failed in a fold, the result is that of the failed fold, without accuracies.
    """
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
    """Return the result of `work()`; if it raises, an empty row with the reason."""
    try:
        return work()
    except Exception as error:  # A row that fails does not stop the evaluation of the others.
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

    Every other row is compared with the row named `reference`.
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
    """Return the table of all results, each compared with the row named `reference`.

    Raises:
        ValueError: every classifier failed; the message lists the reasons.
    """
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
    """Task of the benchmark that makes one table of classifiers and saves it in a checkpoint.

    Attributes:
        options: options of the benchmark.
        name: name of the task, and of its table in benchmark.json.
        folder: name of the folder of its logs, below the data folder.
    """

    options: BenchmarkOptions
    name: ClassVar[str]
    folder: ClassVar[str]

    @property
    @abc.abstractmethod
    def rows(self) -> Sequence[str]:
        """Names of the classifiers in the table."""

    @abc.abstractmethod
    def log_hash(self) -> str:
        """Return a hash of the logs from which the table is made."""

    @abc.abstractmethod
    def make(self) -> ClassifierTable:
        """Return the table of the requested classifiers."""

    @property
    def is_requested(self) -> bool:
        """True if the task's logs are available and at least one of its rows is requested."""
        requested = not self.options.only or bool(set(self.options.only) & set(self.rows))
        return requested and (self.options.data / self.folder).is_dir()

    @property
    def checkpoint(self) -> Checkpoint:
        """Checkpoint in which the table is saved; its key depends on logs, options and code."""
        code = source_hash(*FIT_SOURCES, *ROW_SOURCES)
        key = key_of(self.log_hash(), self.options.quick, self.options.only, code)
        return Checkpoint(self.options.out / "kept" / self.name / key[:12], key)

    def run(self) -> str:
        """Make and save the table unless a saved one has no failed rows; return the task's name."""
        setup_jax(quiet=True)
        kept = self.checkpoint
        found = kept.load_json(self.name)
        if found is None or "failed" in found or any(row["absent"] for row in found["rows"]):
            try:
                kept.save_json(self.name, asdict(self.make()))
            except Exception as error:  # A task that fails does not stop the others.
                kept.save_json(self.name, {"failed": FoldScore.of_error(error).absent})
        return self.name

    def table(self) -> Content:
        """Return the saved table in the form of benchmark.json."""
        found: Content = self.checkpoint.load_json(self.name) or {
            "failed": "the result was not saved"
        }
        return found
