"""How far a map can be trusted: what is told apart, and how well."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float32, Int

from slipid.vision.floor.segmentation.surfaces import Surfaces

HARDLY, NOT = 5.0, 3.5
"""Surfaces whose looks differ by less are hardly told apart, or not at all [spreads].

One surface under two names comes out at about 3.2: each name takes one side of its noise.
"""
MOST_UNKNOWN = 1 / 3
"""Of the floor that was asked for."""


@dataclass(frozen=True)
class Pair:
    """Two surfaces that look much alike.

    Attributes:
        apart: how far their looks differ, in the middle of the picture's places [spreads].
    """

    one: str
    other: str
    apart: float

    @property
    def separable(self) -> bool:
        return self.apart >= NOT

    def said(self) -> str:
        how = "are hardly told apart" if self.separable else "are not told apart"
        return (
            f"{self.one} and {self.other} {how}: their looks differ by {self.apart:.1f} spreads "
            "of one surface; mark more points on them, or give them one name"
        )


def alike(surfaces: Surfaces, names: tuple[str, ...]) -> tuple[Pair, ...]:
    """Pairs of surfaces that are hardly told apart."""
    looks = surfaces.looks((24, 24)).reshape(len(names), -1, 4)
    found = []
    for k, other in combinations(range(len(names)), 2):
        spread = np.maximum(surfaces.spread[k], surfaces.spread[other])
        apart = np.linalg.norm((looks[k] - looks[other]) / spread, axis=1)
        pair = Pair(names[k], names[other], float(np.median(apart)))
        if pair.apart < HARDLY:
            found.append(pair)
    return tuple(found)


def margin(
    costs: Float32[np.ndarray, "surface row column"],
    cells: Bool[np.ndarray, "row column"],
    own: int,
) -> float | None:
    """How much worse the next best surface explains a patch than its own [spreads].

    The median over its cells of the difference of distances; None where there is no other.
    """
    if len(costs) < 2:
        return None
    off = np.sqrt(np.maximum(costs[:, cells], 0))
    others = np.delete(off, own, axis=0).min(axis=0)
    return float(np.median(others - off[own]))


def verdict(
    pairs: tuple[Pair, ...],
    labels: Int[np.ndarray, "row column"],
    wanted: Bool[np.ndarray, "row column"],
) -> tuple[str, ...]:
    """Why a map is poor; nothing where it is good."""
    poor = [pair.said() for pair in pairs if not pair.separable]
    unknown = unknown_share(labels, wanted)
    if unknown > MOST_UNKNOWN:
        poor.append(
            f"{100 * unknown:.0f} % of the floor that was asked for is unknown; expected at most "
            f"{100 * MOST_UNKNOWN:.0f} %: a region without what is no floor, points on every "
            "surface"
        )
    return tuple(poor)


def unknown_share(
    labels: Int[np.ndarray, "row column"], wanted: Bool[np.ndarray, "row column"]
) -> float:
    """Of the cells that were asked for."""
    return float((labels[wanted] < 0).mean())
