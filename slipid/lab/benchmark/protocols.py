"""Protocols of the benchmark: held-out runs, and the information that methods are given."""

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
"""Number of parts of headings and sectors; every other sector is held out together."""
SPEEDS = 2
"""Number of parts of speeds, where there are many."""
INNER = 1
"""Number of parts of the training runs that are held back in turn to pick settings."""
LEAST_TRAINING, LEAST_HELD_OUT = 8, 3
"""Smallest numbers of training runs and of held-out runs of a split."""
ALL = -1
"""Fold of the split without held-out runs."""
Labels = Int[np.ndarray, " run"]


class BenchmarkProtocol(NamedTuple):
    """Protocol of the benchmark.

    Attributes:
        split: kind of split of the runs.
        floor_known: the floor of each run is given to methods.
        about: description in words.
        unseen_floors: slipid's estimator is given that there may be floors without training runs;
            other rows have no such option.
    """

    split: str
    floor_known: bool
    about: str
    unseen_floors: bool = False


PROTOCOLS: dict[str, BenchmarkProtocol] = {
    "known_floor": BenchmarkProtocol("headings", True, "new headings on a known floor"),
    "unknown_floor": BenchmarkProtocol("headings", False, "new headings on an unknown floor"),
    "sectors": BenchmarkProtocol(
        "sectors", True, "left-out sectors of 60 degrees on a known floor"
    ),
    "speeds": BenchmarkProtocol("speeds", True, "a left-out speed on a known floor"),
    "new_floor": BenchmarkProtocol("floors", False, "a floor without training runs", True),
    "two_floors": BenchmarkProtocol("all", False, "runs from one floor to another, floors unknown"),
}


@dataclass(frozen=True, eq=False)
class Split:
    """One fold of a kind of split.

    Attributes:
        kind: kind of split.
        fold: index of the held-out part.
        training: indices of the training runs.
        held_out: indices of the held-out runs.
    """

    kind: str
    fold: int
    training: Int[np.ndarray, " some"]
    held_out: Int[np.ndarray, " others"]

    @property
    def protocols(self) -> tuple[str, ...]:
        """Protocols that use this kind of split."""
        return tuple(name for name, p in PROTOCOLS.items() if p.split == self.kind)


def base_of(floor: str) -> str:
    """Return the name of a floor without that of the load set-up that follows it."""
    return floor.partition("@")[0]


def facts_of(data: Runs, base_radius: float) -> list[FoldKey]:
    """Return the facts of all runs; the direction of a skid steer is that of (speed, turning)."""
    out = compared.fold_keys(data)
    for k, log in enumerate(data.logs):
        if log.wheels == 2 and np.isfinite(data.speed[k]) and log.twist_command is not None:
            ahead = float(np.median(log.twist_command[:, 0]))
            turning = base_radius * float(data.turn[k])
            heading = float(np.degrees(np.arctan2(turning, ahead)))
            out[k] = replace(out[k], heading_deg=heading, speed=float(np.hypot(ahead, turning)))
    return out


def facts_of_run(run: Run) -> FoldKey:
    """Return the facts of a run."""
    return FoldKey(run.floor, float(np.degrees(run.heading)), run.speed)


def headings(facts: Sequence[FoldKey]) -> Labels:
    """Return random parts by heading, with one heading in the same part on every floor.

    Runs without a heading are assigned one by one.
    """
    heading = np.array([f.heading_deg for f in facts])
    known = np.isfinite(heading)
    bins = np.round(np.where(known, heading, 0.0) / 5.0) % 72
    bins = np.where(known, bins, 72 + np.arange(len(heading)))
    number = np.unique(bins, return_inverse=True)[1]
    return np.random.default_rng(0).permutation(number.max() + 1)[number] % FOLDS


def sectors(facts: Sequence[FoldKey]) -> Labels:
    """Return parts of every other sector of directions; -1 for runs without a direction."""
    sector = compared.sectors(facts)
    return np.where(sector < 0, sector, sector % FOLDS)


def floors(facts: Sequence[FoldKey]) -> Labels:
    """Return parts of one floor each."""
    return np.unique([base_of(f.floor) for f in facts], return_inverse=True)[1]


KINDS: dict[str, Callable[[Sequence[FoldKey]], Labels]] = {
    "headings": headings,
    "sectors": sectors,
    "speeds": partial(speeds, most=SPEEDS),
    "floors": floors,
}


def splits(facts: Sequence[FoldKey], kind: str) -> list[Split]:
    """Return the folds of a kind, without those that have too few training or held-out runs.

    Runs of part -1 are training runs in all folds. Runs on floors without training runs are not
    held out, unless the split is by floors.
    """
    everybody = np.arange(len(facts))
    if kind == "all":
        return [Split(kind, ALL, everybody, everybody[:0])]
    part = KINDS[kind](facts)
    where = np.array([f.floor for f in facts])
    found = []
    for fold in sorted(set(part.tolist()) - {-1}):
        training, held_out = everybody[part != fold], everybody[part == fold]
        if kind != "floors":
            held_out = held_out[np.isin(where[held_out], where[training])]
        if len(training) >= LEAST_TRAINING and len(held_out) >= LEAST_HELD_OUT:
            found.append(Split(kind, fold, training, held_out))
    return found


def inner(runs: Sequence[Run], kind: str) -> Labels:
    """Return the part of every training run for picking settings, by the protocol's kind of split.

    The `INNER` largest parts of the training runs are held back in turn and numbered from 0; all
    other runs have -1, or `INNER` after a random assignment, and stay. The parts are by headings
    if the training runs have fewer than two parts of the kind, and so always for sectors: every
    other one is missing already, and with one more missing the gap would be three times as wide as
    that of the protocol.
    """
    facts = [facts_of_run(run) for run in runs]
    for name in dict.fromkeys((kind if kind in KINDS else "headings", "headings")):
        part = KINDS[name](facts)
        names, count = np.unique(part[part >= 0], return_counts=True)
        if len(names) > 1:
            order = names[np.argsort(-count, kind="stable")][:INNER]
            return np.select([part == name for name in order], range(len(order)), -1)
    return np.random.default_rng(0).permutation(len(runs)) % (INNER + 1)
