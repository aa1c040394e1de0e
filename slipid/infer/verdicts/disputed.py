"""Floors that disagree about the wheel loads, and the difference that the test would have seen.

Each floor has separate load biases (`slipid.model.contact_law`). Their prior is estimated from all
floors and keeps them near zero; the intervals of the loads take this prior into account. The test
for disagreement replaces this prior by an uninformative one. With L the precision of the fit, P0
the part of L from the prior, and P1 the precision of the uninformative prior, the search vector z,
relative to its prior mean, changes by

    d = (L + P1 - P0)^-1 (P0 - P1) z

and the difference g of two floors' biases, with covariance C, has g^T C^-1 g, a chi-square variable
if the contact law holds on both floors.

If the biases of two floors truly differ by g, it has the noncentrality g^T C^-1 g, and the test
reports a noncentrality of at least l with a probability of at least `POWER`. Among all g in which
the load of one wheel differs by x = c^T g, the smallest noncentrality is x^2 / (c^T C c). Hence a
difference of x = sqrt(l c^T C c) is reported with this probability however the loads of the other
wheels differ.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2, norm

from slipid.fitting.variances import Search, Square
from slipid.infer.verdicts.estimates import Estimate
from slipid.parameter import share_basis
from slipid.search_space import Space
from slipid.support.content import Content

LARGEST_P_VALUE = 0.01
"""Largest p-value at which a disagreement is reported."""
POWER = 0.8
"""Probability with which a difference of the size `LoadComparison.smallest` is reported."""
LARGEST_SEEN = 0.25
"""Smallest reported difference beyond which the test says nothing.

It is 3.5 stds of the difference of two floors' biases with the std of 0.05 that is expected."""
MOST_PAIRS = 6
"""Largest number of pairs of floors that a sentence names."""
_LEAST_CHANCE = 1e-300
"""Smallest p-value that is converted to standard errors."""
_UNINFORMATIVE_STD = 1.0
"""Std of the uninformative prior of load biases."""


@dataclass(frozen=True)
class LoadComparison:
    """Test whether two floors agree about the wheel loads.

    Attributes:
        floors: names of the floors.
        standard_errors: number of standard errors with the same p-value as the difference found.
        smallest: smallest difference of each wheel's load that is reported with the probability
            `POWER`, as a difference of natural logarithms.
    """

    floors: tuple[str, str]
    standard_errors: float
    smallest: tuple[float, ...]

    @property
    def disputed(self) -> bool:
        """True if the floors disagree."""
        return bool(self.standard_errors > norm.isf(LARGEST_P_VALUE / 2))

    @property
    def seen(self) -> float:
        """Smallest difference of a load that is reported, for the wheel for which it is least."""
        return min(self.smallest)

    def to_json(self) -> Content:
        """Return the comparison in the form of identified.json."""
        return asdict(self)

    @classmethod
    def of_json(cls, content: Content) -> "LoadComparison":
        """Return a comparison from the content that `to_json` returns."""
        one, other = content["floors"]
        return cls((one, other), content["standard_errors"], tuple(content["smallest"]))


def load_comparisons(space: Space, z: Search, covariance: Square) -> tuple[LoadComparison, ...]:
    """Return the comparison of every pair of floors, the most sensitive first.

    The prior of the biases in `space` must have the fitted std (`Space.with_pooled`).
    """
    bias = {str(e.surface): space.slices[e.path] for e in space.free if e.declaration.deviation}
    if len(bias) < 2:
        return ()
    at = np.concatenate([np.arange(p.start, p.stop) for p in bias.values()])
    precision, less = (
        np.linalg.inv(covariance),
        1 / space.prior_std[at] ** 2 - 1 / _UNINFORMATIVE_STD**2,
    )
    precision[at, at] -= less
    wide = np.linalg.inv(precision)
    separate = np.asarray(z) + wide[:, at] @ (less * (np.asarray(z) - space.prior_mean)[at])
    found = []
    for one, other in combinations(bias, 2):
        difference = separate[bias[one]] - separate[bias[other]]
        spread = wide[bias[one]] - wide[bias[other]]
        spread = spread[:, bias[one]] - spread[:, bias[other]]
        size = len(difference)
        chance = float(chi2.sf(difference @ np.linalg.solve(spread, difference), size))
        wheels = share_basis(size + 1)
        variance = np.einsum("wi,ij,wj->w", wheels, spread, wheels)
        smallest = np.sqrt(_noncentrality(size) * variance)
        errors = float(norm.isf(max(chance, _LEAST_CHANCE) / 2))
        found.append(LoadComparison((one, other), errors, tuple(smallest.tolist())))
    return tuple(sorted(found, key=lambda one: one.seen))


@cache
def _noncentrality(size: int) -> float:
    """Return the noncentrality of a chi-square variable that the test reports with `POWER`."""
    level = chi2.isf(LARGEST_P_VALUE, size)
    return float(brentq(lambda x: ncx2.sf(level, size, x) - POWER, 1e-3, 1e3))


def sensitivity(found: Sequence[LoadComparison]) -> str:
    """Return a sentence on the differences that the comparisons would have seen.

    It is empty without comparisons.
    """
    seen = [f"{100 * c.seen:.0f} % {_pair(c)}" for c in found if c.seen <= LARGEST_SEEN]
    unseen = [f"{_pair(c)} ({100 * c.seen:.0f} %)" for c in found if c.seen > LARGEST_SEEN]
    parts = []
    if seen:
        parts.append(
            f"a wheel's load that differed by {_listed(seen)} would have been reported as disputed "
            f"with a probability of {100 * POWER:.0f} %"
        )
    if unseen:
        parts.append(
            "the comparison of loads says nothing where only larger differences would have been "
            f"reported: {_listed(unseen)}"
        )
    return "; ".join(parts)


def _pair(of: LoadComparison) -> str:
    return f"between {' and '.join(of.floors)}"


def _listed(pairs: Sequence[str]) -> str:
    """Return the first pairs of floors, and the number of further ones."""
    more = len(pairs) - MOST_PAIRS
    return ", ".join(pairs[:MOST_PAIRS]) + (f" and so for {more} more pairs" if more > 0 else "")


def marked(
    numbers: Mapping[str, Estimate], found: Mapping[tuple[str, str], float]
) -> dict[str, Estimate]:
    """Change `identified` to `disputed` in the verdicts of load fractions if floors disagree."""
    return {
        path: replace(e, verdict="disputed")
        if found and path.startswith("robot.load_share@") and e.verdict == "identified"
        else e
        for path, e in numbers.items()
    }
