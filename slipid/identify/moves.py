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
        kind: of each coordinate; those of different kinds are moved by themselves.
        centre, covariance: of a Gaussian near it (Laplace).
        apart: every walker has a density of its own, so that all are evaluated together and in
            order, and none can be moved by what others do.
    """

    terms: Callable[[Matrix], Matrix]
    group: np.ndarray
    kind: np.ndarray
    centre: Float[np.ndarray, " size"]
    covariance: Matrix
    apart: bool = False

    @property
    def shared(self) -> np.ndarray:
        """Places of the shared coordinates."""
        return np.flatnonzero(self.group < 0)

    @property
    def count(self) -> int:
        """Number of groups."""
        return int(self.group.max()) + 1

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
class Part:
    """Some coordinates of one group, or some shared ones, and what is known of them.

    Attributes:
        own: their places.
        given: places of those they are regressed on.
        slope: of that regression (given, own).
        mixture: distribution of what it leaves.
    """

    own: np.ndarray
    given: np.ndarray
    slope: Matrix
    mixture: Mixture

    def left(self, x: Matrix) -> Matrix:
        """Own coordinates less what the others say of them."""
        return np.asarray(x[:, self.own] - x[:, self.given] @ self.slope)


@dataclass(frozen=True, eq=False)
class Family:
    """Parts that are moved together.

    Attributes:
        parts: one per group, None where a group has no such coordinates; or a single one of shared
            coordinates.
        follow: how much all other coordinates move with shared ones (own, size); None for groups.
    """

    parts: tuple[Part | None, ...]
    follow: Matrix | None


@dataclass(frozen=True, eq=False)
class Proposal:
    """What moves draw from: families, in coordinates that a warp has brought nearer to Gaussian."""

    warp: Warp
    families: tuple[Family, ...]


Known = Callable[[np.ndarray, np.ndarray], tuple[Matrix, Mixture]]
"""From own and given coordinates to the slope and the mixture of what is left."""


def _families(target: Target, known: Known, follow: Matrix) -> tuple[Family, ...]:
    """Families of every kind of coordinates, of groups and of shared ones."""

    def part(own: np.ndarray, given: np.ndarray) -> Part | None:
        places = np.flatnonzero(own), np.flatnonzero(given)
        return Part(*places, *known(*places)) if own.any() else None

    group, kind, found = target.group, target.kind, []
    shared = group < 0
    for k in np.unique(kind):
        mine = kind == k
        parts = [
            part(mine & (group == g), (shared | (group == g)) & ~(mine & (group == g)))
            for g in range(target.count)
        ]
        found.append(Family(tuple(parts), None))
        own = part(mine & shared, ~mine & shared)
        if own is not None:
            found.append(Family((own,), follow[np.isin(np.flatnonzero(shared), own.own)]))
    return tuple(f for f in found if any(f.parts))


def laplace(target: Target) -> Proposal:
    """Proposal from the Gaussian near the target, as a Student t."""
    cov, mean = target.covariance, target.centre

    def slopes(given: np.ndarray, own: np.ndarray) -> Matrix:
        if not len(given):
            return np.zeros((0, len(own)))
        return np.asarray(np.linalg.solve(cov[np.ix_(given, given)], cov[np.ix_(given, own)]))

    def known(own: np.ndarray, given: np.ndarray) -> tuple[Matrix, Mixture]:
        slope = slopes(given, own)
        left = cov[np.ix_(own, own)] - cov[np.ix_(own, given)] @ slope
        middle = mean[own] - mean[given] @ slope
        return slope, Mixture(np.ones(1), middle[None], np.linalg.cholesky(left)[None])

    follow = slopes(target.shared, np.arange(len(mean)))
    return Proposal(Warp.none(len(mean)), _families(target, known, follow))


def warped(target: Target, warp: Warp) -> Target:
    """The same distribution in other coordinates; centre and covariance are left as they are."""
    onto = np.eye(target.count + 1)[np.where(target.group < 0, target.count, target.group)]

    def terms(y: Matrix) -> Matrix:
        return np.asarray(target.terms(warp.back(y)) + warp.log_slope(y) @ onto)

    return replace(target, terms=terms)


def learnt(target: Target, draws: Matrix, parts: int, seed: int) -> Proposal:
    """Proposal from draws of an earlier part of the chains.

    Coordinates warped one by one, then Gaussian mixtures (scikit-learn) of the residuals with a
    Student t of their covariance as one more part.
    """
    from sklearn.mixture import GaussianMixture

    warp = Warp.fitted(draws)
    y = warp.forward(draws)
    about = y - y.mean(axis=0)

    def slopes(given: np.ndarray, own: np.ndarray) -> Matrix:
        if not len(given):
            return np.zeros((0, len(own)))
        return np.asarray(np.linalg.lstsq(about[:, given], about[:, own], rcond=None)[0])

    def known(own: np.ndarray, given: np.ndarray) -> tuple[Matrix, Mixture]:
        slope = slopes(given, own)
        x = y[:, own] - y[:, given] @ slope
        root = np.linalg.cholesky(np.cov(x.T).reshape(len(own), len(own)))
        middle = x.mean(axis=0)
        white = np.linalg.solve(root, (x - middle).T).T
        found = GaussianMixture(parts, random_state=seed, reg_covar=1e-4, max_iter=60)
        with warnings.catch_warnings():  # a proposal need not be the best one
            warnings.simplefilter("ignore")
            found.fit(white)
        return slope, Mixture(
            weight=np.concatenate([[STUDENT_SHARE], (1 - STUDENT_SHARE) * found.weights_]),
            mean=np.concatenate([middle[None], middle + found.means_ @ root.T]),
            root=np.concatenate([root[None], root @ np.linalg.cholesky(found.covariances_)]),
        )

    follow = slopes(target.shared, np.arange(y.shape[1]))
    return Proposal(warp, _families(target, known, follow))


class BlockMove(Move):
    """Metropolis-Hastings of a family.

    Attributes:
        halves: 2 where a proposal needs walkers that stand still, else 1.
    """

    halves = 1

    def __init__(self, target: Target, family: Family):
        self.target, self.family = target, family

    def jump(
        self, left: Matrix, still: Matrix, mixture: Mixture, random: Any
    ) -> tuple[Matrix, Float[np.ndarray, " walker"]]:
        """New residuals of a part, and log q(old | new) - log q(new | old)."""
        raise NotImplementedError

    def proposed(self, x: Matrix, still: Matrix, random: Any) -> tuple[Matrix, Matrix]:
        """New vectors, and the log factor of every part."""
        new, factors = x.copy(), np.zeros((len(x), len(self.family.parts)))
        for k, part in enumerate(self.family.parts):
            if part is None:
                continue
            old = part.left(x)
            left, factors[:, k] = self.jump(old, part.left(still), part.mixture, random)
            if self.family.follow is not None:
                new += (left - old) @ self.family.follow
            new[:, part.own] = x[:, part.own] + left - old
        if self.family.follow is not None:
            others = np.setdiff1d(self.target.shared, self.family.parts[0].own)  # type: ignore
            new[:, others] = x[:, others]
        return new, factors

    def propose(self, model: Any, state: State) -> tuple[State, np.ndarray]:
        random, count = model.random, len(state.coords)
        accepted = np.zeros(count, bool)
        order = random.permutation(count) if self.halves == 2 else np.arange(count)
        for mine in np.array_split(order, self.halves):
            still = np.setdiff1d(order, mine)
            new, factor = self.proposed(state.coords[mine], state.coords[still], random)
            log_prob, terms = model.compute_log_prob_fn(new)
            if self.family.follow is None:
                gain = terms[:, :-1] - state.blobs[mine, :-1] + factor
            else:
                gain = (log_prob - state.log_prob[mine])[:, None] + factor
            took = np.log(random.uniform(size=gain.shape)) < np.where(np.isnan(gain), -1e9, gain)
            self._take(state, mine, new, terms, took)
            accepted[mine] = took.any(axis=1)
        return state, accepted

    def _take(self, state: State, mine: Any, new: Matrix, terms: Matrix, took: np.ndarray) -> None:
        if self.family.follow is not None:
            rows = mine[took[:, 0]]
            state.coords[rows], state.blobs[rows] = new[took[:, 0]], terms[took[:, 0]]
        else:
            for g, part in enumerate(self.family.parts):
                if part is not None:
                    rows = mine[took[:, g]]
                    state.coords[np.ix_(rows, part.own)] = new[took[:, g]][:, part.own]
                    state.blobs[rows, g] = terms[took[:, g], g]
        state.log_prob[mine] = state.blobs[mine].sum(axis=1)


class Independence(BlockMove):
    """Draws that do not depend on where a walker is, from what is known of the target."""

    def jump(
        self, left: Matrix, still: Matrix, mixture: Mixture, random: Any
    ) -> tuple[Matrix, Float[np.ndarray, " walker"]]:
        drawn = mixture.draw(random, len(left))
        return drawn, mixture.log_density(left) - mixture.log_density(drawn)


class Autoregressive(BlockMove):
    """Part of the way from where a walker is towards a draw, exact for a Gaussian.

        x' = m + sqrt(1 - b^2) (x - m) + b L xi,   b between 0.1 and 1

    Source: preconditioned Crank-Nicolson, Cotter et al. 2013, Statistical Science 28, eq. 4.
    """

    def jump(
        self, left: Matrix, still: Matrix, mixture: Mixture, random: Any
    ) -> tuple[Matrix, Float[np.ndarray, " walker"]]:
        mean, root = mixture.mean[0], mixture.root[0]
        old = np.linalg.solve(root, (left - mean).T).T
        step = 10 ** random.uniform(-1, 0, (len(left), 1))
        new = np.sqrt(1 - step**2) * old + step * random.standard_normal(left.shape)
        return mean + new @ root.T, 0.5 * (new**2 - old**2).sum(axis=1)


class Differential(BlockMove):
    """Differential evolution: differences of walkers that stand still, at times whole ones.

    Source: ter Braak 2006, Statistics and Computing 16; whole differences lead from mode to mode.
    """

    halves = 2
    whole = 0.1

    def jump(
        self, left: Matrix, still: Matrix, mixture: Mixture, random: Any
    ) -> tuple[Matrix, Float[np.ndarray, " walker"]]:
        count, size = left.shape
        first = random.randint(len(still), size=count)
        second = (first + random.randint(1, len(still), size=count)) % len(still)
        usual = 2.38 / np.sqrt(2 * size) * np.exp(0.5 * random.standard_normal(count))
        scale = np.where(random.uniform(size=count) < self.whole, 1.0, usual)
        jitter = 1e-5 * still.std(axis=0) * random.standard_normal((count, size))
        return left + scale[:, None] * (still[first] - still[second]) + jitter, np.zeros(count)


def moves(target: Target, proposal: Proposal) -> list[tuple[Move, float]]:
    """Moves and how often each is made."""
    kinds: list[tuple[type[BlockMove], float]] = [(Independence, 0.5), (Autoregressive, 0.3)]
    if not target.apart:
        kinds.append((Differential, 0.2))
    return [(kind(target, f), share) for kind, share in kinds for f in proposal.families]
