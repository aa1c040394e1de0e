"""Which single mistake explains order, signs and axes far better than what was declared."""

from dataclasses import dataclass

from slipid.data.sanity.axes.candidates import Candidate, candidates
from slipid.data.sanity.axes.reading import Evidence, Reading, misfit, misfits

MISTAKES = 3
"""That are looked for, one after the other."""
GAIN = 0.05
"""A mistake is believed where its reading leaves so much less unexplained,"""
SHARE = 0.3
"""and this part of what it still leaves; no real log comes near it without a mistake."""
EXPLAINED = 0.4
"""Part of the poses' motion that another frame of theirs may leave unexplained."""
ALIKE = 0.02
"""Readings that differ by less are told as other ways to see it."""


@dataclass(frozen=True)
class Mistake:
    """A mistake that explains the logs.

    Attributes:
        found: kind and reading.
        before: what is left unexplained without it; `after`: with it.
        or_else: other kinds of mistake that explain the logs as well.
    """

    found: Candidate
    before: float
    after: float
    or_else: tuple[Candidate, ...]


def mistakes(evidence: Evidence) -> tuple[Reading, tuple[Mistake, ...]]:
    """The logs read right, as far as single mistakes explain them, and the mistakes."""
    reading, found = Reading(), []
    for _ in range(MISTAKES):
        one = _one(evidence, reading)
        if one is None:
            break
        found.append(one)
        reading = one.found.reading
    return reading, tuple(found)


def _one(evidence: Evidence, of: Reading) -> Mistake | None:
    """The simplest mistake that explains decisively better, or None."""
    before = misfit(evidence, of)
    tried = [(misfit(evidence, c.reading), c) for c in candidates(evidence, of)]
    tried = [t for t in tried if t[1].reading.frame == of.frame or _explains(evidence, t[1])]
    after, best = min(tried, key=lambda pair: pair[0] + pair[1].cost)
    if before - after < GAIN + SHARE * after:
        return None
    alike: dict[str, Candidate] = {}
    for left, other in sorted(tried, key=lambda pair: pair[0] + pair[1].cost):
        if other.kind != best.kind and left < after + ALIKE:
            alike.setdefault(other.kind, other)
    return Mistake(best, before, after, tuple(alike.values()))


def _explains(evidence: Evidence, candidate: Candidate) -> bool:
    """Whether poses of another frame then follow the wheels."""
    return misfits(evidence, candidate.reading)["pose"] < EXPLAINED
