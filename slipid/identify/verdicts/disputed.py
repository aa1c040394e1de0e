"""Floors that disagree about the loads on the wheels by more than noise.

A floor sees the loads with a bias of its own (`slipid.model.contact_law`), and a prior that was
found from all floors holds these biases near zero: intervals of the loads count it. Whether floors
really disagree is asked of the data alone. With P0 the precision that this prior adds to that of
the fit, L, and P1 one of a prior so wide that it says nothing, every floor on its own would move
the numbers z by

    d = (L + P1 - P0)^-1 (P0 - P1) z    of the biases

and the difference of the biases of two floors, over its covariance, is a chi-square if the law is
right about both.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.stats import chi2, norm

from slipid.identify.fit.variances import Search, Square
from slipid.identify.verdicts.estimates import Estimate
from slipid.search_space import Space

CHANCE = 0.01
"""Disagreement is said where noise alone would make as much this rarely."""
_WIDE = 1.0
"""Std of biases that nothing is known about beforehand."""


@dataclass(frozen=True)
class Dispute:
    """Two floors, and how many standard errors what they say of the loads is apart."""

    floors: tuple[str, str]
    sigma: float

    @property
    def sentence(self) -> str:
        one, other = self.floors
        return (
            f"{one} and {other} disagree about the loads on the wheels by {self.sigma:.1f} "
            "standard errors of their noise: the contact law lacks something; intervals count it"
        )


def disputes(space: Space, z: Search, covariance: Square) -> tuple[Dispute, ...]:
    """Pairs of floors whose biases of the load differ by more than noise, the worst first.

    The space has the prior that biases were found to have (`Space.with_pooled`).
    """
    bias = {e.surface: space.place[e.path] for e in space.free if e.declaration.deviation}
    if len(bias) < 2:
        return ()
    at = np.concatenate([np.arange(p.start, p.stop) for p in bias.values()])
    told, less = np.linalg.inv(covariance), 1 / space.prior_std[at] ** 2 - 1 / _WIDE**2
    told[at, at] -= less
    wide = np.linalg.inv(told)
    apart = np.asarray(z) + wide[:, at] @ (less * (np.asarray(z) - space.prior_mean)[at])
    found = []
    for one, other in combinations(bias, 2):
        difference = np.zeros((bias[one].stop - bias[one].start, len(apart)))
        difference[:, bias[one]] = np.eye(len(difference))
        difference[:, bias[other]] = -np.eye(len(difference))
        gap, spread = difference @ apart, difference @ wide @ difference.T
        chance = float(chi2.sf(gap @ np.linalg.solve(spread, gap), len(gap)))
        if chance < CHANCE:
            found.append(Dispute((str(one), str(other)), float(norm.isf(chance / 2))))
    return tuple(sorted(found, key=lambda d: -d.sigma))


def marked(numbers: Mapping[str, Estimate], found: Iterable[Dispute]) -> dict[str, Estimate]:
    """The same, loads called *disputed* instead of *identified* where floors disagree."""
    if not any(True for _ in found):
        return dict(numbers)
    return {
        path: replace(e, verdict="disputed")
        if path.startswith("robot.load_share@") and e.verdict == "identified"
        else e
        for path, e in numbers.items()
    }
