"""Moves of Markov chains: univariate slice sampling, and Hamiltonian steps of all coordinates.

Sources: Neal 2003, Annals of Statistics 31(3), slice sampling; Neal 2011, Handbook of Markov Chain
Monte Carlo, chapter 5, Hamiltonian Monte Carlo.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

Chains = Float[np.ndarray, "chain coordinate"]
"""Positions of several chains."""


def sliced(
    log_density: Callable[[float], float], x: float, width: float, rng: np.random.Generator
) -> float:
    """Return the next state of a univariate slice sampler; `width` is that of a step outwards.

    Raises:
        ValueError: the density at x is not finite.
    """
    level = log_density(x) - rng.exponential()
    if not math.isfinite(level):
        raise ValueError(f"log density {level} at {x}; expected a finite one")
    low = x - width * rng.uniform()
    high = low + width
    while log_density(low) > level:
        low -= width
    while log_density(high) > level:
        high += width
    while True:
        new = rng.uniform(low, high)
        if log_density(new) > level:
            return new
        low, high = (new, high) if new < x else (low, new)


class SlopedDensity(NamedTuple):
    """A density, as functions of the positions of all chains.

    Attributes:
        log_density: function that returns its logarithm in every chain, up to a constant.
        slope: function that returns the derivative of the logarithm.
    """

    log_density: Callable[[Chains], Float[np.ndarray, " chain"]]
    slope: Callable[[Chains], Chains]


class Moved(NamedTuple):
    """Chains after a move.

    Attributes:
        x: positions.
        accepted: True for chains that have moved.
    """

    x: Chains
    accepted: Bool[np.ndarray, " chain"]


def hamiltonian(
    target: SlopedDensity,
    x: Chains,
    root: Float[np.ndarray, "coordinate coordinate"],
    step: float,
    leaps: int,
    rng: np.random.Generator,
) -> Moved:
    """Return the chains after a Hamiltonian move of `leaps` leapfrog steps.

    Steps are in units of `root`, a root of about the covariance of the target.
    """
    momentum = rng.standard_normal(x.shape)
    before = target.log_density(x) - 0.5 * (momentum**2).sum(axis=1)
    new, p = x, momentum + 0.5 * step * target.slope(x) @ root
    for k in range(leaps):
        new = new + step * p @ root.T
        p = p + (step if k < leaps - 1 else 0.5 * step) * target.slope(new) @ root
    after = target.log_density(new) - 0.5 * (p**2).sum(axis=1)
    accepted = after > before - rng.exponential(size=len(x))
    return Moved(np.where(accepted[:, None], new, x), accepted)
