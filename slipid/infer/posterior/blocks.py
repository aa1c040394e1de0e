"""What is sampled and when it stops; blocks of a chain, some steps at a time, and as arrays."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt32

from slipid.infer.posterior.transport_map import (
    Matrix,
    Polynomials,
    Stage,
    Transport,
    Warp,
    gaussian,
)

FORMAT = 5
"""Version of the block files; bump it when their content or the way they are made changes."""
Chain = Float[np.ndarray, "ensemble step walker size"]


@dataclass(frozen=True, eq=False)
class LogDensity:
    """A log density, and what is known of it beforehand.

    Terms of vectors (walker, size) are (walker, group + 1), the shared one last; the slope is that
    of their sum. Coordinates have a group, -1 where groups share them; centre and covariance are of
    a Gaussian near it (Laplace). The map is what it is seen through; None for x itself.
    """

    terms: Callable[[Matrix], Matrix]
    slope: Callable[[Matrix], Matrix]
    group: Int[np.ndarray, " size"]
    centre: Float[np.ndarray, " size"]
    covariance: Matrix
    map: Transport | None = None

    def log_prob(self, x: Matrix) -> Matrix:
        """Log density and, as blobs, its terms."""
        terms = self.terms(x)
        return np.concatenate([terms.sum(axis=1, keepdims=True), terms], axis=1)

    def laplace(self) -> Transport:
        """Map of the Gaussian near it."""
        return gaussian(self.centre, self.covariance, self.group)

    def seen_by(self, map: Transport) -> "LogDensity":
        """The same distribution in other coordinates; centre and covariance are left alone."""
        count = int(self.group.max()) + 1
        onto = np.eye(count + 1)[np.where(self.group < 0, count, self.group)]

        def terms(u: Matrix) -> Matrix:
            x, log = map.placed(u)
            return np.asarray(self.terms(x) + log @ onto)

        def slope(u: Matrix) -> Matrix:
            return map.pull(u, self.slope)

        return replace(self, terms=terms, slope=slope, map=map)


@dataclass(frozen=True)
class Plan:
    """How to sample and when to stop.

    Attributes:
        ensembles, walkers: independent ensembles, and walkers of each.
        block: steps in a block.
        warm_up: numbers of blocks after which proposals are learnt; the last ends the warm-up, and
            leaves some blocks for the step of Hamiltonian moves to suit the last proposals.
        most: blocks after which sampling ends without having converged.
        spread: how far from the fit the widest walker starts, in stds; the first starts at a
            quarter of it. Wide starts find modes that the fit has not seen.
        r_hat: R-hat over ensembles that every coordinate must be below to have converged.
        steps_per_tau: steps per autocorrelation time that every coordinate must be above.
        least_draws: effective draws that every coordinate must be above.
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
            raise ValueError(f"{self.most} blocks; expected {least} or more, past the warm-up")


@dataclass(frozen=True, eq=False)
class ChainBlock:
    """Some steps of all ensembles, and all that is needed to go on.

    Attributes:
        number: of the block; the first is 0.
        chain, log_prob: positions of all walkers, and their log density.
        random: Mersenne twister keys, and (place, has Gaussian, Gaussian) of each.
        accepted: part of the moves that moved something, for each ensemble.
        map: map to the coordinates in which the next block is made.
        angle: step of the Hamiltonian moves of every family in the next block [rad].
    """

    number: int
    chain: Chain
    log_prob: Float[np.ndarray, "ensemble step walker"]
    random: tuple[UInt32[np.ndarray, "ensemble 624"], Float[np.ndarray, "ensemble 3"]]
    accepted: Float[np.ndarray, " ensemble"]
    map: Transport
    angle: Float[np.ndarray, " family"]


@dataclass(frozen=True)
class BlockStore:
    """Where blocks of an earlier call are found and where new ones go.

    `done` gives the blocks of a part that are there already. `tell` is called with the part and the
    number of steps of a block that are done.
    """

    done: Callable[[str], Sequence[ChainBlock]] = lambda part: ()
    keep: Callable[[str, ChainBlock], None] = lambda part, block: None
    tell: Callable[[str, int], None] = lambda part, steps: None


def packed(block: ChainBlock) -> dict[str, np.ndarray]:
    """Arrays of a block under their names in a file."""
    out = {
        "number": np.asarray(block.number),
        "chain": block.chain,
        "log_prob": block.log_prob,
        "random_key": block.random[0],
        "random_rest": block.random[1],
        "accepted": block.accepted,
        "angle": block.angle,
        "mean": block.map.mean,
        "last": np.stack(list(vars(block.map.last).values())),
    }
    for k, stair in enumerate(block.map.stairs):
        out |= {f"{k}/{name}": getattr(stair, name) for name in _OF_STAIR}
        if stair.bend:
            out |= {f"{k}/bend/{name}": value for name, value in vars(stair.bend).items()}
    return out


def unpacked(arrays: Mapping[str, np.ndarray]) -> ChainBlock:
    """Block from the arrays that `packed` gave."""
    stairs = []
    while f"{len(stairs)}/own" in arrays:
        k = len(stairs)
        bend = {n: arrays[f"{k}/bend/{n}"] for n in _OF_BEND if f"{k}/bend/{n}" in arrays}
        fields = {n: arrays[f"{k}/{n}"] for n in _OF_STAIR}
        stairs.append(Stage(**fields, bend=Polynomials(**bend) if bend else None))
    return ChainBlock(
        number=int(arrays["number"]),
        chain=arrays["chain"],
        log_prob=arrays["log_prob"],
        random=(arrays["random_key"], arrays["random_rest"]),
        accepted=arrays["accepted"],
        map=Transport(arrays["mean"], tuple(stairs), Warp(*arrays["last"])),
        angle=arrays["angle"],
    )


_OF_STAIR = ("own", "given", "slope", "root")
_OF_BEND = ("factors", "shift", "scale")
