"""What is left out, and what methods are told: the questions that every row is asked."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from slipid.baselines.interface import Run
from slipid.data.runs import Runs

FOLDS = 2
"""Parts into which headings and sectors are dealt; every other sector is left out together."""
SPEEDS = 2
"""Parts of speeds, where there are many."""
INNER = 1
"""Parts of the training runs that are left out in turn while a method picks its settings."""
SECTOR_DEG = 60.0
LEAST_FITTED, LEAST_JUDGED = 8, 3
"""Runs without which nothing is fitted, and nothing judged."""
ALL = -1
"""Fold of a split that leaves nothing out."""
Labels = Int[np.ndarray, " run"]


class Protocol(NamedTuple):
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


PROTOCOLS: dict[str, Protocol] = {
    "known_floor": Protocol("headings", True, "new headings on a floor that is told"),
    "unknown_floor": Protocol("headings", False, "new headings, the floor is not told"),
    "sectors": Protocol("sectors", True, "left-out sectors of 60 degrees, the floor is told"),
    "speeds": Protocol("speeds", True, "a left-out speed, the floor is told"),
    "new_floor": Protocol("floors", False, "a floor that no method has seen", True),
    "two_floors": Protocol("all", False, "runs from one floor to another, not told where"),
}


@dataclass(frozen=True)
class Facts:
    """What splits go by: floor, direction commanded [deg] and speed [m/s] of a run.

    The floor has the name of the load set-up after it where that is not the usual one.
    """

    floor: str
    heading_deg: float
    speed: float

    @classmethod
    def of(cls, run: Run) -> "Facts":
        return cls(run.floor, float(np.degrees(run.heading)), run.speed)


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


def setups_of(data: Runs) -> list[str]:
    """Floor of each run, and its load set-up where that is not the one most runs have."""
    loads = [log.load for log in data.logs]
    main = max(dict.fromkeys(loads), key=loads.count)
    return [
        f"{log.surface or 'unknown'}" + ("" if log.load == main else f"@{log.load}")
        for log in data.logs
    ]


def facts_of(data: Runs, base_radius: float) -> list[Facts]:
    """Of all runs; a robot that does not drive sideways has the direction of (speed, turning)."""
    out = []
    floors = setups_of(data)
    for k, log in enumerate(data.logs):
        speed, turn = float(data.speed[k]), float(data.turn[k])
        heading = float(np.degrees(data.heading[k]))
        if log.wheels == 2 and np.isfinite(speed) and log.twist_command is not None:
            ahead = float(np.median(log.twist_command[:, 0]))
            heading = float(np.degrees(np.arctan2(base_radius * turn, ahead)))
            speed = float(np.hypot(ahead, base_radius * turn))
        out.append(Facts(floors[k], heading, speed))
    return out


def headings(facts: Sequence[Facts]) -> Labels:
    """Parts dealt at random by heading, so that one heading is in one part on every floor.

    Runs without a heading are dealt one by one.
    """
    way = np.array([f.heading_deg for f in facts])
    known = np.isfinite(way)
    bins = np.where(known, np.round(np.where(known, way, 0.0) / 5.0) % 72, 72 + np.arange(len(way)))
    number = np.unique(bins, return_inverse=True)[1]
    return np.random.default_rng(0).permutation(number.max() + 1)[number] % FOLDS


def sectors(facts: Sequence[Facts]) -> Labels:
    """Parts of every other sector of directions; -1 of runs without a direction."""
    way = np.array([f.heading_deg for f in facts])
    known = np.isfinite(way)
    turn = np.where(known, way, 0.0) % 360.0
    return np.where(known, np.floor((turn + 1e-6) / SECTOR_DEG).astype(int) % FOLDS, -1)


def speeds(facts: Sequence[Facts]) -> Labels:
    """Parts of one commanded speed, or halves where there are many.

    Runs on a floor that saw one part only are of none, -1.
    """
    speed = np.round([f.speed for f in facts], 3)
    where = np.array([f.floor for f in facts])
    every = np.unique(speed[np.isfinite(speed) & (speed > 0)])
    many = len(every) > 2 * SPEEDS
    edges = np.quantile(every, np.arange(1, SPEEDS) / SPEEDS) if many else every[1:]
    part = np.where(np.isfinite(speed) & (speed > 0), np.searchsorted(edges, speed, "right"), -1)
    for floor in np.unique(where):
        if len(np.unique(part[(where == floor) & (part >= 0)])) < 2:
            part[where == floor] = -1
    return part


def floors(facts: Sequence[Facts]) -> Labels:
    """Parts of one floor each."""
    return np.unique([base_of(f.floor) for f in facts], return_inverse=True)[1]


KINDS: dict[str, Callable[[Sequence[Facts]], Labels]] = {
    "headings": headings,
    "sectors": sectors,
    "speeds": speeds,
    "floors": floors,
}


def splits(facts: Sequence[Facts], kind: str) -> list[Split]:
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
    facts = [Facts.of(run) for run in runs]
    for name in dict.fromkeys((kind if kind in KINDS else "headings", "headings")):
        part = KINDS[name](facts)
        names, count = np.unique(part[part >= 0], return_counts=True)
        if len(names) > 1:
            order = names[np.argsort(-count, kind="stable")][:INNER]
            return np.select([part == name for name in order], range(len(order)), -1)
    return np.random.default_rng(0).permutation(len(runs)) % (INNER + 1)
