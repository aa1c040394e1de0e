"""Maps from a Gaussian, and from draws: their order, their stairs, their bends and warps."""

from dataclasses import replace

import numpy as np

from slipid.identify.posterior.transport.bend import Bend
from slipid.identify.posterior.transport.coordinatewise import Matrix, Values, Vector, Warp
from slipid.identify.posterior.transport.transport_map import Stair, Transport

MOST_DRAWS = 4000
"""Largest number of draws that a map is learnt from."""


def gaussian(mean: Vector, covariance: Matrix, group: np.ndarray, kind: np.ndarray) -> Transport:
    """Map of a Gaussian.

    Groups are those of each coordinate, -1 where groups share it; within a group a higher kind
    follows the lower ones.
    """
    values = Values.none(len(mean))
    stairs = _stairs(np.tile(covariance, (2, 2)), group, kind, values, covariance)
    return Transport(mean, values, stairs, Warp.none(len(mean)))


def _order(
    group: np.ndarray, kind: np.ndarray, values: Values
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Coordinates of every stair, and those before it that they are given."""
    plateau, found = values.plateau > 0, []
    for g in range(-1, int(group.max()) + 1):
        before = np.flatnonzero(group < 0) if g >= 0 else np.zeros(0, int)
        for k in np.unique(kind):
            for first in (True, False):
                own = np.flatnonzero((group == g) & (kind == k) & (plateau == first))
                if len(own):
                    found.append((own, before))
                    before = np.concatenate([before, own])
    return found


def _stairs(
    covariance: Matrix, group: np.ndarray, kind: np.ndarray, values: Values, at_mode: Matrix
) -> tuple[Stair, ...]:
    """Stairs of a Gaussian; the coordinates that are widest at the mode come first in a stair.

    A valley has its direction at the mode, where draws are as wide across as they are bent. The
    covariance is of all coordinates, followed by what they say.
    """
    stairs = []
    for own, given in _order(group, kind, values):
        own = own[np.argsort(-np.diag(_given(at_mode, own, given)[1]))]
        slope, left = _given(covariance, own, given + len(group))
        plateaus = given[(values.plateau[given] > 0) & (group[given] >= 0)]
        bend = Bend.none(len(own), len(plateaus)) if group[own[0]] >= 0 else None
        stairs.append(Stair(own, given, slope, np.linalg.cholesky(left), bend, plateaus))
    return tuple(stairs)


def _given(covariance: Matrix, own: np.ndarray, given: np.ndarray) -> tuple[Matrix, Matrix]:
    """Slope of own coordinates by given ones, and the covariance of what is left."""
    cross = covariance[np.ix_(given, own)]
    slope = np.linalg.solve(covariance[np.ix_(given, given)], cross)
    return slope, covariance[np.ix_(own, own)] - cross.T @ slope


def learnt(
    draws: Matrix, effective: float, covariance: Matrix, group: np.ndarray, kind: np.ndarray
) -> Transport:
    """Map learnt from draws (draw, size) that are worth so many independent ones, about.

    The Laplace covariance counts as many draws as there are coordinates.
    """
    some = draws[:: max(1, len(draws) // MOST_DRAWS)]
    size, mean = some.shape[1], some.mean(axis=0)
    about = some - mean
    values = Values.learnt(about)
    said = values.said(about)
    steps = np.concatenate([np.ones(size), values.slope()])
    at_mode = np.tile(covariance, (2, 2)) * np.outer(steps, steps)
    both = effective * np.cov(np.concatenate([about, said], axis=1).T) + size * at_mode
    stairs = []
    for s in _stairs(both / (effective + size), group, kind, values, covariance):
        left, of_plateaus = s.left(about, said), said[:, s.plateaus]
        bend = Bend.learnt(left, of_plateaus, effective) if s.bend else None
        stairs.append(replace(s, bend=bend))
    found = Transport(mean, values, tuple(stairs), Warp.none(size))
    return replace(found, last=Warp.learnt(found.forward(some)))
