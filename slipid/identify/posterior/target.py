"""A log density as a sum of terms of groups of coordinates, and which of them move together."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from slipid.identify.posterior.transport.pieces import Matrix
from slipid.identify.posterior.transport.transport_map import Transport, gaussian


@dataclass(frozen=True, eq=False)
class Target:
    """A log density, and what is known of it beforehand.

    Terms of vectors (walker, size) are (walker, group + 1), the shared one last; the slope is that
    of their sum. Coordinates have a group, -1 where groups share them, and a kind, which is moved
    apart; centre and covariance are of a Gaussian near it (Laplace). Where walkers are `apart`,
    each has a density of its own, so that all are evaluated together and in order, and none can be
    moved by what others do. The map is what it is seen through; None for x itself.
    """

    terms: Callable[[Matrix], Matrix]
    slope: Callable[[Matrix], Matrix]
    group: Int[np.ndarray, " size"]
    kind: Int[np.ndarray, " size"]
    centre: Float[np.ndarray, " size"]
    covariance: Matrix
    apart: bool = False
    map: Transport | None = None

    def log_prob(self, x: Matrix) -> Matrix:
        """Log density and, as blobs, its terms."""
        terms = self.terms(x)
        return np.concatenate([terms.sum(axis=1, keepdims=True), terms], axis=1)

    def laplace(self) -> Transport:
        """Map of the Gaussian near it."""
        return gaussian(self.centre, self.covariance, self.group, self.kind)

    def seen_by(self, map: Transport) -> "Target":
        """The same distribution in other coordinates; centre and covariance are left alone."""
        count = int(self.group.max()) + 1
        onto = np.eye(count + 1)[np.where(self.group < 0, count, self.group)]

        def terms(u: Matrix) -> Matrix:
            x, log = map.placed(u)
            return np.asarray(self.terms(x) + log @ onto)

        def slope(u: Matrix) -> Matrix:
            return map.pull(u, self.slope)

        return replace(self, terms=terms, slope=slope, map=map)


@dataclass(frozen=True)
class Family:
    """Coordinates that are moved together: those of each group, or the shared ones alone (None)."""

    places: tuple[Int[np.ndarray, " _"], ...]
    groups: tuple[int, ...] | None


def families(target: Target) -> list[Family]:
    """Coordinates of every kind, of all groups and shared."""
    found = []
    for k in np.unique(target.kind):
        groups = tuple(int(g) for g in np.unique(target.group[target.kind == k]) if g >= 0)
        places = [np.flatnonzero((target.kind == k) & (target.group == g)) for g in groups]
        if groups:
            found.append(Family(tuple(places), groups))
        shared = np.flatnonzero((target.kind == k) & (target.group < 0))
        if len(shared):
            found.append(Family((shared,), None))
    return found
