"""Several independent emcee ensembles, in blocks that can be kept and gone on from.

Walkers of one ensemble know of each other, so that whether the chains agree is asked of ensembles.
During the warm-up, which is thrown away, proposals are learnt from all of them; after it nothing
changes any more. What a block holds and when sampling stops depend on blocks before it only, so
that a chain that was interrupted goes on as if it had not been.
"""

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import emcee
import numpy as np
from emcee.state import State
from jaxtyping import Float

from slipid.identify.moves import WAY, Hamiltonian, Target, moves
from slipid.identify.transport import Bend, Stair, Transport, Values, Warp, learnt

FORMAT = 2
"""Of blocks; to be raised with what they hold and with how they are made."""
Chain = Float[np.ndarray, "ensemble step walker size"]
ACCEPTED = 0.8
"""Part of Hamiltonian moves that shall be accepted; their step is adapted in the warm-up."""
FIRST_ANGLE, LEAST_ANGLE = 0.15, 0.03
"""Of a step of Hamiltonian moves [rad]."""
DRAWS_PER_EFFECTIVE = 24.0
"""Draws of the warm-up that tell as much as an independent one, about."""


@dataclass(frozen=True)
class Plan:
    """How to sample and when to stop.

    Attributes:
        ensembles, walkers: number of ensembles and of walkers of each.
        block: steps of a block.
        warm_up: number of blocks after which proposals are learnt; the last ends the warm-up, of
            which it leaves a part for the step of Hamiltonian moves to suit the last proposals.
        most: blocks after which it ends without having converged.
        spread: of the start around the fit, in stds, of the walker that starts widest; the first
            starts at a quarter of it. Wide starts find modes that the fit has not seen.
        r_hat, steps_per_tau, least_draws: converged when every coordinate has a smaller R-hat over
            ensembles, more steps per autocorrelation time, more effective draws.
        seed: of everything.
    """

    ensembles: int = 4
    walkers: int = 8
    block: int = 20
    warm_up: tuple[int, ...] = (3, 6, 10, 16, 20)
    most: int = 400
    spread: float = 4.0
    r_hat: float = 1.01
    steps_per_tau: float = 50.0
    least_draws: float = 1000.0
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Block:
    """Some steps of all ensembles, and all that is needed to go on.

    Attributes:
        number: of the block, the first is 0.
        chain: positions.
        log_prob: of them (ensemble, step, walker).
        random: Mersenne twister key (ensemble, 624), and (place, has Gaussian, Gaussian) of each.
        accepted: part of the moves that moved something, per ensemble.
        map: to the coordinates of the next block.
        angle: of a step of its Hamiltonian moves [rad].
    """

    number: int
    chain: Chain
    log_prob: np.ndarray
    random: tuple[np.ndarray, np.ndarray]
    accepted: np.ndarray
    map: Transport
    angle: float


def run(
    targets: Sequence[Target],
    plan: Plan,
    done: Sequence[Block] = (),
    tell: Callable[[int], None] = lambda steps: None,
) -> Iterator[Block]:
    """Blocks after those that are done, until `diagnose` finds them good or the plan's most.

    Args:
        targets: one per ensemble; they differ only where walkers are `apart`.
        done: all blocks from the first, to go on from.
        tell: called with the number of steps of a block that every ensemble has done.
    """
    from threadpoolctl import threadpool_limits

    blocks = list(done)
    while not _ended(blocks, plan):
        # many small matrices: threads of BLAS cost more than they bring
        with threadpool_limits(1):
            block = _block(targets, plan, blocks, tell)
        blocks.append(block)
        yield block


def _ended(blocks: list[Block], plan: Plan) -> bool:
    after = len(blocks) - plan.warm_up[-1]
    if len(blocks) >= plan.most:
        return True
    # looked at every fourth block at first, then less often: looking costs, too
    if after < 4 or after % max(4, 2 ** int(np.log2(after) - 3)):
        return False
    return diagnose(chain(blocks, plan), plan).converged


def chain(blocks: Sequence[Block], plan: Plan) -> Chain:
    """Positions after the warm-up."""
    return np.concatenate([b.chain for b in blocks[plan.warm_up[-1] :]], axis=1)


def _block(
    targets: Sequence[Target], plan: Plan, blocks: list[Block], tell: Callable[[int], None]
) -> Block:
    states, map, angle = _begin(targets, plan, blocks)
    stop, told = threading.Event(), [0] * plan.ensembles

    def ensemble(k: int) -> tuple[np.ndarray, np.ndarray, State, float, list[float]]:
        inner = targets[k].seen_by(map)
        made = moves(inner, angle)
        sampler = emcee.EnsembleSampler(
            plan.walkers,
            len(inner.centre),
            inner.log_prob,
            moves=made,
            vectorize=True,
            blobs_dtype=float,
        )
        places, log_probs, moved = [], [], 0.0
        before = states[k].coords
        for state in sampler.sample(
            states[k], iterations=plan.block, store=False, skip_initial_state_check=True
        ):
            if stop.is_set():
                break
            places.append(state.coords.copy())
            log_probs.append(state.log_prob.copy())
            moved += float((state.coords != before).any(axis=1).mean()) / plan.block
            before = places[-1]
            told[k] += 1
            tell(min(told))
        turns = [a for move, _ in made if isinstance(move, Hamiltonian) for a in move.accepted]
        return np.stack(places), np.stack(log_probs), state, moved, turns

    with ThreadPoolExecutor(min(os.cpu_count() or 1, plan.ensembles)) as pool:
        try:
            found = list(pool.map(ensemble, range(plan.ensembles)))
        finally:
            stop.set()  # an interrupt of the caller ends the others at their next step
    ends = [f[2] for f in found]
    places = np.stack([f[0] for f in found])
    x, log = map.placed(places.reshape(-1, places.shape[-1]))
    block = Block(
        number=len(blocks),
        chain=x.reshape(places.shape),
        log_prob=np.stack([f[1] for f in found]) - log.sum(axis=1).reshape(places.shape[:-1]),
        random=(
            np.stack([s.random_state[1] for s in ends]),
            np.array([s.random_state[2:] for s in ends], float),
        ),
        accepted=np.array([f[3] for f in found]),
        map=map,
        angle=angle,
    )
    turns = [a for f in found for a in f[4]]
    return _with_learnt(block, targets[0], plan, blocks, turns)


def _begin(
    targets: Sequence[Target], plan: Plan, blocks: list[Block]
) -> tuple[list[State], Transport, float]:
    """State of every ensemble in mapped coordinates, the map, and the angle."""
    if not blocks:
        map = targets[0].laplace()
        starts = [_start(t, plan, k) for k, t in enumerate(targets)]
        return [State(map.forward(x), random_state=r) for x, r in starts], map, FIRST_ANGLE
    last = blocks[-1]
    states = [
        State(
            last.map.forward(last.chain[k, -1]),
            random_state=_random_state(last.random[0][k], last.random[1][k]),
        )
        for k in range(plan.ensembles)
    ]
    return states, last.map, last.angle


def _random_state(key: np.ndarray, rest: np.ndarray) -> tuple[Any, ...]:
    return ("MT19937", key, int(rest[0]), int(rest[1]), float(rest[2]))


def _start(target: Target, plan: Plan, ensemble: int) -> tuple[np.ndarray, Any]:
    """Walkers spread wider than the fit's own uncertainty, at places with a density."""
    root = np.linalg.cholesky(target.covariance)
    wide = plan.spread * np.geomspace(0.25, 1.0, plan.walkers)[:, None]
    seeds = np.random.SeedSequence((plan.seed, ensemble))
    random = np.random.RandomState(np.random.MT19937(seeds))
    x = np.empty((plan.walkers, len(root)))
    lost = np.ones(plan.walkers, bool)
    for shrink in 0.7 ** np.arange(30):
        # all are drawn, so that what is compiled has one shape
        tried = target.centre + shrink * wide * random.standard_normal(x.shape) @ root.T
        found = np.isfinite(target.terms(tried)).all(axis=1)
        x[lost & found] = tried[lost & found]
        lost &= ~found
        if not lost.any():
            return x, random.get_state(legacy=True)
    raise ValueError("the log density is not finite anywhere near the fit")


def _with_learnt(
    block: Block, target: Target, plan: Plan, blocks: list[Block], turns: list[float]
) -> Block:
    """The block with what the warm-up has learnt for the next."""
    count = block.number + 1
    if count > plan.warm_up[-1]:
        return block
    if turns:
        angle = block.angle * np.exp(np.mean(turns) - ACCEPTED)
        block = replace(block, angle=float(np.clip(angle, LEAST_ANGLE, WAY)))
    if count in plan.warm_up[:-1]:
        recent = [b.chain for b in [*blocks, block][count // 2 :]]
        draws = np.concatenate(recent, axis=1).reshape(-1, len(target.centre))
        map = learnt(
            draws, len(draws) / DRAWS_PER_EFFECTIVE, target.covariance, target.group, target.kind
        )
        block = replace(block, map=map)
    return block


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Whether chains may be believed, per coordinate.

    Attributes:
        r_hat: rank-normalised split R-hat over ensembles (Vehtari et al. 2021).
        tau: integrated autocorrelation time [steps].
        ess: effective number of draws, the smaller of bulk and tails.
        steps: of every walker after the warm-up.
        converged: whether the plan's bars are met everywhere.
        reason: why it ended, for people; names the worst coordinate's number.
    """

    r_hat: Float[np.ndarray, " size"]
    tau: Float[np.ndarray, " size"]
    ess: Float[np.ndarray, " size"]
    steps: int
    converged: bool
    worst: int
    reason: str


def diagnose(chain: Chain, plan: Plan) -> Diagnosis:
    """Diagnosis of chains after their warm-up.

    Raises:
        ImportError: arviz-stats is not installed.
    """
    from arviz_stats.base import array_stats

    ensembles, steps, walkers, size = chain.shape
    tau = autocorrelation_time(chain)
    by_ensemble = chain.reshape(ensembles, steps * walkers, size)
    by_walker = chain.transpose(0, 2, 1, 3).reshape(ensembles * walkers, steps, size)
    r_hat = array_stats.rhat(by_ensemble, chain_axis=0, draw_axis=1, method="rank")
    ess = np.minimum(
        array_stats.ess(by_walker, chain_axis=0, draw_axis=1, method="bulk"),
        array_stats.ess(by_walker, chain_axis=0, draw_axis=1, method="tail", prob=(0.05, 0.95)),
    )
    bars = [
        (np.nan_to_num(r_hat - 1, nan=np.inf) / (plan.r_hat - 1), r_hat, "R-hat {:.4f}"),
        (plan.steps_per_tau * tau / steps, steps / tau, "{:.0f} steps per autocorrelation time"),
        (plan.least_draws / ess, ess, "{:.0f} effective draws"),
    ]
    short, values, said = max(bars, key=lambda bar: float(np.max(bar[0])))
    worst = int(np.argmax(short))
    converged = bool(short[worst] < 1)
    return Diagnosis(
        r_hat=np.asarray(r_hat),
        tau=tau,
        ess=np.asarray(ess),
        steps=steps,
        converged=converged,
        worst=worst,
        reason=said.format(values[worst]),
    )


def autocorrelation_time(chain: Chain) -> Float[np.ndarray, " size"]:
    """Integrated autocorrelation time of every coordinate [steps].

    Autocovariances are about the mean of all walkers, so that one that stands still counts as what
    it is; the window is the first with M >= 5 tau (Sokal 1996).
    """
    steps = chain.shape[1]
    about = chain - chain.mean(axis=(0, 1, 2))
    spectrum = np.abs(np.fft.rfft(about, 2 * steps, axis=1)) ** 2
    covariance = np.fft.irfft(spectrum.mean(axis=(0, 2)), axis=0)[:steps]
    # each lag has its own number of pairs
    correlation = covariance / np.arange(steps, 0, -1)[:, None]
    sums = 2 * np.cumsum(correlation / correlation[0], axis=0) - 1
    enough = np.arange(steps)[:, None] >= 5 * sums
    window = np.where(enough.any(axis=0), enough.argmax(axis=0), steps - 1)
    return np.asarray(np.maximum(sums[window, np.arange(sums.shape[1])], 1e-3))


def packed(block: Block) -> dict[str, Any]:
    """Plain arrays of a block, for a file."""
    out = {
        "number": np.asarray(block.number),
        "chain": block.chain,
        "log_prob": block.log_prob,
        "random_key": block.random[0],
        "random_rest": block.random[1],
        "accepted": block.accepted,
        "angle": np.asarray(block.angle),
        "mean": block.map.mean,
        "values": np.stack(list(vars(block.map.values).values())),
        "last": np.stack(list(vars(block.map.last).values())),
    }
    for k, stair in enumerate(block.map.stairs):
        out |= {f"{k}/{name}": getattr(stair, name) for name in _OF_STAIR}
        if stair.bend:
            out |= {f"{k}/bend/{name}": value for name, value in vars(stair.bend).items()}
    return out


def unpacked(arrays: dict[str, np.ndarray]) -> Block:
    """Block from what `packed` gave."""
    stairs = []
    while f"{len(stairs)}/own" in arrays:
        k = len(stairs)
        bend = {n: arrays[f"{k}/bend/{n}"] for n in _OF_BEND if f"{k}/bend/{n}" in arrays}
        fields = {n: arrays[f"{k}/{n}"] for n in _OF_STAIR}
        stairs.append(Stair(**fields, bend=Bend(**bend) if bend else None))
    return Block(
        number=int(arrays["number"]),
        chain=arrays["chain"],
        log_prob=arrays["log_prob"],
        random=(arrays["random_key"], arrays["random_rest"]),
        accepted=arrays["accepted"],
        map=Transport(
            arrays["mean"], Values(*arrays["values"]), tuple(stairs), Warp(*arrays["last"])
        ),
        angle=float(arrays["angle"]),
    )


_OF_STAIR = ("own", "given", "slope", "root", "plateaus")
_OF_BEND = ("factors", "shift", "scale")
