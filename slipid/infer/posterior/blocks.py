"""Log density and settings of a sampler, and blocks of its chain with their arrays in files."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt32

from slipid.infer.posterior.transport_map import Matrix, Transport, Warp, gaussian
from slipid.support.extras import require

FORMAT = 6
"""Version of the block files; it must be increased if their content or the algorithm changes."""
Chain = Float[np.ndarray, "ensemble step walker size"]


def require_packages() -> None:
    """Raise `MissingExtra` unless the packages are installed that sampling needs, some at its end.

    Call it before the modules of this package are imported that need them.
    """
    for module in ("emcee", "arviz_base", "arviz_stats", "h5netcdf"):
        require(module, "posterior", "the posterior")


@dataclass(frozen=True, eq=False)
class LogDensity:
    """A log density that is a sum of terms, with its Gaussian (Laplace) approximation.

    Attributes:
        terms: function from vectors (walker, size) to the terms of the log density (walker,
            group + 1): one per group, then the term of the shared coordinates.
        slope: function from vectors to the gradient of the sum of the terms.
        group: group of each coordinate, -1 for coordinates that groups share.
        centre: mean of the Gaussian.
        covariance: covariance of the Gaussian.
        map: map to the coordinates u of which `terms` and `slope` are functions; None if they are
            functions of x.
    """

    terms: Callable[[Matrix], Matrix]
    slope: Callable[[Matrix], Matrix]
    group: Int[np.ndarray, " size"]
    centre: Float[np.ndarray, " size"]
    covariance: Matrix
    map: Transport | None = None

    def log_prob(self, x: Matrix) -> Matrix:
        """Return the log density (first column) and its terms, which emcee keeps as blobs."""
        terms = self.terms(x)
        return np.concatenate([terms.sum(axis=1, keepdims=True), terms], axis=1)

    def laplace(self) -> Transport:
        """Return the map of the Gaussian approximation."""
        return gaussian(self.centre, self.covariance, self.group)

    def in_coordinates(self, map: Transport) -> "LogDensity":
        """Return the same distribution as a density of mapped coordinates u.

        Centre and covariance remain those of x.
        """
        count = int(self.group.max()) + 1
        onto = np.eye(count + 1)[np.where(self.group < 0, count, self.group)]

        def terms(u: Matrix) -> Matrix:
            x, log = map.placed(u)
            return np.asarray(self.terms(x) + log @ onto)

        def slope(u: Matrix) -> Matrix:
            return map.pulled_back(u, self.slope)

        return replace(self, terms=terms, slope=slope, map=map)


@dataclass(frozen=True)
class Plan:
    """Settings of the sampler, and its criteria of convergence.

    Attributes:
        ensembles: number of independent ensembles.
        walkers: number of walkers of each ensemble.
        block: number of steps in a block.
        warm_up: numbers of blocks after which proposals are learnt; the last number only ends the
            warm-up, since the step of Hamiltonian moves needs some blocks to adapt to the last
            proposals.
        most: number of blocks after which sampling ends even without convergence.
        spread: distance of the widest walker's start from the fit [std]; the first walker starts
            at a quarter of this distance. Wide starts find modes away from the fit.
        r_hat: upper limit of R-hat over ensembles for every coordinate.
        steps_per_tau: lower limit of steps per autocorrelation time for every coordinate.
        least_draws: lower limit of effective draws for every coordinate.
        seed: seed of all random numbers.
    """

    ensembles: int = 4
    walkers: int = 8
    block: int = 20
    warm_up: tuple[int, ...] = (3, 6, 10, 16, 24, 34, 36)
    most: int = 400
    spread: float = 4.0
    r_hat: float = 1.01
    steps_per_tau: float = 50.0
    least_draws: float = 1000.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.most <= self.warm_up[-1]:
            least = self.warm_up[-1] + 1
            raise ValueError(
                f"{self.most} blocks; expected at least {least}, more than the warm-up"
            )


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
        map: map to the coordinates of the next block.
        angle: step of the Hamiltonian moves in the next block, one per family of coordinates
            (`proposals.families`) [rad].
    """

    number: int
    chain: Chain
    log_prob: Float[np.ndarray, "ensemble step walker"]
    random: tuple[UInt32[np.ndarray, "ensemble 624"], Float[np.ndarray, "ensemble 3"]]
    accepted: Float[np.ndarray, " ensemble"]
    map: Transport
    angle: Float[np.ndarray, " family"]


def packed(block: ChainBlock) -> dict[str, np.ndarray]:
    """Return the arrays of a block, keyed by their names in a file."""
    return {
        "number": np.asarray(block.number),
        "chain": block.chain,
        "log_prob": block.log_prob,
        "random_key": block.random[0],
        "random_rest": block.random[1],
        "accepted": block.accepted,
        "angle": block.angle,
        "last": np.stack(list(vars(block.map.last).values())),
        **{f"map/{name}": np.asarray(getattr(block.map, name)) for name in _MAP_FIELDS},
    }


def unpacked(arrays: Mapping[str, np.ndarray]) -> ChainBlock:
    """Return the block from the arrays that `packed` returned."""
    fields = {name: arrays[f"map/{name}"] for name in _MAP_FIELDS}
    return ChainBlock(
        number=int(arrays["number"]),
        chain=arrays["chain"],
        log_prob=arrays["log_prob"],
        random=(arrays["random_key"], arrays["random_rest"]),
        accepted=arrays["accepted"],
        map=Transport(last=Warp(*arrays["last"]), **fields),
        angle=arrays["angle"],
    )


_MAP_FIELDS = ("mean", "order", "slope", "root", "factors", "shift", "scale")
