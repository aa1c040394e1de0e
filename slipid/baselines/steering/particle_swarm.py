"""Particle swarm optimisation: particles remember, and are drawn to, the best places found so far.

    v <- w v + c1 r1 (own best - x) + c2 r2 (best of all - x),   x <- x + v

with r1, r2 uniform in [0, 1], drawn anew for every particle, coordinate and iteration.

Nothing is tuned: inertia and pulls are those that Goswami and Padhy 2018 set.

Liberties:

- Particles start at rest, and evenly drawn over the box.
- A coordinate that would leave the box stays on its edge, and rests there; its speed is at most
  half of the box in an iteration.

Source: Kennedy and Eberhart 1995, "Particle swarm optimization", ICNN, with the inertia of Shi and
Eberhart 1998; sizes and settings of Goswami and Padhy 2018.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Places = Float[np.ndarray, "particle n"]
Cost = Callable[[Places], Float[np.ndarray, " particle"]]
"""Of every particle at once; what is no number counts as infinite."""


@dataclass(frozen=True)
class Swarm:
    """Size of a swarm, for how many iterations it moves, and what moves it.

    Attributes:
        particles, iterations: how many.
        inertia: part of its speed that a particle keeps.
        own, others: pulls to the best place that it has found, and that all have found.
    """

    particles: int = 30
    iterations: int = 50
    inertia: float = 0.7
    own: float = 1.5
    others: float = 1.5


@dataclass(frozen=True, eq=False)
class Found:
    """The best place of a swarm, and the least cost after its start and every iteration."""

    place: Float[np.ndarray, " n"]
    history: Float[np.ndarray, " iteration"]

    @property
    def cost(self) -> float:
        """At the best place."""
        return float(self.history[-1])


def minimise(
    cost: Cost,
    low: Float[np.ndarray, " n"],
    high: Float[np.ndarray, " n"],
    swarm: Swarm,
    seed: int = 0,
) -> Found:
    """The least cost in a box that a swarm finds; the same seed finds the same.

    Args:
        cost: what is minimised.
        low, high: edges of the box.
        swarm: which moves in it.
        seed: of all that is drawn.
    """
    rng, most = np.random.default_rng(seed), 0.5 * (high - low)
    x = rng.uniform(low, high, (swarm.particles, len(low)))
    v, own, value = np.zeros_like(x), x, _finite(cost(x))
    history = [float(value.min())]
    for _ in range(swarm.iterations):
        to_own, to_best = own - x, own[np.argmin(value)] - x
        one, two = rng.uniform(size=(2, *x.shape))
        v = swarm.inertia * v + swarm.own * one * to_own + swarm.others * two * to_best
        v = np.clip(v, -most, most)
        inside = np.clip(x + v, low, high)
        v = np.where(inside == x + v, v, 0.0)
        x = inside
        now = _finite(cost(x))
        better = now < value
        own, value = np.where(better[:, None], x, own), np.where(better, now, value)
        history.append(float(value.min()))
    return Found(own[np.argmin(value)], np.array(history))


def _finite(cost: Float[np.ndarray, " particle"]) -> Float[np.ndarray, " particle"]:
    return np.where(np.isfinite(cost), cost, np.inf)
