"""Log density and settings of a sampler, and blocks of its chain with their arrays in files."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt32

from slipid.infer.posterior.surrogate import Matrix, Surrogate
from slipid.support.extras import require

FORMAT = 10
"""Version of the block files; it must be increased if their content or the algorithm changes."""
LEAST_ROWS = 20
"""Smallest number of exact densities from which a surrogate is learnt."""
Chain = Float[np.ndarray, "ensemble step walker size"]


def require_packages() -> None:
    """Raise `MissingExtra` unless the packages are installed that sampling needs, some at its end.

    Call it before the modules of this package are imported that need them.
    """
    for module in ("arviz_base", "arviz_stats", "h5netcdf"):
        require(module, "posterior", "the posterior")


@dataclass(frozen=True, eq=False)
class LogDensity:
    """A log density that is a sum of terms, with its Gaussian (Laplace) approximation.

    There is one term per group of coordinates, then a term of the coordinates that groups share,
    which is their log prior. The term of a group is c - |y|^2 / 2 plus the log prior of its own
    coordinates, with whitened residuals y and a remainder c. The log prior is that of `prior_mean`
    and `prior_std`, and -|link (x - link_centre)|^2 / 2 in the term of the shared coordinates.

    Attributes:
        names: name of each coordinate.
        terms: function from vectors (walker, size) to the terms (walker, group + 1).
        rows: function from vectors and a group to y (walker, row) and c (walker,).
        depends: True where the residuals of a group depend on a coordinate.
        group: group of each coordinate, -1 for coordinates that groups share.
        positive: True for coordinates that are logarithms of positive parameters.
        prior_mean, prior_std: mean and std of the Gaussian prior; the std is infinite without one.
        centre, covariance: mean and covariance of the Laplace approximation.
        link: whitened residuals of a Gaussian prior that connects shared coordinates, per change
            of every coordinate.
        link_centre: vector at which they are zero.
        quotients: pairs of logarithms of which the residuals depend on the difference alone where
            both are large.
    """

    names: tuple[str, ...]
    terms: Callable[[Matrix], Matrix]
    rows: Callable[[Matrix, int], tuple[Matrix, Float[np.ndarray, " walker"]]]
    depends: Bool[np.ndarray, "group size"]
    group: Int[np.ndarray, " size"]
    positive: Bool[np.ndarray, " size"]
    prior_mean: Float[np.ndarray, " size"]
    prior_std: Float[np.ndarray, " size"]
    centre: Float[np.ndarray, " size"]
    covariance: Matrix
    link: Matrix
    link_centre: Float[np.ndarray, " size"]
    quotients: tuple[tuple[int, int], ...] = ()

    @property
    def size(self) -> int:
        return len(self.centre)

    @property
    def groups(self) -> int:
        return len(self.depends)

    def inputs(self, group: int) -> Int[np.ndarray, "2 input"]:
        """Return the coordinate of each input of a group's surrogate, and the one subtracted."""
        one = [(k, -1) for k in np.flatnonzero(self.depends[group]).tolist()]
        two = [pair for pair in self.quotients if self.depends[group, list(pair)].all()]
        return np.array([*one, *two], int).T

    def log_prob(self, x: Matrix) -> Matrix:
        """Return the log density (first column) and its terms, which emcee keeps as blobs."""
        terms = self.terms(x)
        return np.concatenate([terms.sum(axis=1, keepdims=True), terms], axis=1)


@dataclass(frozen=True)
class Plan:
    """Settings of the sampler, and its criteria of convergence.

    Attributes:
        ensembles: number of independent ensembles.
        walkers: number of walkers of each ensemble.
        block: number of steps in a block.
        warm_up: numbers of blocks after which the surrogate is learnt anew; the last number only
            ends the warm-up, since steps of Hamiltonian moves need some blocks to adapt to the
            last surrogate. A surrogate that makes the chain slow is learnt anew later, too.
        most: number of blocks after which sampling ends even without convergence.
        spread: distance from the fit up to which the first surrogate is learnt, and from which
            trajectories on it start [std]. A large distance finds modes away from the fit.
        rows: largest number of exact densities from which the first surrogate is learnt, at least
            20; surrogates of few terms need fewer, and later ones have up to four times as many.
        r_hat: upper limit of R-hat over ensembles for every coordinate.
        steps_per_tau: lower limit of steps per autocorrelation time for every coordinate.
        least_draws: lower limit of effective draws for every coordinate.
        seed: seed of all random numbers.
    """

    ensembles: int = 4
    walkers: int = 8
    block: int = 20
    warm_up: tuple[int, ...] = (1, 2, 4)
    most: int = 400
    spread: float = 2.0
    rows: int = 4500
    r_hat: float = 1.01
    steps_per_tau: float = 50.0
    least_draws: float = 1000.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.rows < LEAST_ROWS:
            raise ValueError(f"{self.rows} rows; expected at least {LEAST_ROWS}")
        if self.most <= self.warm_up[-1]:
            least = self.warm_up[-1] + 1
            raise ValueError(
                f"{self.most} blocks; expected at least {least}, more than the warm-up"
            )


@dataclass(frozen=True, eq=False)
class Learnt:
    """Surrogate that Hamiltonian moves follow, and the rows from which the next one is learnt.

    Attributes:
        surrogate: surrogate of the log density.
        step: longest leapfrog step of every family of coordinates (`proposals.families`).
        design: vectors from whose exact densities the next surrogate is learnt.
        places: ends of trajectories on the surrogate, from which the walkers of the next block
            start, so that none remains where the surrogate before was wrong.
    """

    surrogate: Surrogate
    step: Float[np.ndarray, " family"]
    design: Float[np.ndarray, "row size"]
    places: Float[np.ndarray, "ensemble walker size"]


@dataclass(frozen=True, eq=False)
class ChainBlock:
    """Consecutive steps of all ensembles, with the state from which the next block starts.

    Attributes:
        number: index of the block, from 0.
        chain: positions of all walkers.
        log_prob: log density at these positions.
        random: state of each ensemble's Mersenne twister after the block: its key, and (position,
            has_gauss, cached Gaussian) as in NumPy.
        accepted: fraction of the moves that changed a coordinate, for each ensemble.
        learnt: what was learnt after this block, None if nothing was.
    """

    number: int
    chain: Chain
    log_prob: Float[np.ndarray, "ensemble step walker"]
    random: tuple[UInt32[np.ndarray, "ensemble 624"], Float[np.ndarray, "ensemble 3"]]
    accepted: Float[np.ndarray, " ensemble"]
    learnt: Learnt | None


def packed(block: ChainBlock) -> dict[str, np.ndarray]:
    """Return the arrays of a block, keyed by their names in a file."""
    out = {
        "number": np.asarray(block.number),
        "chain": block.chain,
        "log_prob": block.log_prob,
        "random_key": block.random[0],
        "random_rest": block.random[1],
        "accepted": block.accepted,
    }
    if (learnt := block.learnt) is not None:
        leaves = jax.tree.leaves(learnt.surrogate)
        out |= {"groups": np.asarray(len(learnt.surrogate.groups))}
        out |= {name: getattr(learnt, name) for name in _LEARNT}
        out |= {f"surrogate/{k:03d}": np.asarray(leaf) for k, leaf in enumerate(leaves)}
    return out


def unpacked(arrays: Mapping[str, np.ndarray]) -> ChainBlock:
    """Return the block from the arrays that `packed` returned."""
    learnt = None
    if "groups" in arrays:
        leaves = [arrays[name] for name in sorted(arrays) if name.startswith("surrogate/")]
        surrogate = Surrogate.of_leaves(leaves, int(arrays["groups"]))
        learnt = Learnt(surrogate, **{name: arrays[name] for name in _LEARNT})
    return ChainBlock(
        number=int(arrays["number"]),
        chain=arrays["chain"],
        log_prob=arrays["log_prob"],
        random=(arrays["random_key"], arrays["random_rest"]),
        accepted=arrays["accepted"],
        learnt=learnt,
    )


_LEARNT = ("step", "design", "places")
