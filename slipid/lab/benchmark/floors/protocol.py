"""Who tells the floor of runs that nobody was fitted to, and after how many seconds.

Runs are dealt into folds, floor by floor, so that every run is left out once. A classifier picks
its settings by a cross-validation of the same kind among the runs that it is fitted to. Runs that
are left out are cut into stretches of the longest time one after another; in each of them the
classifier starts anew, and is asked after every one of the times. A stretch counts for a time if it
is that long and the robot moves in at least half of its rows up to it.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

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
from slipid.lab.benchmark.tuning import settings_of
from slipid.lab.systems.floors.interface import Beliefs, FloorClassifier, FloorSignals
from slipid.predict.slip_model import RobotSpec

SECONDS = (0.5, 1.0, 2.0, 4.0, 8.0)
"""After which classifiers are asked [s]."""
QUICK_SECONDS = (0.5, 1.0, 2.0)
FOLDS, INNER = 5, 2
Numbers = Int[np.ndarray, " run"]


@dataclass(frozen=True)
class EvaluationSettings:
    """How classifiers are judged.

    Attributes:
        seconds: after which they are asked [s].
        folds: into which runs are dealt; judged: how many of these are left out in turn.
        inner: folds by which settings are picked; one takes settings as they are.
        first_s: of runs that are left out, as much from the start is judged [s].
    """

    seconds: tuple[float, ...] = SECONDS
    folds: int = FOLDS
    judged: int = FOLDS
    inner: int = INNER
    first_s: float = np.inf

    @classmethod
    def quick(cls) -> "EvaluationSettings":
        """One fold, the first minute of its runs and short times, settings as they are."""
        return cls(seconds=QUICK_SECONDS, judged=1, inner=1, first_s=60.0)


def folds_of(felts: Sequence[FloorSignals], count: int) -> Numbers:
    """Fold of every run: on each floor the first is in the first, the second in the second, .."""
    seen: dict[str, int] = {}
    fold = []
    for felt in felts:
        number = seen.get(felt.floor, 0)
        fold.append(number % count)
        seen[felt.floor] = number + 1
    return np.array(fold)


def answers_of(
    method: FloorClassifier,
    felts: Sequence[FloorSignals],
    spec: RobotSpec,
    seconds: Sequence[float],
) -> list[Answer]:
    """What a fitted classifier says of the stretches of runs."""
    stretches = [part for felt in felts for part in felt.pieces(max(seconds))]
    said = method.probability(stretches, spec)
    return [
        answer
        for stretch, beliefs in zip(stretches, said, strict=True)
        for answer in answers_after(stretch, beliefs, method.labels, seconds)
    ]


def answers_after(
    stretch: FloorSignals, beliefs: Beliefs, labels: Sequence[str], seconds: Sequence[float]
) -> list[Answer]:
    """What beliefs say after each of the times that count, see the head of this file."""
    heard, step = np.cumsum(stretch.dt), float(np.median(stretch.dt))
    out = []
    for long in seconds:
        # the row that comes nearest to this time
        last = int(np.argmin(np.abs(heard - long)))
        if heard[-1] < long - 0.6 * step or stretch.moves[: last + 1].mean() < 0.5:
            continue
        row = beliefs[last]
        right = row[labels.index(stretch.floor)] if stretch.floor in labels else 0.0
        most = labels[int(np.argmax(row))]
        out.append(Answer(stretch.name, stretch.floor, long, most, float(right)))
    return out


@dataclass(frozen=True)
class TunedClassifier:
    """A method with settings, in words, that did best; how long that took [s]."""

    method: FloorClassifier
    settings: str
    seconds: float


def tuned(
    method: FloorClassifier,
    felts: Sequence[FloorSignals],
    spec: RobotSpec,
    asked: EvaluationSettings,
) -> TunedClassifier:
    """The candidate that names the right floor most often in an inner cross-validation.

    By the mean over all times that are asked; the first of those that are as good.
    """
    began, candidates = time.perf_counter(), list(method.candidates())
    if len(candidates) == 1 or asked.inner < 2:
        return TunedClassifier(method, "", 0.0)
    fold = folds_of(felts, asked.inner)
    right = []
    for candidate in candidates:
        said: list[Answer] = []
        for k in range(asked.inner):
            done = candidate.fit(_some(felts, fold != k), spec)
            said += answers_of(done, _some(felts, fold == k), spec, asked.seconds)
        each = [
            np.mean([a.said == a.floor for a in said if a.seconds == long])
            for long in sorted({a.seconds for a in said})
        ]
        right.append(float(np.mean(each)))
    best = candidates[int(np.argmax(right))]
    words = settings_of(best, candidates)
    return TunedClassifier(best, words, time.perf_counter() - began)


def _some(felts: Sequence[FloorSignals], take: np.ndarray) -> list[FloorSignals]:
    return [felt for felt, t in zip(felts, take, strict=True) if t]


@dataclass(frozen=True)
class ScoredClassifier:
    """A classifier in all folds: its row but for what is compared, and its answers."""

    row: ClassifierRow
    answers: tuple[Answer, ...]


def judged(
    method: FloorClassifier,
    felts: Sequence[FloorSignals],
    spec: RobotSpec,
    asked: EvaluationSettings,
) -> ScoredClassifier:
    """A classifier fitted and asked, fold by fold."""
    fold = folds_of(felts, asked.folds)
    answers: list[Answer] = []
    settings, numbers, fit_s, tune_s, heard_s, rows = [], [], [], [], 0.0, 0
    for k in range(asked.judged):
        fitted = _some(felts, fold != k)
        left_out = [felt.pieces(asked.first_s)[0] for felt in _some(felts, fold == k)]
        found = tuned(method, fitted, spec, asked)
        began = time.perf_counter()
        done = found.method.fit(fitted, spec)
        ended = time.perf_counter()
        answers += answers_of(done, left_out, spec, asked.seconds)
        heard_s += time.perf_counter() - ended
        rows += sum(len(felt) for felt in left_out)
        settings.append(found.settings)
        numbers.append(done.numbers)
        fit_s.append(ended - began)
        tune_s.append(found.seconds)
    row = ClassifierRow(
        name=method.name,
        settings=tuple(settings),
        numbers=int(np.median(numbers)),
        fit_s=float(np.median(fit_s)),
        tune_s=float(np.median(tune_s)),
        row_us=1e6 * heard_s / max(rows, 1),
    )
    return ScoredClassifier(row, tuple(answers))


def attempted(name: str, work: Callable[[], ScoredClassifier]) -> ScoredClassifier:
    """What a classifier came to; if it fails, an empty row that says why."""
    try:
        return work()
    except Exception as error:  # other rows are judged all the same
        return ScoredClassifier(ClassifierRow(name, absent=FoldScore.of_error(error).absent), ())


def classifier_table(
    methods: Sequence[FloorClassifier],
    felts: Sequence[FloorSignals],
    spec: RobotSpec,
    about: str,
    asked: EvaluationSettings = EvaluationSettings(),
    reference: str = "slipid",
) -> ClassifierTable:
    """All classifiers on the same runs; `reference` is the one that others are compared with."""
    done = {
        method.name: attempted(method.name, partial(judged, method, felts, spec, asked))
        for method in methods
    }
    return table_of(done, felts, about, asked, reference)


def table_of(
    done: dict[str, ScoredClassifier],
    felts: Sequence[FloorSignals],
    about: str,
    asked: EvaluationSettings,
    reference: str,
) -> ClassifierTable:
    """Rows put together."""
    rival = (done[reference].answers or None) if reference in done else None
    longest, rows = max(asked.seconds), []
    for name, one in done.items():
        if one.row.absent:
            rows.append(one.row)
            continue
        other = None if name == reference else rival
        after = after_seconds(one.answers, other)
        rows.append(replace(one.row, after=after, said=confusion(one.answers, longest)))
    first = next((one.answers for one in done.values() if one.answers), ())
    if not first:
        raise ValueError("; ".join(f"{name}: {one.row.absent}" for name, one in done.items()))
    floor = [a.floor for a in first if a.seconds == min(asked.seconds)]
    chance = max(floor.count(name) for name in set(floor)) / len(floor)
    names = tuple(sorted({felt.floor for felt in felts}))
    return ClassifierTable(about, len({felt.name for felt in felts}), names, chance, tuple(rows))
