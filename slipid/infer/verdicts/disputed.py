"""Floors that disagree about the wheel loads.

Each floor has separate load biases (`slipid.model.contact_law`). Their prior is estimated from all
floors and keeps them near zero; the intervals of the loads take this prior into account. The test
for disagreement replaces this prior by an uninformative one. With L the precision of the fit, P0
the part of L from the prior, and P1 the precision of the uninformative prior, the search vector z,
relative to its prior mean, changes by

    d = (L + P1 - P0)^-1 (P0 - P1) z

and the difference of two floors' biases, squared and divided by its covariance, is a chi-square
variable if the contact law holds on both floors.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.stats import chi2, norm

from slipid.fitting.variances import Search, Square
from slipid.infer.verdicts.estimates import Estimate
from slipid.search_space import Space

LARGEST_P_VALUE = 0.01
"""Largest p-value at which a disagreement is reported."""
_UNINFORMATIVE_STD = 1.0
"""Std of the uninformative prior of load biases."""


def disputes(space: Space, z: Search, covariance: Square) -> dict[tuple[str, str], float]:
    """Return pairs of floors whose load biases differ by more than noise, with the difference.

    A difference is given as the number of standard errors with the same p-value, largest first. The
    prior of the biases in `space` must have the fitted std (`Space.with_pooled`).
    """
    bias = {e.surface: space.slices[e.path] for e in space.free if e.declaration.deviation}
    if len(bias) < 2:
        return {}
    at = np.concatenate([np.arange(p.start, p.stop) for p in bias.values()])
    precision, less = (
        np.linalg.inv(covariance),
        1 / space.prior_std[at] ** 2 - 1 / _UNINFORMATIVE_STD**2,
    )
    precision[at, at] -= less
    wide = np.linalg.inv(precision)
    separate = np.asarray(z) + wide[:, at] @ (less * (np.asarray(z) - space.prior_mean)[at])
    found = {}
    for one, other in combinations(bias, 2):
        difference = separate[bias[one]] - separate[bias[other]]
        spread = wide[bias[one]] - wide[bias[other]]
        spread = spread[:, bias[one]] - spread[:, bias[other]]
        chance = float(chi2.sf(difference @ np.linalg.solve(spread, difference), len(difference)))
        if chance < LARGEST_P_VALUE:
            found[str(one), str(other)] = float(norm.isf(chance / 2))
    return dict(sorted(found.items(), key=lambda pair: -pair[1]))


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
