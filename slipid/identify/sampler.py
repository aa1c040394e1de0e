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
from dataclasses import dataclass
from typing import Any

import emcee
import numpy as np
from emcee.state import State
from jaxtyping import Float

from slipid.identify.moves import (
    Family,
    Mixture,
    Part,
    Proposal,
    Target,
    Warp,
    laplace,
    learnt,
    moves,
    warped,
)

Chain = Float[np.ndarray, "ensemble step walker size"]


@dataclass(frozen=True)
class Plan:
    """How to sample and when to stop.

    Attributes:
        ensembles, walkers: number of ensembles and of walkers of each.
        block: steps of a block.
        warm_up: number of blocks after which proposals are learnt; the last ends the warm-up.
        most: blocks after which it ends without having converged.
        spread: of the start around the fit, in stds, of the walker that starts widest; the first
            starts at a quarter of it. Wide starts find modes that the fit has not seen.
        r_hat, steps_per_tau, least_draws: converged when every coordinate has a smaller R-hat over
            ensembles, more steps per autocorrelation time, more effective draws.
        seed: of everything.
    """

    ensembles: int = 4
    walkers: int = 20
    block: int = 25
    warm_up: tuple[int, ...] = (3, 6, 10)
    most: int = 400
    spread: float = 6.0
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
        proposal: for the next block.
    """

    number: int
    chain: Chain
    log_prob: np.ndarray
    random: tuple[np.ndarray, np.ndarray]
    accepted: np.ndarray
    proposal: Proposal


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
    if after < 4 or after % max(4, 2 ** int(np.log2(after) - 2)):
        return False
    return diagnose(chain(blocks, plan), plan).converged


def chain(blocks: Sequence[Block], plan: Plan) -> Chain:
    """Positions after the warm-up."""
    return np.concatenate([b.chain for b in blocks[plan.warm_up[-1] :]], axis=1)


def _block(
    targets: Sequence[Target], plan: Plan, blocks: list[Block], tell: Callable[[int], None]
) -> Block:
    states, proposal = _begin(targets, plan, blocks)
    warp = proposal.warp
    stop, told = threading.Event(), [0] * plan.ensembles

    def ensemble(k: int) -> tuple[np.ndarray, np.ndarray, State, float]:
        inner = warped(targets[k], warp)
        sampler = emcee.EnsembleSampler(
            plan.walkers,
            len(inner.centre),
            inner.log_prob,
            moves=moves(inner, proposal),
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
        return np.stack(places), np.stack(log_probs), state, moved

    with ThreadPoolExecutor(min(os.cpu_count() or 1, plan.ensembles)) as pool:
        try:
            found = list(pool.map(ensemble, range(plan.ensembles)))
        finally:
            stop.set()  # an interrupt of the caller ends the others at their next step
    ends = [f[2] for f in found]
    places = np.stack([f[0] for f in found])
    block = Block(
        number=len(blocks),
        chain=warp.back(places),
        log_prob=np.stack([f[1] for f in found]) - warp.log_slope(places).sum(axis=-1),
        random=(
            np.stack([s.random_state[1] for s in ends]),
            np.array([s.random_state[2:] for s in ends], float),
        ),
        accepted=np.array([f[3] for f in found]),
        proposal=proposal,
    )
    return _with_learnt(block, targets[0], plan, blocks)


def _begin(
    targets: Sequence[Target], plan: Plan, blocks: list[Block]
) -> tuple[list[State], Proposal]:
    """State of every ensemble in warped coordinates, and the proposal."""
    if not blocks:
        return [_start(t, plan, k) for k, t in enumerate(targets)], laplace(targets[0])
    last = blocks[-1]
    warp = last.proposal.warp
    states = [
        State(
            warp.forward(last.chain[k, -1]),
            random_state=_random_state(last.random[0][k], last.random[1][k]),
        )
        for k in range(plan.ensembles)
    ]
    return states, last.proposal


def _random_state(key: np.ndarray, rest: np.ndarray) -> tuple[Any, ...]:
    return ("MT19937", key, int(rest[0]), int(rest[1]), float(rest[2]))


def _start(target: Target, plan: Plan, ensemble: int) -> State:
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
            return State(x, random_state=random.get_state(legacy=True))
    raise ValueError("the log density is not finite anywhere near the fit")


def _with_learnt(block: Block, target: Target, plan: Plan, blocks: list[Block]) -> Block:
    """The block with a new proposal, where the plan says that it is time to learn."""
    count = block.number + 1
    if count not in plan.warm_up:
        return block
    stage = plan.warm_up.index(count)
    recent = [b.chain for b in [*blocks, block][count // 2 :]]
    draws = np.concatenate(recent, axis=1).reshape(-1, len(target.centre))
    proposal = learnt(target, draws, parts=2 + stage, seed=plan.seed + stage)
    return Block(**{**vars(block), "proposal": proposal})


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
        array_stats.ess(by_walker, chain_axis=0, draw_axis=1, method="tail", prob=0.9),
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


def unpacked(arrays: dict[str, np.ndarray]) -> Block:
    """Block from what `packed` gave."""

    def part(name: str) -> Part | None:
        if f"{name}/own" not in arrays:
            return None
        own, given, slope = (arrays[f"{name}/{key}"] for key in ("own", "given", "slope"))
        return Part(own, given, slope, Mixture(*(arrays[f"{name}/{key}"] for key in _OF_MIXTURE)))

    families = []
    for k, count in enumerate(arrays["parts"]):
        parts = tuple(part(f"{k}/{n}") for n in range(int(count)))
        families.append(Family(parts, arrays.get(f"{k}/follow")))
    return Block(
        number=int(arrays["number"]),
        chain=arrays["chain"],
        log_prob=arrays["log_prob"],
        random=(arrays["random_key"], arrays["random_rest"]),
        accepted=arrays["accepted"],
        proposal=Proposal(Warp(*arrays["warp"]), tuple(families)),
    )


_OF_MIXTURE = ("weight", "mean", "root")


def packed(block: Block) -> dict[str, Any]:
    """Plain arrays of a block, for a file."""
    families = block.proposal.families
    out = {
        "number": np.asarray(block.number),
        "chain": block.chain,
        "log_prob": block.log_prob,
        "random_key": block.random[0],
        "random_rest": block.random[1],
        "accepted": block.accepted,
        "warp": np.stack(list(vars(block.proposal.warp).values())),
        "parts": np.array([len(f.parts) for f in families]),
    }
    for k, family in enumerate(families):
        if family.follow is not None:
            out[f"{k}/follow"] = family.follow
        for n, part in enumerate(family.parts):
            if part is not None:
                out |= {f"{k}/{n}/{key}": getattr(part, key) for key in ("own", "given", "slope")}
                out |= {f"{k}/{n}/{key}": getattr(part.mixture, key) for key in _OF_MIXTURE}
    return out
