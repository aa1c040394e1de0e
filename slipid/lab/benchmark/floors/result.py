"""How often each classifier names the right floor, by the time that it has heard a run."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from slipid.lab.benchmark.summary import Bootstrap, MeanInterval, mean_interval


@dataclass(frozen=True)
class Answer:
    """What a classifier said at the end of a stretch.

    Attributes:
        run: that the stretch is of; floor: it was driven on.
        seconds: that were heard.
        said: the floor that was most probable.
        probability: that the right one was given.
    """

    run: str
    floor: str
    seconds: float
    said: str
    probability: float


@dataclass(frozen=True)
class AfterSeconds:
    """A classifier after hearing stretches for so long.

    Attributes:
        seconds: heard; stretches: how many.
        accuracy: part of the stretches in which the most probable floor is the right one.
        balanced: the same, the mean over floors of the part on each.
        behind: accuracy less that of slipid, the same runs resampled; None of slipid itself.
        by_floor: part on each floor.
        log_score: mean log probability of the right floor; 0 is best, log of one over the number of
            floors is what knowing nothing gives.
    """

    seconds: float
    stretches: int
    accuracy: MeanInterval
    balanced: MeanInterval
    behind: MeanInterval | None
    by_floor: Mapping[str, float]
    log_score: float


@dataclass(frozen=True)
class ClassifierRow:
    """A classifier.

    Attributes:
        name: of the row.
        settings: that cross-validation picked in each fold, in words.
        numbers: how many were fitted, median over folds.
        after: by the time heard.
        said: how often a floor was named on each, in percent, after the longest time.
        fit_s, tune_s: to fit once and to pick settings [s], median over folds; row_us: to hear a
            row, microseconds.
        absent: why the row is empty.
    """

    name: str
    settings: tuple[str, ...] = ()
    numbers: int = 0
    after: tuple[AfterSeconds, ...] = ()
    said: Mapping[str, Mapping[str, float]] | None = None
    fit_s: float = 0.0
    tune_s: float = 0.0
    row_us: float = 0.0
    absent: str = ""


@dataclass(frozen=True)
class ClassifierTable:
    """All classifiers on one set of runs.

    Attributes:
        about: the runs, for people.
        runs, floors: how many, and which.
        chance: accuracy of always naming the floor that most stretches are on.
        rows: slipid's first.
    """

    about: str
    runs: int
    floors: tuple[str, ...]
    chance: float
    rows: tuple[ClassifierRow, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def after_seconds(
    answers: Sequence[Answer], rival: Sequence[Answer] | None
) -> tuple[AfterSeconds, ...]:
    """A classifier by the time heard; `rival` said the same stretches in the same order."""
    out = []
    for seconds in sorted({a.seconds for a in answers}):
        take = [k for k, a in enumerate(answers) if a.seconds == seconds]
        mine = [answers[k] for k in take]
        other = None if rival is None else [rival[k] for k in take]
        out.append(_after(seconds, mine, other))
    return tuple(out)


def _after(
    seconds: float, answers: Sequence[Answer], rival: Sequence[Answer] | None
) -> AfterSeconds:
    right = np.array([a.said == a.floor for a in answers], dtype=float)
    # whole runs are drawn anew, floor by floor
    run = np.unique([a.run for a in answers], return_inverse=True)[1]
    by = Bootstrap.by([a.floor for a in answers], run)
    behind = None
    if rival is not None:
        assert [(a.run, a.floor) for a in rival] == [(a.run, a.floor) for a in answers]
        theirs = np.array([a.said == a.floor for a in rival], dtype=float)
        behind = mean_interval(by.over_all(right - theirs))
    return AfterSeconds(
        seconds=seconds,
        stretches=len(answers),
        accuracy=mean_interval(by.over_all(right)),
        balanced=mean_interval(by.mean(right)),
        behind=behind,
        by_floor={name: float(by.on(right, k)[0]) for k, name in enumerate(by.names)},
        log_score=float(np.mean(np.log(np.maximum([a.probability for a in answers], 1e-6)))),
    )


def confusion(answers: Sequence[Answer], seconds: float) -> dict[str, dict[str, float]]:
    """On each floor, how often each was named after so long [%]."""
    mine = [a for a in answers if a.seconds == seconds]
    names = sorted({a.floor for a in mine} | {a.said for a in mine})
    table: dict[str, dict[str, float]] = {}
    for floor in sorted({a.floor for a in mine}):
        said = [a.said for a in mine if a.floor == floor]
        table[floor] = {name: 100 * said.count(name) / len(said) for name in names}
    return table
