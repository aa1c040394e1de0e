"""Moves of an ensemble of walkers, accepted by the exact log density.

The log density is a sum of one term per group of coordinates and a term of the coordinates that
groups share. A move changes either all coordinates, or all groups in one evaluation while the
shared coordinates stay: then each group is accepted or rejected by its own term.

Hamiltonian moves follow the slope of a surrogate (`slipid.infer.posterior.surrogate`). Where the
surrogate is wrong, they are refused; differential evolution and walks along single coordinates
bring a walker away from there.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from emcee.model import Model
from emcee.moves import Move
from emcee.state import State
from jaxtyping import Array, Float, Int
from numpy.random import RandomState

from slipid.infer.posterior.blocks import Learnt, LogDensity
from slipid.infer.posterior.surrogate import Matrix, Surrogate

ALONG, DIFFERENTIAL, HAMILTONIAN = 0.15, 0.1, 0.75
"""Relative frequencies of coordinate walks, differential and Hamiltonian moves."""
OF_ALL = 0.85
"""Fraction of moves that change all coordinates, if groups share some."""
ALONE_SHARE = 0.5
"""Fraction of coordinate walks along a coordinate of x; others are along one of the Gaussian."""
TRAJECTORIES, LENGTH = 2, 20
"""Number of trajectories that make a Hamiltonian move, and of leapfrog steps in each."""
SHORTEST, RARITY = 0.1, 4.0
"""Ratio of the shortest to the longest leapfrog step, and power that makes short ones rare.

Short steps are for walkers in steep parts of the density, and steps of equal length resonate."""

TEMPERATURE = 1.3
"""Factor by which a density is flatter from which surrogates are learnt, for its tails."""


class Family(NamedTuple):
    """Coordinates that one move changes, in blocks that are accepted separately.

    Attributes:
        block: block of each coordinate, -1 for a coordinate that stays.
        of_term: block to which each term of the log density belongs, -1 for an unchanged term.
    """

    block: Int[np.ndarray, " size"]
    of_term: Int[np.ndarray, " term"]

    @property
    def blocks(self) -> int:
        return int(self.block.max()) + 1

    def coordinates(self, block: int) -> Int[np.ndarray, " _"]:
        """Return the indices of the coordinates of a block."""
        return np.flatnonzero(self.block == block)

    def summed(self, terms: Float[np.ndarray, "walker term"]) -> Float[np.ndarray, "walker block"]:
        """Return sums of the terms of every block."""
        each = [terms[:, self.of_term == block].sum(axis=1) for block in range(self.blocks)]
        return np.stack(each, axis=1)


def families(target: LogDensity) -> list[Family]:
    """Return the family of all coordinates, then that of the groups, if these share any."""
    everything = Family(np.zeros_like(target.group), np.zeros(target.groups + 1, int))
    known = np.unique(target.group[target.group >= 0])  # a group may have no coordinate of its own
    if not len(known) or (target.group >= 0).all():
        return [everything]
    number = np.append(np.full(target.groups, -1), -1)
    number[known] = np.arange(len(known))
    return [everything, Family(number[target.group], number)]


class Proposal(NamedTuple):
    """New vectors, and log q(old | new) - log q(new | old) of every block."""

    x: Float[np.ndarray, "walker size"]
    factor: Float[np.ndarray, "walker block"]


class FamilyMove(Move):
    """Metropolis-Hastings move of a family of coordinates."""

    halves = 1
    """Number of subsets of walkers moved in turn; 2 if a proposal uses walkers that stay fixed."""

    def __init__(self, target: LogDensity, family: Family):
        self.target, self.family = target, family

    def proposed(self, x: Matrix, still: Matrix, random: RandomState) -> Proposal:
        raise NotImplementedError

    def propose(self, model: Model, state: State) -> tuple[State, np.ndarray]:
        random, count, family = model.random, len(state.coords), self.family
        accepted = np.zeros(count, bool)
        order = random.permutation(count) if self.halves == 2 else np.arange(count)
        for mine in np.array_split(order, self.halves):
            old = state.coords[mine]
            new, factor = self.proposed(old, state.coords[np.setdiff1d(order, mine)], random)
            terms = self.target.terms(new)
            with np.errstate(invalid="ignore"):  # a place whose density is zero
                gain = family.summed(terms) - family.summed(state.blobs[mine]) + factor
            took = np.log(random.uniform(size=gain.shape)) < np.where(np.isnan(gain), -1e9, gain)
            moves = np.append(took, np.zeros((len(took), 1), bool), axis=1)  # -1: stays
            state.coords[mine] = np.where(moves[:, family.block], new, old)
            state.blobs[mine] = np.where(moves[:, family.of_term], terms, state.blobs[mine])
            state.log_prob[mine] = state.blobs[mine].sum(axis=1)
            accepted[mine] = took.any(axis=1)
        return state, accepted


class DifferentialEvolution(FamilyMove):
    """Differential evolution: steps along scaled differences of two fixed walkers.

    A fraction `whole` of the steps is an unscaled difference, which can lead from one mode to
    another. Source: ter Braak 2006, Statistics and Computing 16.
    """

    halves = 2
    whole = 0.1

    def proposed(self, x: Matrix, still: Matrix, random: RandomState) -> Proposal:
        new, count = x.copy(), len(x)
        for block in range(self.family.blocks):
            own = self.family.coordinates(block)
            first = random.randint(len(still), size=count)
            second = (first + random.randint(1, len(still), size=count)) % len(still)
            usual = 2.38 / np.sqrt(2 * len(own)) * np.exp(0.5 * random.standard_normal(count))
            scale = np.where(random.uniform(size=count) < self.whole, 1.0, usual)
            jitter = 1e-5 * still[:, own].std(axis=0) * random.standard_normal((count, len(own)))
            new[:, own] += scale[:, None] * (still[first] - still[second])[:, own] + jitter
        return Proposal(new, np.zeros((count, self.family.blocks)))


class CoordinateWalk(FamilyMove):
    """Random walk of one coordinate of every block, either of x or of the surrogate's Gaussian.

    If data only show that a parameter is small, the density of its logarithm has a plateau, which
    walks of many sizes cross.
    """

    def __init__(self, target: LogDensity, family: Family, surrogate: Surrogate):
        super().__init__(target, family)
        self.root = surrogate.root
        self.alone = np.diag(np.sqrt((self.root**2).sum(axis=1)))

    def proposed(self, x: Matrix, still: Matrix, random: RandomState) -> Proposal:
        new, rows = x.copy(), np.arange(len(x))
        for block in range(self.family.blocks):
            own = self.family.coordinates(block)
            which = random.choice(own, len(x))
            reach = 10 ** random.uniform(-0.5, 1.0, len(x)) * random.standard_normal(len(x))
            along = random.uniform(size=len(x)) < ALONE_SHARE
            step = np.where(along[:, None], self.alone[:, which].T, self.root[:, which].T)
            new[np.ix_(rows, own)] += (reach[:, None] * step)[:, own]
        return Proposal(new, np.zeros((len(x), self.family.blocks)))


class Hamiltonian(FamilyMove):
    """Some Hamiltonian trajectories along the slope of a surrogate, accepted at their end.

    The ends of trajectories are accepted or refused by the surrogate S, so that they keep its
    density exp(S), and the proposal ratio is S(old) - S(new).

    Source: Christen and Fox 2005, J. Comput. Graph. Stat. 14(4), with Hamiltonian inner moves.
    """

    def __init__(self, target: LogDensity, family: Family, surrogate: Surrogate, step: float):
        super().__init__(target, family)
        self.surrogate, self.step = surrogate, step

    def proposed(self, x: Matrix, still: Matrix, random: RandomState) -> Proposal:
        key = jax.random.key(int(random.randint(2**31)))
        found = wander(self.surrogate, x, self.family, self.step, key)
        factor = np.asarray(found.before - found.after)[:, : self.family.blocks]
        return Proposal(np.asarray(found.x), factor)


class Wandered(NamedTuple):
    """Ends of trajectories on a surrogate.

    Attributes:
        x: the ends.
        before, after: the surrogate's log density of every block at the start and at the end.
        followed: fraction of accepted trajectories.
    """

    x: Float[Array, "walker size"]
    before: Float[Array, "walker block"]
    after: Float[Array, "walker block"]
    followed: Float[Array, ""]


class _Phase(NamedTuple):
    """Position and momentum of every walker in standard coordinates, and the density there.

    Attributes:
        u: position.
        p: momentum.
        value: log density of every block.
        slope: slope of its sum.
    """

    u: Float[Array, "walker size"]
    p: Float[Array, "walker size"]
    value: Float[Array, "walker block"]
    slope: Float[Array, "walker size"]


@jax.jit
def wander(
    surrogate: Surrogate,
    x: Float[Array, "walker size"],
    family: Family,
    step: float | Float[Array, ""],
    key: Array,
    learning: float | Float[Array, ""] = 0.0,
) -> Wandered:
    """Return the ends of `TRAJECTORIES` Hamiltonian trajectories that start at x.

    Args:
        surrogate: log density, and Gaussian that scales the coordinates.
        x: start of each walker.
        family: coordinates that move, and their blocks.
        step: length of the longest leapfrog step, in standard coordinates.
        key: random key.
        learning: 1 for a density that is wider by `TEMPERATURE` and bounded by the range of
            plausible rows, from which the next surrogate is learnt; else 0.
    """
    # There are columns for as many blocks as there may be, so that families share this function.
    index = np.arange(len(surrogate.groups) + 1)
    onto, of_term = ((b[:, None] == index).astype(float) for b in map(jnp.asarray, family))
    free, used = jnp.sum(onto, axis=1), jnp.max(onto, axis=0)

    def at(u: Array, p: Array) -> _Phase:
        found = surrogate.with_slope(jnp.asarray(surrogate.centre + u @ surrogate.root.T), learning)
        cool = 1 + learning * (1 / TEMPERATURE - 1)
        value = jnp.sum(jnp.where(of_term > 0, found.value[:, :, None], 0.0), axis=1)
        return _Phase(u, p, cool * value, cool * found.slope @ surrogate.root * free)

    def trajectory(start: _Phase, key: Array) -> tuple[_Phase, Array]:
        of_momentum, of_end = jax.random.split(key)
        start = start._replace(p=jax.random.normal(of_momentum, start.u.shape) * free)

        def leap(now: _Phase, _: None) -> tuple[_Phase, None]:
            half = now.p + 0.5 * h * now.slope
            found = at(now.u + h * half, half)
            return found._replace(p=half + 0.5 * h * found.slope), None

        end, _ = jax.lax.scan(leap, start, None, length=LENGTH)
        gain = end.value - start.value + 0.5 * (start.p**2 - end.p**2) @ onto
        gain = jnp.where(jnp.isfinite(gain), gain, -jnp.inf)
        took = jnp.log(jax.random.uniform(of_end, gain.shape)) < gain
        moved = took.astype(float) @ onto.T > 0
        share = jnp.sum(jnp.minimum(1.0, jnp.exp(gain)) * used) / (jnp.sum(used) * len(x))
        u, slope = (jnp.where(moved, a, b) for a, b in ((end.u, start.u), (end.slope, start.slope)))
        return _Phase(u, end.p, jnp.where(took, end.value, start.value), slope), share

    of_step, of_trajectories = jax.random.split(key)
    rare = jax.random.uniform(of_step, (len(x), len(index))) ** RARITY
    h = step * SHORTEST**rare @ onto.T
    u = jnp.linalg.solve(surrogate.root, (x - surrogate.centre).T).T
    first = at(u, jnp.zeros_like(u))
    last, share = jax.lax.scan(trajectory, first, jax.random.split(of_trajectories, TRAJECTORIES))
    moved = free * (last.u != u).any(axis=1, keepdims=True) > 0
    ends = jnp.where(moved, surrogate.centre + last.u @ surrogate.root.T, x)
    return Wandered(ends, first.value, last.value, jnp.mean(share))


def moves(target: LogDensity, learnt: Learnt) -> list[tuple[FamilyMove, float]]:
    """Return moves with their relative frequencies."""
    of_family = families(target)
    found: list[tuple[FamilyMove, float]] = []
    shares = (OF_ALL, 1 - OF_ALL) if len(of_family) > 1 else (1.0,)
    for family, step, share in zip(of_family, learnt.step, shares, strict=True):
        found.append((CoordinateWalk(target, family, learnt.surrogate), share * ALONG))
        found.append((DifferentialEvolution(target, family), share * DIFFERENTIAL))
        follows = Hamiltonian(target, family, learnt.surrogate, float(step))
        found.append((follows, share * HAMILTONIAN))
    return found
