"""Results of floor classifiers: answers, accuracies by length of the signals, and tables."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slipid.lab.benchmark.summary import Jackknife
from slipid.support.content import Content


@dataclass(frozen=True)
class Answer:
    """Answer of a classifier after the first seconds of a stretch of a held-out run.

    Attributes:
        run: name of the run.
        floor: true floor.
        seconds: length of the signals used [s].
        named: most probable floor.
        probability: probability of the true floor.
    """

    run: str
    floor: str
    seconds: float
    named: str
    probability: float


Accuracies = Content
"""Accuracy of a classifier after the first seconds of every stretch, in the form of benchmark.json.

- seconds: length of the signals used [s].
- stretches: number of stretches.
- accuracy: fraction of the stretches in which the most probable floor is the true one.
- balanced: mean over floors of the accuracy on each floor.
- behind: accuracy minus that of slipid, on the same runs; None for slipid itself.
- by_floor: accuracy on each floor.
- log_score: mean natural logarithm of the probability of the true floor; 0 is best, and equal
  probabilities of n floors give log(1 / n).

Each of `accuracy`, `balanced` and `behind` has a value and its interval (`MeanInterval`).
"""
ClassifierTable = Content
"""Table of all classifiers on one set of runs, in the form of benchmark.json.

- about: description of the runs.
- runs: number of runs.
- floors: names of the floors.
- chance: accuracy of a classifier that always names the most common floor.
- rows: a row for each classifier:
    - name: name of the row.
    - settings: settings picked by cross-validation in each fold, in words.
    - numbers: number of fitted parameters, median over folds.
    - after: accuracy after each time (`Accuracies`).
    - said: confusion table after the longest time: `said[true][named]` is the fraction of the
      stretches on the true floor in which a floor was named [%].
    - fit_s: time of one fit, median over folds [s].
    - tune_s: time to pick settings, median over folds [s].
    - row_us: time per row of signals, median over folds [microseconds].
    - absent: reason why the row is empty.
"""


def after_seconds(answers: Sequence[Answer], rival: Sequence[Answer] | None) -> list[Accuracies]:
    """Return the accuracy after each time, compared with a rival's if there is one.

    `rival` has the answers of another classifier to the same stretches, in the same order.
    """
    out = []
    for seconds in sorted({a.seconds for a in answers}):
        take = [k for k, a in enumerate(answers) if a.seconds == seconds]
        mine = [answers[k] for k in take]
        out.append(_after(mine, None if rival is None else [rival[k] for k in take]))
    return out


def _after(answers: Sequence[Answer], rival: Sequence[Answer] | None) -> Accuracies:
    """Return the accuracy from answers that were all read after the same time."""
    right = np.array([a.named == a.floor for a in answers], dtype=float)
    # leave out whole runs, since the stretches of one run are correlated
    run = np.unique([a.run for a in answers], return_inverse=True)[1]
    by = Jackknife.by([a.floor for a in answers], run)
    behind = None
    if rival is not None:
        assert [(a.run, a.floor) for a in rival] == [(a.run, a.floor) for a in answers]
        theirs = np.array([a.named == a.floor for a in rival], dtype=float)
        behind = by.interval(by.over_all(right - theirs))
    return {
        "seconds": answers[0].seconds,
        "stretches": len(answers),
        "accuracy": by.interval(by.over_all(right), "share"),
        "balanced": by.interval(by.mean(right), "share"),
        "behind": behind,
        "by_floor": {name: float(by.on(right, k)[0]) for k, name in enumerate(by.names)},
        "log_score": float(np.mean(np.log(np.maximum([a.probability for a in answers], 1e-6)))),
    }


def confusion(answers: Sequence[Answer], seconds: float) -> dict[str, dict[str, float]]:
    """Return the confusion table of the answers after `seconds` [s].

    `table[true][named]` is the percentage of the answers on the floor `true` that name the floor
    `named`.
    """
    mine = [a for a in answers if a.seconds == seconds]
    names = sorted({a.floor for a in mine} | {a.named for a in mine})
    table: dict[str, dict[str, float]] = {}
    for floor in sorted({a.floor for a in mine}):
        named = [a.named for a in mine if a.floor == floor]
        table[floor] = {name: 100 * named.count(name) / len(named) for name in names}
    return table
