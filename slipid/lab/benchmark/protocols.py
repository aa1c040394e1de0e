"""What is left out, and what methods are told: the questions that every row is asked."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from slipid.data.runs import Runs
from slipid.predict import folds as compared
from slipid.predict.folds import FoldKey, speeds
from slipid.predict.slip_model import Run

FOLDS = 2
"""Parts into which headings and sectors are dealt; every other sector is left out together."""
SPEEDS = 2
"""Parts of speeds, where there are many."""
INNER = 1
"""Parts of the training runs that are left out in turn while a method picks its settings."""
LEAST_FITTED, LEAST_JUDGED = 8, 3
"""Runs without which nothing is fitted, and nothing judged."""
ALL = -1
"""Fold of a split that leaves nothing out."""
Labels = Int[np.ndarray, " run"]


class BenchmarkProtocol(NamedTuple):
    """A question.

    Attributes:
        split: how runs are split for it.
        told: whether floors are told.
        about: the question in a sentence.
        strange: whether slipid's estimator is told that there may be floors that it has not seen;
            other rows cannot make use of that.
    """

    split: str
    told: bool
    about: str
    strange: bool = False


PROTOCOLS: dict[str, BenchmarkProtocol] = {
    "known_floor": BenchmarkProtocol("headings", True, "new headings on a floor that is told"),
    "unknown_floor": BenchmarkProtocol("headings", False, "new headings, the floor is not told"),
    "sectors": BenchmarkProtocol(
        "sectors", True, "left-out sectors of 60 degrees, the floor is told"
    ),
    "speeds": BenchmarkProtocol("speeds", True, "a left-out speed, the floor is told"),
    "new_floor": BenchmarkProtocol("floors", False, "a floor that no method has seen", True),
    "two_floors": BenchmarkProtocol("all", False, "runs from one floor to another, not told where"),
}


@dataclass(frozen=True, eq=False)
class Split:
    """One fold: numbers of the runs that are fitted and of those that are judged.

    Attributes:
        kind: how runs were split; fold: number of the part that is left out.
    """

    kind: str
    fold: int
    fitted: Int[np.ndarray, " some"]
    judged: Int[np.ndarray, " others"]

    @property
    def name(self) -> str:
        return self.kind if self.fold == ALL else f"{self.kind}_{self.fold}"

    @property
    def protocols(self) -> tuple[str, ...]:
        """Questions that its runs are asked."""
        return tuple(name for name, p in PROTOCOLS.items() if p.split == self.kind)


def base_of(floor: str) -> str:
    """Name of a floor without that of the load set-up that follows it."""
    return floor.partition("@")[0]


def facts_of(data: Runs, base_radius: float) -> list[FoldKey]:
    """Facts of all runs; a robot that cannot drive sideways has the direction (speed, turning)."""
    out = compared.fold_keys(data)
    for k, log in enumerate(data.logs):
        if log.wheels == 2 and np.isfinite(data.speed[k]) and log.twist_command is not None:
            ahead = float(np.median(log.twist_command[:, 0]))
            aside = base_radius * float(data.turn[k])
            way = float(np.degrees(np.arctan2(aside, ahead)))
            out[k] = replace(out[k], heading_deg=way, speed=float(np.hypot(ahead, aside)))
    return out


def facts_of_run(run: Run) -> FoldKey:
    """Facts of a run as methods are given it."""
    return FoldKey(run.floor, float(np.degrees(run.heading)), run.speed)


def headings(facts: Sequence[FoldKey]) -> Labels:
    """Parts dealt at random by heading, so that one heading is in one part on every floor.

    Runs without a heading are dealt one by one.
    """
    way = np.array([f.heading_deg for f in facts])
    known = np.isfinite(way)
    bins = np.where(known, np.round(np.where(known, way, 0.0) / 5.0) % 72, 72 + np.arange(len(way)))
    number = np.unique(bins, return_inverse=True)[1]
    return np.random.default_rng(0).permutation(number.max() + 1)[number] % FOLDS


def sectors(facts: Sequence[FoldKey]) -> Labels:
    """Parts of every other sector of directions; -1 of runs without a direction."""
    sector = compared.sectors(facts)
    return np.where(sector < 0, sector, sector % FOLDS)


def floors(facts: Sequence[FoldKey]) -> Labels:
    """Parts of one floor each."""
    return np.unique([base_of(f.floor) for f in facts], return_inverse=True)[1]


KINDS: dict[str, Callable[[Sequence[FoldKey]], Labels]] = {
    "headings": headings,
    "sectors": sectors,
    "speeds": partial(speeds, most=SPEEDS),
    "floors": floors,
}


def splits(facts: Sequence[FoldKey], kind: str) -> list[Split]:
    """Folds of a kind; none where a part or what is left without it has too few runs.

    Runs of part -1 are always fitted. A floor that is left without a run is not judged.
    """
    everybody = np.arange(len(facts))
    if kind == "all":
        return [Split(kind, ALL, everybody, everybody[:0])]
    part = KINDS[kind](facts)
    where = np.array([f.floor for f in facts])
    found = []
    for fold in sorted(set(part.tolist()) - {-1}):
        fitted, judged = everybody[part != fold], everybody[part == fold]
        if kind != "floors":
            judged = judged[np.isin(where[judged], where[fitted])]
        if len(fitted) >= LEAST_FITTED and len(judged) >= LEAST_JUDGED:
            found.append(Split(kind, fold, fitted, judged))
    return found


def inner(runs: Sequence[Run], kind: str) -> Labels:
    """Part of every training run for picking settings, of the kind that methods are judged by.

    The `INNER` largest parts of the training runs are held back in turn and numbered from 0; all
    other runs have -1, or after random dealing `INNER`, and stay. Headings are dealt where the
    training runs have fewer than two parts of the kind, and so always for sectors: every other one
    is missing already, and without one more the gap would be three times as wide as is asked about.
    """
    facts = [facts_of_run(run) for run in runs]
    for name in dict.fromkeys((kind if kind in KINDS else "headings", "headings")):
        part = KINDS[name](facts)
        names, count = np.unique(part[part >= 0], return_counts=True)
        if len(names) > 1:
            order = names[np.argsort(-count, kind="stable")][:INNER]
            return np.select([part == name for name in order], range(len(order)), -1)
    return np.random.default_rng(0).permutation(len(runs)) % (INNER + 1)
