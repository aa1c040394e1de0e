"""Protocols of the benchmark: which runs are held out, and which floors methods are given."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from slipid.data.runs import Runs
from slipid.predict import folds as compared
from slipid.predict.folds import FoldKey, speeds
from slipid.predict.slip_model import Run

HEADING_FOLDS = 2
"""Number of folds by headings and by sectors; one fold holds every other sector."""
SPEED_FOLDS = 2
"""Largest number of folds by speeds; if there are more speeds, several share a fold."""
INNER_FOLDS = 1
"""Number of folds of the training runs that are held out in turn to select settings."""
LEAST_TRAINING, LEAST_HELD_OUT = 8, 3
"""Smallest numbers of training runs and of held-out runs of a split."""
ONLY_FOLD = -1
"""Index of the only fold of the split "all", whose runs are all training runs."""
Labels = Int[np.ndarray, " run"]


class BenchmarkProtocol(NamedTuple):
    """Protocol of the benchmark.

    Attributes:
        split: kind of split of the runs, a key of `KINDS` or "all".
        floor_known: True if methods are given the floor of each held-out run.
        about: description in words.
        unseen_floors: True if slipid's estimator is set up for floors without training runs; other
            rows have no such option.
    """

    split: str
    floor_known: bool
    about: str
    unseen_floors: bool = False


PROTOCOLS: dict[str, BenchmarkProtocol] = {
    "known_floor": BenchmarkProtocol("headings", True, "new headings on a known floor"),
    "unknown_floor": BenchmarkProtocol("headings", False, "new headings on an unknown floor"),
    "sectors": BenchmarkProtocol(
        "sectors", True, "held-out sectors of 60 degrees on a known floor"
    ),
    "speeds": BenchmarkProtocol("speeds", True, "a held-out speed on a known floor"),
    "new_floor": BenchmarkProtocol("floors", False, "a floor without training runs", True),
    "two_floors": BenchmarkProtocol("all", False, "runs from one floor to another, floors unknown"),
}


class Split(NamedTuple):
    """One fold of a kind of split.

    Attributes:
        fold: index of the fold that is held out.
        training: indices of the training runs.
        held_out: indices of the held-out runs.
    """

    fold: int
    training: Int[np.ndarray, " some"]
    held_out: Int[np.ndarray, " others"]


def base_of(floor: str) -> str:
    """Return a floor's name without the load set-up that may follow `@`."""
    return floor.partition("@")[0]


def facts_of(data: Runs, base_radius: float) -> list[FoldKey]:
    """Return floor, heading and speed of all runs, by which the runs are split.

    For a robot with two drives, heading and speed are the direction and the norm of the vector
    (commanded forward speed, base radius times turn rate) [m/s].
    """
    out = compared.fold_keys(data)
    for k, log in enumerate(data.logs):
        if log.wheels == 2 and np.isfinite(data.speed[k]) and log.twist_command is not None:
            ahead = float(np.median(log.twist_command[:, 0]))
            turning = base_radius * float(data.turn[k])
            heading = float(np.degrees(np.arctan2(turning, ahead)))
            out[k] = replace(out[k], heading_deg=heading, speed=float(np.hypot(ahead, turning)))
    return out


def facts_of_run(run: Run) -> FoldKey:
    """Return floor, heading and speed of a run, by which runs are split."""
    return FoldKey(run.floor, float(np.degrees(run.heading)), run.speed)


def headings(facts: Sequence[FoldKey]) -> Labels:
    """Return random folds by heading: runs of one heading are in the same fold on every floor.

    Headings are rounded to 5 deg. Runs without a heading are assigned to folds one by one.
    """
    heading = np.array([f.heading_deg for f in facts])
    known = np.isfinite(heading)
    bins = np.round(np.where(known, heading, 0.0) / 5.0) % 72
    bins = np.where(known, bins, 72 + np.arange(len(heading)))
    number = np.unique(bins, return_inverse=True)[1]
    return np.random.default_rng(0).permutation(number.max() + 1)[number] % HEADING_FOLDS


def sectors(facts: Sequence[FoldKey]) -> Labels:
    """Return folds of even and of odd sectors of the heading; -1 for runs without a heading."""
    sector = compared.sectors(facts)
    return np.where(sector < 0, sector, sector % HEADING_FOLDS)


def floors(facts: Sequence[FoldKey]) -> Labels:
    """Return one fold for each floor, with all load set-ups on it."""
    return np.unique([base_of(f.floor) for f in facts], return_inverse=True)[1]


KINDS: dict[str, Callable[[Sequence[FoldKey]], Labels]] = {
    "headings": headings,
    "sectors": sectors,
    "speeds": partial(speeds, most=SPEED_FOLDS),
    "floors": floors,
}


def splits(facts: Sequence[FoldKey], kind: str) -> list[Split]:
    """Return the folds of a kind of split, omitting folds with too few training or held-out runs.

    Runs whose fold is -1 are training runs in all folds. A run on a floor without training runs is
    not held out, unless the split is by floors.
    """
    everybody = np.arange(len(facts))
    if kind == "all":
        return [Split(ONLY_FOLD, everybody, everybody[:0])]
    part = KINDS[kind](facts)
    where = np.array([f.floor for f in facts])
    found = []
    for fold in sorted(set(part.tolist()) - {-1}):
        training, held_out = everybody[part != fold], everybody[part == fold]
        if kind != "floors":
            held_out = held_out[np.isin(where[held_out], where[training])]
        if len(training) >= LEAST_TRAINING and len(held_out) >= LEAST_HELD_OUT:
            found.append(Split(fold, training, held_out))
    return found


def inner(runs: Sequence[Run], kind: str) -> Labels:
    """Return the inner fold of every training run, for the cross-validation that selects settings.

    The training runs are divided by the protocol's kind of split. The `INNER_FOLDS` largest parts
    are held out in turn and numbered from 0. All other runs are -1, or `INNER_FOLDS` if runs are
    assigned at random, and always remain training runs. If the training runs have fewer than two
    parts of the kind, they are divided by headings. This is always so if the kind is sectors: the
    training runs are every other sector, which is one part, and if another sector were held out of
    them, the gap would be three times as wide as in the protocol.
    """
    facts = [facts_of_run(run) for run in runs]
    for name in dict.fromkeys((kind if kind in KINDS else "headings", "headings")):
        part = KINDS[name](facts)
        names, count = np.unique(part[part >= 0], return_counts=True)
        if len(names) > 1:
            order = names[np.argsort(-count, kind="stable")][:INNER_FOLDS]
            return np.select([part == name for name in order], range(len(order)), -1)
    return np.random.default_rng(0).permutation(len(runs)) % (INNER_FOLDS + 1)
