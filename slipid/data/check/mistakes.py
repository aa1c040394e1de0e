"""Search for single mistakes in order, signs and axes.

A mistake is found if the channels agree far better with its correction than as declared.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import numpy as np

from slipid.data.check.interpretation import Evidence, Interpretation, misfits
from slipid.data.check.joined import PoseConvention

MOST_MISTAKES = 3
"""Largest number of mistakes, which are found one after another."""
LEAST_REDUCTION = 0.05
"""Constant part of the least reduction of the misfit for which a mistake is accepted,
`LEAST_REDUCTION` plus `REDUCTION_SHARE` times the remaining misfit [1]."""
REDUCTION_SHARE = 0.3
"""Factor in the least reduction (see `LEAST_REDUCTION`) [1]; in real logs without a mistake the
reductions stay far below the least reduction."""
MOST_UNEXPLAINED = 0.4
"""Largest fraction of the poses' motion that an accepted pose convention leaves unexplained [1]."""
ALTERNATIVE_MARGIN = 0.02
"""Difference of misfits below which another kind of mistake is named as an alternative [1]."""
GRID_DEG = 15
"""Grid spacing of the searched heading offsets and azimuths [deg]."""
MOST_PERMUTED = 6
"""Number of wheels above which only exchanges of two columns are tried, not all orders."""


@dataclass(frozen=True)
class Candidate:
    """A candidate interpretation, which corrects one mistake of the current interpretation.

    Attributes:
        kind: name of the kind of mistake.
        meant: the interpretation.
        cost: small number added to the misfit when candidates are ranked, so that of several
            candidates with about the same misfit the simplest is accepted [1].
    """

    kind: str
    meant: Interpretation
    cost: float


@dataclass(frozen=True)
class Mistake:
    """A mistake in the config, whose correction explains the logs decisively better.

    Attributes:
        found: the candidate interpretation that corrects the mistake.
        before: misfit without the correction.
        after: misfit with the correction.
        others: corrections of other kinds that explain the logs about equally well.
    """

    found: Candidate
    before: float
    after: float
    others: tuple[Candidate, ...]


def mistakes(evidence: Evidence) -> tuple[Interpretation, tuple[Mistake, ...]]:
    """Return the right interpretation, and the mistakes in the declared one that it corrects."""
    meant, found = Interpretation(), []
    for _ in range(MOST_MISTAKES):
        one = _next_mistake(evidence, meant)
        if one is None:
            break
        found.append(one)
        meant = one.found.meant
    return meant, tuple(found)


def _next_mistake(evidence: Evidence, current: Interpretation) -> Mistake | None:
    """Return the mistake whose correction explains the logs decisively better, or None."""
    before = sum(misfits(evidence, current).values())
    # Another convention of the poses is only a candidate if the poses then follow the wheels, that
    # is, if it leaves less than `MOST_UNEXPLAINED` of their motion unexplained.
    tried = [
        (sum(left.values()), c)
        for c in candidates(evidence, current)
        for left in [misfits(evidence, c.meant)]
        if c.meant.convention == current.convention or left["pose"] < MOST_UNEXPLAINED
    ]
    (after, best), *rest = sorted(tried, key=lambda pair: pair[0] + pair[1].cost)
    if before - after < LEAST_REDUCTION + REDUCTION_SHARE * after:
        return None
    alternatives: dict[str, Candidate] = {}
    for left, other in rest:
        if other.kind != best.kind and left < after + ALTERNATIVE_MARGIN:
            alternatives.setdefault(other.kind, other)
    return Mistake(best, before, after, tuple(alternatives.values()))


def candidates(evidence: Evidence, current: Interpretation) -> Iterator[Candidate]:
    """Yield the interpretations that differ from the current one by one mistake."""
    wheels = evidence.wheels
    for sign, cost in _signs(wheels, evidence.rolling):
        yield Candidate("wheel_sign", replace(current, sign=sign), cost)
    for order, cost in _orders(wheels):
        yield Candidate("wheel_order", replace(current, order=order), cost)
    for azimuth in range(-180 + GRID_DEG, 180, GRID_DEG):
        if azimuth:
            yield Candidate("wheel_azimuths", replace(current, azimuth=azimuth), 0.025)
    if current.convention == PoseConvention():
        yield from _conventions(current)
    if evidence.command is not None:
        for sign, cost in _signs(wheels, evidence.rolling):
            yield Candidate("command_sign", replace(current, command_sign=sign), 0.01 + cost)
        for order, cost in _orders(wheels):
            yield Candidate("command_order", replace(current, command_order=order), 0.01 + cost)
    if evidence.twist is not None:
        for signs in product((1, -1), repeat=3):
            if -1 in signs:
                x, y, yaw = signs
                read = replace(current, twist_sign=(x, y, yaw))
                yield Candidate("command_sign", read, 0.01 * (1 + signs.count(-1)))
    if evidence.gyro is not None:
        yield Candidate("gyro_sign", replace(current, gyro_sign=-1), 0.0)


def _conventions(current: Interpretation) -> Iterator[Candidate]:
    """Yield candidates with other conventions of the poses."""

    def other(kind: str, cost: float, convention: PoseConvention) -> Candidate:
        return Candidate(kind, replace(current, convention=convention), cost)

    for quarter in (0, 90, 180, -90):
        more = 0.0 if quarter == 0 else 0.02
        yield other("heading_sign", more, PoseConvention("turned_round", False, quarter))
        # On two wheels, exchanged columns look the same as mirrored poses, and are likelier.
        yield other("pose_mirrored", 0.002 + more, PoseConvention("turned_round", True, quarter))
        kind = "pose_swapped" if abs(quarter) == 90 else "pose_axis"
        cost = 0.005 if quarter == 180 else 0.0
        yield other(kind, cost, PoseConvention("as_logged", True, quarter))
    yield other("heading_unit", 0.0, PoseConvention("degrees"))
    yield other("heading_unit", 0.0, PoseConvention("radians"))
    yield other("heading_quaternion", 0.005, PoseConvention("half_sine"))
    for offset in range(-180 + GRID_DEG, 181, GRID_DEG):
        if offset:
            cost = 0.01 if offset % 90 == 0 else 0.02
            yield other("heading_offset", cost, PoseConvention(offset=offset))


def _signs(wheels: int, rolling: np.ndarray) -> Iterator[tuple[tuple[int, ...], float]]:
    """Yield the signs of the wheels for every choice of reversed wheels, each with its cost.

    Reversing a single wheel, all wheels, or the wheels of one side costs nothing; any other choice
    costs 0.02.
    """
    sides = {tuple(np.flatnonzero(side)) for side in (rolling[:, 2] > 0, rolling[:, 2] < 0)}
    for count in range(1, wheels + 1):
        for turned in combinations(range(wheels), count):
            plain = count in (1, wheels) or turned in sides
            sign = tuple(-1 if k in turned else 1 for k in range(wheels))
            yield sign, 0.0 if plain else 0.02


def _orders(wheels: int) -> Iterator[tuple[tuple[int, ...], float]]:
    """Yield other orders of the wheels' columns, each with its cost.

    The cost grows with the number of columns that are not in their declared position.
    """
    declared = tuple(range(wheels))
    for order in permutations(declared) if wheels <= MOST_PERMUTED else _exchanges(declared):
        moved = sum(k != at for at, k in enumerate(order))
        if moved:
            yield order, {2: 0.0, 3: 0.01}.get(moved, 0.015)


def _exchanges(declared: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Yield all orders in which two columns are exchanged."""
    for a, b in combinations(declared, 2):
        yield tuple({a: b, b: a}.get(k, k) for k in declared)
