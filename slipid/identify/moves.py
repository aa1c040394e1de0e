"""Moves of an ensemble of walkers that know which coordinates depend on each other.

A target's log density is a sum of one term per group of coordinates, given those that groups share,
and a term of the shared ones. All groups are moved in one evaluation, each accepted or not by its
own term. Shared coordinates are moved with the residuals

    e_g = x_g - B_g x_shared

held, so that groups follow them; where the density is Gaussian and B its regression, every proposal
of the independence moves is accepted. Differential evolution (ter Braak 2006) does what they cannot
where the density is far from what they know.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from emcee.moves import Move
from emcee.state import State
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.special import gammaln, logsumexp

Matrix = Float[np.ndarray, "_ _"]
Matrices = Float[np.ndarray, "..."]
STUDENT_SHARE = 0.2
"""Part of the draws of a learnt proposal that come from a Student t."""
DEGREES = 8.0
"""Of that Student t."""


@dataclass(frozen=True, eq=False)
class Target:
    """A log density, and what is known of it beforehand.

    Attributes:
        terms: of vectors (walker, size) the terms (walker, group + 1), shared term last.
        group: of each coordinate, -1 where groups share it.
        centre, covariance: of a Gaussian near it (Laplace).
        apart: every walker has a density of its own, so that all are evaluated together and in
            order, and none can be moved by what others do.
    """

    terms: Callable[[Matrix], Matrix]
    group: np.ndarray
    centre: Float[np.ndarray, " size"]
    covariance: Matrix
    apart: bool = False

    @property
    def shared(self) -> np.ndarray:
        """Places of the shared coordinates."""
        return np.flatnonzero(self.group < 0)

    @property
    def groups(self) -> list[np.ndarray]:
        """Places of every group's coordinates, some may be empty."""
        return [np.flatnonzero(self.group == g) for g in range(int(self.group.max()) + 1)]

    def log_prob(self, x: Matrix) -> Matrix:
        """Log density and, as blobs, its terms."""
        terms = self.terms(x)
        return np.concatenate([terms.sum(axis=1, keepdims=True), terms], axis=1)


@dataclass(frozen=True, eq=False)
class Warp:
    """Sinh-arcsinh map of every coordinate to one that is nearer to a Gaussian.

        y = sinh(tail arcsinh((x - place) / scale) - skew)

    Source: Jones and Pewsey 2009, Biometrika 96, eq. 2.
    """

    place: Float[np.ndarray, " size"]
    scale: Float[np.ndarray, " size"]
    skew: Float[np.ndarray, " size"]
    tail: Float[np.ndarray, " size"]

    def forward(self, x: Matrices) -> Matrices:
        return np.sinh(self.tail * np.arcsinh((x - self.place) / self.scale) - self.skew)

    def back(self, y: Matrices) -> Matrices:
        return self.place + self.scale * np.sinh((np.arcsinh(y) + self.skew) / self.tail)

    def log_slope(self, y: Matrices) -> Matrices:
        """Log dx/dy of every coordinate."""
        inner = (np.arcsinh(y) + self.skew) / self.tail
        # cosh without overflow
        cosh = np.abs(inner) + np.log1p(np.exp(-2 * np.abs(inner))) - np.log(2)
        return np.log(self.scale / self.tail) + cosh - 0.5 * np.log1p(y**2)

    @staticmethod
    def none(size: int) -> "Warp":
        one, zero = np.ones(size), np.zeros(size)
        return Warp(zero, one, zero, one)

    @staticmethod
    def fitted(draws: Matrix, most: int = 2000) -> "Warp":
        """Maximum likelihood, column by column."""
        some = draws[:: max(1, len(draws) // most)]
        return Warp(*np.array([_sinh_arcsinh(column) for column in some.T]).T)


def _sinh_arcsinh(x: Float[np.ndarray, " draw"]) -> tuple[float, float, float, float]:
    middle, width = float(np.median(x)), float(x.std())
    t = (x - middle) / width

    def loss(q: np.ndarray) -> float:
        inner = np.arcsinh((t - q[0]) / np.exp(q[1]))
        y = np.exp(q[3]) * inner - q[2]
        density = -0.5 * np.sinh(y) ** 2 + np.log(np.cosh(y)) + q[3] - q[1]
        spread = np.mean(density - 0.5 * np.log1p(((t - q[0]) / np.exp(q[1])) ** 2))
        return float(-spread + 1e-3 * (q @ q))

    with np.errstate(over="ignore"):
        q = minimize(loss, np.zeros(4), method="BFGS").x
    return middle + width * q[0], width * float(np.exp(q[1])), q[2], float(np.exp(q[3]))


@dataclass(frozen=True, eq=False)
class Mixture:
    """Mixture of a Student t (the first part) and Gaussians.

    Attributes:
        weight: of each part.
        mean: (part, size).
        root: Cholesky factors of the parts' scale matrices (part, size, size).
    """

    weight: Float[np.ndarray, " part"]
    mean: Matrix
    root: Float[np.ndarray, "part size size"]

    def draw(self, random: np.random.RandomState, count: int) -> Matrix:
        part = random.choice(len(self.weight), count, p=self.weight)
        normal = random.standard_normal((count, self.mean.shape[1]))
        stretch = np.sqrt(DEGREES / random.chisquare(DEGREES, count))
        normal *= np.where(part == 0, stretch, 1.0)[:, None]
        return np.asarray(self.mean[part] + np.einsum("nij,nj->ni", self.root[part], normal))

    def log_density(self, x: Matrix) -> Float[np.ndarray, " row"]:
        size, out = x.shape[1], []
        for k, (weight, mean, root) in enumerate(
            zip(self.weight, self.mean, self.root, strict=True)
        ):
            q = (np.linalg.solve(root, (x - mean).T) ** 2).sum(axis=0)
            scale = np.log(weight) - np.log(np.diag(root)).sum()
            if k == 0:
                scale += gammaln(0.5 * (DEGREES + size)) - gammaln(0.5 * DEGREES)
                scale -= 0.5 * size * np.log(DEGREES / 2)  # less the Gaussian's 2 pi
                out.append(scale - 0.5 * (DEGREES + size) * np.log1p(q / DEGREES))
            else:
                out.append(scale - 0.5 * q)
        return np.asarray(logsumexp(out, axis=0))


@dataclass(frozen=True, eq=False)
class Proposal:
    """What independence moves draw from.

    Attributes:
        warp: to the coordinates in which all the rest holds.
        slope: B (shared, size), of which columns of shared coordinates are not used.
        parts: of the residuals of each group, then of the shared coordinates; None where empty.
    """

    warp: Warp
    slope: Matrix
    parts: tuple[Mixture | None, ...]


def laplace(target: Target) -> Proposal:
    """Proposal from the Gaussian near the target, as a Student t."""
    shared, cov = target.shared, target.covariance
    slope = np.zeros((len(shared), len(cov)))
    if len(shared):
        slope = np.linalg.solve(cov[np.ix_(shared, shared)], cov[shared])
    left = cov - cov[:, shared] @ slope
    residual = target.centre - target.centre[shared] @ slope

    def student(at: np.ndarray, mean: np.ndarray, cov: Matrix) -> Mixture | None:
        if not len(at):
            return None
        return Mixture(np.ones(1), mean[at][None], np.linalg.cholesky(cov[np.ix_(at, at)])[None])

    parts = [student(g, residual, left) for g in target.groups]
    return Proposal(Warp.none(len(cov)), slope, (*parts, student(shared, target.centre, cov)))


def warped(target: Target, warp: Warp) -> Target:
    """The same distribution in other coordinates; centre and covariance are left as they are."""
    count = int(target.group.max()) + 1
    onto = np.eye(count + 1)[np.where(target.group < 0, count, target.group)]

    def terms(y: Matrix) -> Matrix:
        return np.asarray(target.terms(warp.back(y)) + warp.log_slope(y) @ onto)

    return replace(target, terms=terms)


def learnt(target: Target, draws: Matrix, parts: int, seed: int) -> Proposal:
    """Proposal from draws of an earlier part of the chains.

    Coordinates warped one by one, then Gaussian mixtures (scikit-learn) of the residuals with a
    Student t of their covariance as one more part.
    """
    from sklearn.mixture import GaussianMixture

    warp, shared = Warp.fitted(draws), target.shared
    draws = warp.forward(draws)
    slope = np.zeros((len(shared), draws.shape[1]))
    if len(shared):
        about = draws - draws.mean(axis=0)
        slope = np.linalg.lstsq(about[:, shared], about, rcond=None)[0]

    def mixture(at: np.ndarray, x: Matrix) -> Mixture | None:
        if not len(at):
            return None
        x = x[:, at]
        root = np.linalg.cholesky(np.cov(x.T).reshape(len(at), len(at)))
        middle = x.mean(axis=0)
        white = np.linalg.solve(root, (x - middle).T).T
        found = GaussianMixture(parts, random_state=seed, reg_covar=1e-4, max_iter=60)
        with warnings.catch_warnings():  # a proposal need not be the best one
            warnings.simplefilter("ignore")
            found.fit(white)
        return Mixture(
            weight=np.concatenate([[STUDENT_SHARE], (1 - STUDENT_SHARE) * found.weights_]),
            mean=np.concatenate([middle[None], middle + found.means_ @ root.T]),
            root=np.concatenate([root[None], root @ np.linalg.cholesky(found.covariances_)]),
        )

    residual = draws - draws[:, shared] @ slope
    blocks = [mixture(g, residual) for g in target.groups]
    return Proposal(warp, slope, (*blocks, mixture(shared, draws)))


class BlockMove(Move):
    """Metropolis-Hastings of all groups at once, or of the shared coordinates.

    Attributes:
        halves: 2 where a proposal needs walkers that stand still, else 1.
    """

    halves = 1

    def __init__(self, target: Target, proposal: Proposal, of_groups: bool):
        self.target, self.proposal, self.of_groups = target, proposal, of_groups

    def proposed(self, x: Matrix, still: Matrix, random: Any) -> tuple[Matrix, Matrix]:
        """Vectors, and log q(x | new) - log q(new | x) of every group, or of the shared ones."""
        raise NotImplementedError

    def propose(self, model: Any, state: State) -> tuple[State, np.ndarray]:
        random, count = model.random, len(state.coords)
        accepted = np.zeros(count, bool)
        order = random.permutation(count) if self.halves == 2 else np.arange(count)
        for mine in np.array_split(order, self.halves):
            still = np.setdiff1d(order, mine)
            new, factor = self.proposed(state.coords[mine], state.coords[still], random)
            log_prob, terms = model.compute_log_prob_fn(new)
            if self.of_groups:
                gain = terms[:, :-1] - state.blobs[mine, :-1] + factor
            else:
                gain = (log_prob - state.log_prob[mine])[:, None] + factor
            took = np.log(random.uniform(size=gain.shape)) < np.where(np.isnan(gain), -1e9, gain)
            self._take(state, mine, new, terms, took)
            accepted[mine] = took.any(axis=1)
        return state, accepted

    def _take(self, state: State, mine: Any, new: Matrix, terms: Matrix, took: np.ndarray) -> None:
        if not self.of_groups:
            rows = mine[took[:, 0]]
            state.coords[rows], state.blobs[rows] = new[took[:, 0]], terms[took[:, 0]]
        else:
            for g, at in enumerate(self.target.groups):
                rows = mine[took[:, g]]
                state.coords[np.ix_(rows, at)] = new[took[:, g]][:, at]
                state.blobs[rows, g] = terms[took[:, g], g]
        state.log_prob[mine] = state.blobs[mine].sum(axis=1)

    def follow(self, x: Matrix, shared: Matrix) -> Matrix:
        """Vectors with new shared coordinates and the old residuals."""
        at = self.target.shared
        new = x + (shared - x[:, at]) @ self.proposal.slope
        new[:, at] = shared
        return new


class Independence(BlockMove):
    """Draws that do not depend on where a walker is, from what is known of the target."""

    def proposed(self, x: Matrix, still: Matrix, random: Any) -> tuple[Matrix, Matrix]:
        at, slope = self.target.shared, self.proposal.slope
        if not self.of_groups:
            mixture = self.proposal.parts[-1]
            assert mixture is not None
            drawn = mixture.draw(random, len(x))
            factor = mixture.log_density(x[:, at]) - mixture.log_density(drawn)
            return self.follow(x, drawn), factor[:, None]
        new, base = x.copy(), x[:, at] @ slope
        groups = self.target.groups
        factor = np.zeros((len(x), len(groups)))
        for g, (own, mixture) in enumerate(zip(groups, self.proposal.parts, strict=False)):
            if mixture is None:
                continue
            drawn = mixture.draw(random, len(x))
            new[:, own] = base[:, own] + drawn
            old = x[:, own] - base[:, own]
            factor[:, g] = mixture.log_density(old) - mixture.log_density(drawn)
        return new, factor


class Differential(BlockMove):
    """Differential evolution: differences of walkers that stand still, at times whole ones.

    Source: ter Braak 2006, Statistics and Computing 16; whole differences lead from mode to mode.
    """

    halves = 2
    whole = 0.1

    def proposed(self, x: Matrix, still: Matrix, random: Any) -> tuple[Matrix, Matrix]:
        groups, at = self.target.groups, self.target.shared
        if self.of_groups:
            new = x.copy()
            for own in groups:
                if len(own):
                    new[:, own] += self._differences(still[:, own], len(x), random)
            return new, np.zeros((len(x), len(groups)))
        moved = x[:, at] + self._differences(still[:, at], len(x), random)
        return self.follow(x, moved), np.zeros((len(x), 1))

    def _differences(self, still: Matrix, count: int, random: Any) -> Matrix:
        size = still.shape[1]
        first = random.randint(len(still), size=count)
        second = (first + random.randint(1, len(still), size=count)) % len(still)
        usual = 2.38 / np.sqrt(2 * size) * np.exp(0.5 * random.standard_normal(count))
        scale = np.where(random.uniform(size=count) < self.whole, 1.0, usual)
        jitter = 1e-5 * still.std(axis=0) * random.standard_normal((count, size))
        return np.asarray(scale[:, None] * (still[first] - still[second]) + jitter)


def moves(target: Target, proposal: Proposal) -> list[tuple[Move, float]]:
    """Moves and how often each is made."""
    kinds: list[tuple[type[BlockMove], float]] = [(Independence, 0.75), (Differential, 0.25)]
    if target.apart:
        kinds = [(Independence, 1.0)]
    both = [len(target.shared) > 0, any(len(g) for g in target.groups)]
    return [
        (kind(target, proposal, of_groups), share / sum(both))
        for kind, share in kinds
        for there, of_groups in zip(both, (False, True), strict=True)
        if there
    ]
