"""Every reading of the logs that is one mistake away from another, and what to call the mistake."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import numpy as np

from slipid.data.sanity.axes.reading import Evidence, Reading
from slipid.data.sanity.motion.headings import Frame

TURN_DEG = 15
"""Grid on which rotations of axes and azimuths are looked for [deg]."""
MANY = 6
"""Wheels beyond which only pairs of columns are exchanged, not all orders tried."""


@dataclass(frozen=True)
class Candidate:
    """A reading with one mistake more.

    Attributes:
        kind: name of the mistake.
        reading: the logs, read right.
        cost: small; of candidates that fit alike that with the least is believed.
    """

    kind: str
    reading: Reading
    cost: float


def candidates(evidence: Evidence, of: Reading) -> Iterator[Candidate]:
    """Readings that are one mistake away."""
    wheels = evidence.wheels
    for sign in _signs(wheels, evidence.rolling):
        yield Candidate("wheel_sign", replace(of, sign=sign[0]), sign[1])
    for order in _orders(wheels):
        yield Candidate("wheel_order", replace(of, order=order), _cost_of_order(order))
    for azimuth in range(-180 + TURN_DEG, 180, TURN_DEG):
        if azimuth:
            yield Candidate("wheel_azimuths", replace(of, azimuth=azimuth), 0.025)
    if of.frame == Frame():
        yield from _frames(of)
    if evidence.command is not None:
        for sign in _signs(wheels, evidence.rolling):
            read = replace(of, command_sign=sign[0])
            yield Candidate("command_sign", read, 0.01 + sign[1])
        for order in _orders(wheels):
            read = replace(of, command_order=order)
            yield Candidate("command_order", read, 0.01 + _cost_of_order(order))
    if evidence.twist is not None:
        for signs in product((1, -1), repeat=3):
            if -1 in signs:
                x, y, yaw = signs
                read = replace(of, twist_sign=(x, y, yaw))
                yield Candidate("command_sign", read, 0.01 * (1 + signs.count(-1)))
    if evidence.gyro is not None:
        yield Candidate("gyro_sign", replace(of, gyro_sign=-1), 0.0)


def _frames(of: Reading) -> Iterator[Candidate]:
    """Other frames of the pose."""

    def read(kind: str, cost: float, frame: Frame) -> Candidate:
        return Candidate(kind, replace(of, frame=frame), cost)

    for quarter in (0, 90, 180, -90):
        more = 0.0 if quarter == 0 else 0.02
        yield read("heading_sign", more, Frame("turned_round", False, quarter))
        yield read("pose_mirrored", more, Frame("turned_round", True, quarter))
        kind = "pose_swapped" if abs(quarter) == 90 else "pose_axis"
        yield read(kind, 0.0 if quarter != 180 else 0.005, Frame("as_said", True, quarter))
    yield read("heading_unit", 0.0, Frame("degrees"))
    yield read("heading_unit", 0.0, Frame("radians"))
    yield read("heading_quaternion", 0.005, Frame("half_sine"))
    for offset in range(-180 + TURN_DEG, 181, TURN_DEG):
        if offset:
            cost = 0.01 if offset % 90 == 0 else 0.02
            yield read("heading_offset", cost, Frame(offset=offset))


def _signs(wheels: int, rolling: np.ndarray) -> Iterator[tuple[tuple[int, ...], float]]:
    """Signs of wheels, with what they cost: one wheel, all, one side, then any."""
    sides = {tuple(np.flatnonzero(side)) for side in (rolling[:, 2] > 0, rolling[:, 2] < 0)}
    for count in range(1, wheels + 1):
        for turned in combinations(range(wheels), count):
            plain = count in (1, wheels) or turned in sides
            sign = tuple(-1 if k in turned else 1 for k in range(wheels))
            yield sign, 0.0 if plain else 0.02


def _orders(wheels: int) -> Iterator[tuple[int, ...]]:
    """Orders of the wheels' columns other than the declared one."""
    declared = tuple(range(wheels))
    if wheels <= MANY:
        yield from (order for order in permutations(declared) if order != declared)
        return
    for a, b in combinations(declared, 2):
        order = list(declared)
        order[a], order[b] = b, a
        yield tuple(order)


def _cost_of_order(order: tuple[int, ...]) -> float:
    """Less for an exchange of two columns than for any order."""
    moved = sum(k != at for at, k in enumerate(order))
    return 0.0 if moved == 2 else 0.01 if moved == 3 else 0.015
