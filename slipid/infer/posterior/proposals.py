"""Moves of an ensemble of walkers in coordinates in which its target is nearly Gaussian.

A target's log density is a sum of one term per group of coordinates, given the coordinates that
groups share, and a term of the shared coordinates. Moves are made in the coordinates of
`transport_map`. A move changes either all groups in one evaluation, where each group is accepted or
rejected by its own term, or the shared coordinates, while the mapped coordinates of groups stay
fixed.
Independence moves and differential evolution are efficient where the map makes the density nearly
Gaussian. Hamiltonian moves, which follow the gradient, are also efficient where it does not. Walks
along single coordinates cross plateaus of the density.
"""

from dataclasses import dataclass

import numpy as np
from emcee.model import Model
from emcee.moves import Move
from emcee.state import State
from jaxtyping import Float, Int
from numpy.random import RandomState
from scipy.special import gammaln

from slipid.infer.posterior.blocks import LogDensity
from slipid.infer.posterior.transport_map import Matrix

STUDENT = 0.2
"""Fraction of independence moves drawn from a Student t instead of a Gaussian, for the tails."""
DEGREES = 8.0
"""Degrees of freedom of the Student t of independence moves."""
QUARTER_TURN = 0.5 * np.pi
"""Length of a Hamiltonian move [rad], after which a Gaussian target gives an independent draw."""
MOST_STEPS, SHORTEST = 12, 0.2
"""Largest number of steps of a Hamiltonian move, and ratio of the shortest to the longest step."""
ALONG, INDEPENDENT, DIFFERENTIAL, HAMILTONIAN = 0.4, 1.2, 0.1, 0.8
"""Relative frequencies of coordinate walks, independence, differential and Hamiltonian moves.

A Hamiltonian move takes six times longer, but it moves walkers away from where the map is wrong.
"""
ALONE_SHARE = 0.5
"""Fraction of coordinate walks that leave all other coordinates of x, not of u, unchanged."""
_FINITE = 1e100
"""Bound of the changes of momentum, so that their squares are finite."""
STEEPEST = 50.0
"""Largest change of momentum in a Hamiltonian step.

Without this limit, walkers in steep tails could move very far away."""


@dataclass(frozen=True)
class Family:
    """Coordinates that one move changes together.

    Attributes:
        places: indices of the coordinates, one array per group.
        groups: group of each array, None if the family is the shared coordinates.
    """

    places: tuple[Int[np.ndarray, " _"], ...]
    groups: tuple[int, ...] | None


def families(target: LogDensity) -> list[Family]:
    """Return the family of all groups, then that of the shared coordinates, if there are any."""
    groups = tuple(int(g) for g in np.unique(target.group) if g >= 0)
    places = tuple(np.flatnonzero(target.group == g) for g in groups)
    shared = np.flatnonzero(target.group < 0)
    found = [Family(places, groups)] if groups else []
    return [*found, Family((shared,), None)] if len(shared) else found


Jump = tuple[Matrix, Float[np.ndarray, " walker"]]
"""New coordinates, and log q(old | new) - log q(new | old) with q the density of proposals."""


class FamilyMove(Move):
    """Metropolis-Hastings move of a family of coordinates.

    Attributes:
        family: the coordinates.
        accepted: fraction of accepted changes in every step.
    """

    halves = 1
    """Number of subsets of walkers moved in turn; 2 if a proposal uses walkers that stay fixed."""

    def __init__(self, family: Family):
        self.family = family
        self.accepted: list[float] = []

    def jump(self, old: Matrix, still: Matrix, random: RandomState) -> Jump:
        raise NotImplementedError

    def proposed(self, x: Matrix, still: Matrix, random: RandomState) -> tuple[Matrix, Matrix]:
        """Return new vectors, and the log proposal ratio of each group or of the shared part."""
        new, factor = x.copy(), np.empty((len(x), len(self.family.places)))
        for k, own in enumerate(self.family.places):
            new[:, own], factor[:, k] = self.jump(x[:, own], still[:, own], random)
        return new, factor

    def propose(self, model: Model, state: State) -> tuple[State, np.ndarray]:
        random, count = model.random, len(state.coords)
        accepted, taken = np.zeros(count, bool), []
        order = random.permutation(count) if self.halves == 2 else np.arange(count)
        for mine in np.array_split(order, self.halves):
            still = state.coords[np.setdiff1d(order, mine)]
            new, factor = self.proposed(state.coords[mine], still, random)
            log_prob, terms = model.compute_log_prob_fn(new)
            if self.family.groups is None:
                gain = (log_prob - state.log_prob[mine])[:, None] + factor
            else:
                own_terms = list(self.family.groups)
                gain = terms[:, own_terms] - state.blobs[mine][:, own_terms] + factor
            took = np.log(random.uniform(size=gain.shape)) < np.where(np.isnan(gain), -1e9, gain)
            for k, own in enumerate(self.family.places):
                rows = mine[took[:, k]]
                state.coords[np.ix_(rows, own)] = new[took[:, k]][:, own]
                of = slice(None) if self.family.groups is None else self.family.groups[k]
                state.blobs[rows, of] = terms[took[:, k], of]
            state.log_prob[mine] = state.blobs[mine].sum(axis=1)
            accepted[mine] = took.any(axis=1)
            taken.append(took.mean())
        self.accepted.append(float(np.mean(taken)))
        return state, accepted


class Independence(FamilyMove):
    """Proposals that do not depend on a walker's position: a mixture of Gaussian and Student t."""

    def jump(self, old: Matrix, still: Matrix, random: RandomState) -> Jump:
        count = len(old)
        new = random.standard_normal(old.shape)
        stretch = np.sqrt(DEGREES / random.chisquare(DEGREES, count))
        new *= np.where(random.uniform(size=count) < STUDENT, stretch, 1.0)[:, None]
        return new, _log_density(old) - _log_density(new)


def _log_density(u: Matrix) -> Float[np.ndarray, " walker"]:
    """Return the log density of independence proposals, up to a constant."""
    size, q = u.shape[1], (u**2).sum(axis=1)
    of_t = gammaln(0.5 * (DEGREES + size)) - gammaln(0.5 * DEGREES)
    of_t -= 0.5 * size * np.log(DEGREES / 2)  # without the factor 2 pi of the Gaussian
    of_t -= 0.5 * (DEGREES + size) * np.log1p(q / DEGREES)
    return np.asarray(np.logaddexp(np.log(1 - STUDENT) - 0.5 * q, np.log(STUDENT) + of_t))


class DifferentialEvolution(FamilyMove):
    """Differential evolution: steps along scaled differences of two fixed walkers.

    A fraction `whole` of the steps is an unscaled difference, which can lead from one mode to
    another. Source: ter Braak 2006, Statistics and Computing 16.
    """

    halves = 2
    whole = 0.1

    def jump(self, old: Matrix, still: Matrix, random: RandomState) -> Jump:
        count, size = old.shape
        first = random.randint(len(still), size=count)
        second = (first + random.randint(1, len(still), size=count)) % len(still)
        usual = 2.38 / np.sqrt(2 * size) * np.exp(0.5 * random.standard_normal(count))
        scale = np.where(random.uniform(size=count) < self.whole, 1.0, usual)
        jitter = 1e-5 * still.std(axis=0) * random.standard_normal((count, size))
        return old + scale[:, None] * (still[first] - still[second]) + jitter, np.zeros(count)


class CoordinateWalk(FamilyMove):
    """Random walk of one coordinate of x in each group, or of one shared coordinate.

    If data only show that a parameter is small, the density of its logarithm has a plateau. No map
    makes this density Gaussian, but the walk crosses the plateau. Either all other coordinates of x
    stay fixed, or all other coordinates of u; in the second case the map changes x.
    """

    def __init__(self, target: LogDensity, groups: tuple[int, ...] | None):
        assert target.map, "the target needs mapped coordinates"
        everything = np.arange(len(target.group))
        of_group = [np.flatnonzero(target.group == g) for g in groups or ()]
        super().__init__(Family(tuple(of_group or [everything]), groups))
        self.map = target.map
        self.mine = tuple(of_group or [np.flatnonzero(target.group < 0)])
        self.std = np.sqrt(np.diag(target.covariance))

    def proposed(self, u: Matrix, still: Matrix, random: RandomState) -> tuple[Matrix, Matrix]:
        rows = np.arange(len(u))
        x, before = self.map.placed(u)
        moved = np.zeros(u.shape, bool)
        for mine in self.mine:
            which = random.choice(mine, len(u))
            reach = 10 ** random.uniform(-0.5, 1.0, len(u)) * self.std[which]
            x[rows, which] += reach * random.standard_normal(len(u))
            moved[rows, which] = True
        moved |= random.uniform(size=(len(u), 1)) < ALONE_SHARE
        new = np.where(moved, self.map.forward(x), u)
        change = np.where(moved, before - self.map.placed(new)[1], 0.0)
        return new, np.stack([change[:, own].sum(axis=1) for own in self.family.places], axis=1)


class Hamiltonian(FamilyMove):
    """Hamiltonian moves whose steps are exact for a standard Gaussian.

    A step rotates position u and momentum p, and changes p by the rest of the gradient of the log
    density l:

        turn (u, p) by h/2;    p += h (dl/du + u);    turn (u, p) by h/2

    Groups are independent while the shared coordinates are fixed, so that each group has a
    trajectory of its own, which is accepted or rejected separately. If a slope on a walker's
    trajectory is not finite, all groups of the walker return to their start, as any group may be
    the cause.

    Source: Beskos et al. 2011, Stochastic Processes and their Applications 121, section 4.
    """

    def __init__(self, target: LogDensity, family: Family, angle: float):
        super().__init__(family)
        self.target, self.angle = target, angle

    def proposed(self, x: Matrix, still: Matrix, random: RandomState) -> tuple[Matrix, Matrix]:
        count, places = len(x), self.family.places
        # Some moves have more and shorter steps, for walkers in steep parts of the density.
        h = self.angle * SHORTEST ** (random.uniform() ** 3)
        steps = int(np.clip(random.uniform(0.7, 1.3) * QUARTER_TURN / h + 0.5, 1, MOST_STEPS))
        h *= random.uniform(0.8, 1.0, (count, 1))
        u, start, lost = x.copy(), np.zeros(x.shape), np.zeros(count, bool)
        own = np.concatenate(places)
        start[:, own] = random.standard_normal((count, len(own)))
        p = start.copy()
        u[:, own], p[:, own] = _turn(u[:, own], p[:, own], h / 2)
        for step in range(steps):
            slope = self.target.slope(u)
            lost |= ~np.isfinite(slope).all(axis=1)
            for place in places:
                p[:, place] += h * _bounded(np.where(lost[:, None], 0.0, slope + u)[:, place])
            u[:, own], p[:, own] = _turn(u[:, own], p[:, own], h if step < steps - 1 else h / 2)
        factor = np.stack([_energy(start[:, k]) - _energy(p[:, k]) for k in places], axis=1)
        return u, np.where(lost[:, None], -np.inf, factor)


def _bounded(kick: Matrix) -> Matrix:
    """Return changes of momentum of one group, reduced to a length of at most `STEEPEST`."""
    most = np.linalg.norm(np.clip(kick, -_FINITE, _FINITE), axis=1, keepdims=True) / STEEPEST
    return kick / np.maximum(most, 1.0)


def _energy(p: Matrix) -> Float[np.ndarray, " walker"]:
    """Return the kinetic energy of one group's momenta."""
    return np.asarray(0.5 * (p**2).sum(axis=1))


def _turn(u: Matrix, p: Matrix, angle: Matrix) -> tuple[Matrix, Matrix]:
    c, s = np.cos(angle), np.sin(angle)
    return c * u + s * p, c * p - s * u


def moves(target: LogDensity, angles: Float[np.ndarray, " family"]) -> list[tuple[Move, float]]:
    """Return moves in the target's coordinates with their relative frequencies.

    `angles` holds the step of the Hamiltonian moves of each family [rad].
    """
    of_family = families(target)
    found: list[tuple[Move, float]] = []
    for family, angle in zip(of_family, angles, strict=True):
        found.append((CoordinateWalk(target, family.groups), ALONG))
        found.append((Independence(family), INDEPENDENT / len(of_family)))
        found.append((DifferentialEvolution(family), DIFFERENTIAL / len(of_family)))
        found.append((Hamiltonian(target, family, float(angle)), HAMILTONIAN / len(of_family)))
    return found
