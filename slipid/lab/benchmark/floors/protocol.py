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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
from jaxtyping import Int

from slipid.lab.benchmark.floors.result import (
    Answer,
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
"""Times from the start of a stretch after which a quick evaluation reads answers [s]."""
CLASSIFIER_FOLDS, CLASSIFIER_INNER_FOLDS = 5, 2
"""Numbers of folds: of the evaluation, and of the inner cross-validation that selects settings."""


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of the evaluation of classifiers.

    Attributes:
        seconds: times from the start of a stretch after which answers are read [s].
        folds: number of folds to which runs are assigned.
        held_out: number of folds that are held out in turn; all, or fewer to save time.
        inner: number of folds of the inner cross-validation that selects settings; with one fold,
            the default settings are used.
        first_s: only this much of each held-out run is used, from its start [s].
    """

    seconds: tuple[float, ...] = SECONDS
    folds: int = CLASSIFIER_FOLDS
    held_out: int = CLASSIFIER_FOLDS
    inner: int = CLASSIFIER_INNER_FOLDS
    first_s: float = np.inf

    @classmethod
    def quick(cls) -> "EvaluationSettings":
        """Return settings without tuning, for the first minute of the runs of a single fold.

        Answers are evaluated only after short times.
        """
        return cls(seconds=QUICK_SECONDS, held_out=1, inner=1, first_s=60.0)


def folds_of(runs: Sequence[FloorSignals], count: int) -> Int[np.ndarray, " run"]:
    """Return the fold index of every run; the runs of each floor are assigned to folds in turn."""
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
    candidates is used.
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


def evaluated(
    method: FloorClassifier,
    training: Sequence[FloorSignals],
    held_out: Sequence[FloorSignals],
    spec: RobotSpec,
    settings: EvaluationSettings,
) -> FoldScore[Answer]:
    """Tune and fit a classifier on training runs, and return its answers on held-out runs."""
    began = time.perf_counter()
    found = tuned_classifier(method, training, spec, settings)
    tuned = time.perf_counter()
    fitted = found.method.fit(training, spec)
    ended = time.perf_counter()
    starts = [run.segments(settings.first_s)[0] for run in held_out]
    answers = answers_of(fitted, starts, spec, settings.seconds)
    return FoldScore(
        tuple(answers),
        settings=found.settings,
        numbers=fitted.numbers,
        fit_s=ended - tuned,
        tune_s=tuned - began,
        step_us=1e6 * (time.perf_counter() - ended) / max(sum(map(len, starts)), 1),
    )


def attempted(work: Callable[[], FoldScore[Answer]]) -> FoldScore[Answer]:
    """Return the result of `work()`; if it raises, an empty `FoldScore` with the reason."""
    try:
        return work()
    except Exception as error:  # the other classifiers are evaluated even if one fails
        return FoldScore.of_error(error)


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

    def in_fold(k: int, method: FloorClassifier) -> FoldScore[Answer]:
        training, held_out = _some(runs, fold != k), _some(runs, fold == k)
        return attempted(partial(evaluated, method, training, held_out, spec, settings))

    folds = {m.name: [in_fold(k, m) for k in range(settings.held_out)] for m in methods}
    return table_of(folds, runs, about, settings, reference)


def table_of(
    folds: Mapping[str, Sequence[FoldScore[Answer]]],
    runs: Sequence[FloorSignals],
    about: str,
    settings: EvaluationSettings,
    reference: str,
) -> ClassifierTable:
    """Return the table of all results, each compared with the row named `reference`.

    Raises:
        ValueError: every classifier failed; the message lists the reasons.
    """
    done = {name: FoldScore.of_folds(each) for name, each in folds.items()}
    first = next((one.runs for one in done.values() if one.runs), ())
    if not first:
        raise ValueError("; ".join(f"{name}: {one.absent}" for name, one in done.items()))
    rival = done[reference].runs if reference in done else ()
    rows = [
        {
            "name": name,
            "settings": [fold.settings for fold in folds[name]],
            "numbers": one.numbers,
            "after": after_seconds(one.runs, None if name == reference else rival or None),
            "said": confusion(one.runs, max(settings.seconds)) or None,
            "fit_s": one.fit_s,
            "tune_s": one.tune_s,
            "row_us": one.step_us,
            "absent": one.absent,
        }
        for name, one in done.items()
    ]
    floor = [a.floor for a in first if a.seconds == min(settings.seconds)]
    return {
        "about": about,
        "runs": len({run.name for run in runs}),
        "floors": sorted({run.floor for run in runs}),
        "chance": max(floor.count(name) for name in set(floor)) / len(floor),
        "rows": rows,
    }


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
                kept.save_json(self.name, self.make())
            except Exception as error:  # the other tasks run even if this one fails
                kept.save_json(self.name, {"failed": FoldScore.of_error(error).absent})
        return self.name

    def table(self) -> Content:
        """Return the saved table in the form of benchmark.json."""
        found: Content = self.checkpoint.load_json(self.name) or {
            "failed": "the result was not saved"
        }
        return found
