"""Several independent emcee ensembles, sampled in blocks that can be stored and continued.

Walkers of one ensemble depend on each other, so that convergence is judged between ensembles.
During the warm-up, which is discarded, a surrogate is learnt from the positions of all ensembles
and from draws of the surrogate before; after the warm-up it stays fixed. If the chain is slow then,
it becomes a part of the warm-up, and the surrogate is learnt again. The content of a block and the
end of sampling depend on earlier blocks only, so that a continued chain equals an uninterrupted
one.
"""

import os
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import emcee
import numpy as np
from emcee.state import State
from jaxtyping import Float

from slipid.infer.posterior import diagnosis
from slipid.infer.posterior.blocks import (
    Chain,
    ChainBlock,
    Learnt,
    LogDensity,
    Plan,
    packed,
    unpacked,
)
from slipid.infer.posterior.learning import Learner
from slipid.infer.posterior.proposals import moves
from slipid.support.checkpoint import Checkpoint
from slipid.support.progress import Reporter

RandomState = tuple[str, np.ndarray, int, int, float]
"""State of a Mersenne twister in NumPy's form."""
USUAL_BLOCKS = 24
"""Number of blocks after the warm-up that are usually sufficient."""
SLOW, JUDGED, MOST_AGAIN = 25, (160, 640), 3
"""Number of steps of a walker per effective draw beyond which the surrogate is learnt anew; range
of steps after the warm-up in which this is judged, and largest number of such turns."""


def extended(
    target: LogDensity, plan: Plan, part: str, checkpoint: Checkpoint | None, report: Reporter
) -> list[ChainBlock]:
    """Sample blocks of a part of the posterior until convergence or the plan's limit of blocks.

    Sampling resumes after the blocks in the checkpoint, in which each new block is stored.
    """
    blocks: list[ChainBlock] = []
    while checkpoint and (arrays := checkpoint.load(f"{part}-{len(blocks):04d}")) is not None:
        blocks.append(unpacked(arrays))
    if checkpoint and blocks:
        report.line(f"continuing from block {len(blocks)} ({part}) of {checkpoint.folder}")
    report.stage(f"sampling {part}")
    learner, found = Learner(target, plan), _diagnosed(blocks, plan)
    while not (found and found.converged) and len(blocks) < max(
        plan.most, warm_up(blocks, plan) + 1
    ):
        known = next((b.learnt for b in reversed(blocks) if b.learnt), None) or learner.first
        block = _block(learner, blocks, known)
        judged, count = _diagnosed([*blocks, block], plan), len(blocks) + 1
        if count in plan.warm_up[:-1] or (judged and _slow(judged, blocks, plan)):
            recent = [*blocks, block][_last_turn(blocks) :]
            places = np.concatenate([b.chain for b in recent], axis=1)
            block = replace(block, learnt=learner.next(known, places, count))
        blocks.append(block)
        if checkpoint:
            checkpoint.save(f"{part}-{block.number:04d}", packed(block))
        what = f"block {len(blocks)}: {100 * block.accepted.mean():.0f} % moved"
        warming = len(blocks) <= warm_up(blocks, plan)
        found = None if warming else judged or found
        if warming:
            what += f", warm-up, log density {block.log_prob[:, -1].mean():.1f}"
        elif found:
            what += f", {found.against(plan, target.names)}"
        report.advance(len(blocks), _expected(blocks, found, plan), what)
    return blocks


def warm_up(blocks: Sequence[ChainBlock], plan: Plan) -> int:
    """Return the number of blocks in the warm-up, which are discarded.

    It ends some blocks after a surrogate was learnt for the last time.
    """
    settling = plan.warm_up[-1] - max((0, *plan.warm_up[:-1]))
    return max(plan.warm_up[-1], _last_turn(blocks) + settling)


def _last_turn(blocks: Sequence[ChainBlock]) -> int:
    """Return the number of blocks after which a surrogate was learnt last, 0 for the first one."""
    return max((b.number + 1 for b in blocks if b.learnt), default=0)


def _slow(found: diagnosis.Diagnosis, blocks: Sequence[ChainBlock], plan: Plan) -> bool:
    """Return True if the surrogate is to be learnt anew after the block that follows `blocks`.

    Chains are slow if walkers stay at places that the surrogate describes badly, from which it is
    then learnt, too. The largest number of blocks has no influence, as it may be increased later.
    """
    again = sum(b.learnt is not None for b in blocks) - len(plan.warm_up[:-1])
    if found.converged or again >= MOST_AGAIN or not JUDGED[0] <= found.steps <= JUDGED[1]:
        return False
    return bool(found.steps * plan.ensembles * plan.walkers > SLOW * found.ess.min())


def _diagnosed(blocks: list[ChainBlock], plan: Plan) -> diagnosis.Diagnosis | None:
    """Return the convergence so far if it is to be judged after this number of blocks."""
    after = len(blocks) - warm_up(blocks, plan)
    # The check is slow, so it is done for every fourth block at first, and later less often.
    if after < 4 or after % max(4, 2 ** int(np.log2(after) - 3)):
        return None
    return diagnosis.diagnose(chain(blocks, plan), plan)


def _expected(blocks: Sequence[ChainBlock], found: diagnosis.Diagnosis | None, plan: Plan) -> int:
    """Return the number of blocks after which the chains will probably have converged.

    Effective draws grow in proportion to the steps.
    """
    done, warm = len(blocks), warm_up(blocks, plan)
    if found is None:
        return min(plan.most, max(done + 1, warm + USUAL_BLOCKS))
    # Without a single move the excess is infinite.
    after = np.nan_to_num(found.excess * found.steps / plan.block, nan=np.inf)
    return int(min(plan.most, max(done + 1, warm + after + 1)))


def chain(blocks: Sequence[ChainBlock], plan: Plan) -> Chain:
    """Return the positions of all walkers after the warm-up."""
    return np.concatenate([b.chain for b in blocks[warm_up(blocks, plan) :]], axis=1)


def _block(learner: Learner, blocks: list[ChainBlock], known: Learnt) -> ChainBlock:
    """Sample the next block of a chain; the ensembles run in parallel threads."""
    target, plan = learner.target, learner.plan
    states = _begin(plan, blocks, known)
    stop = threading.Event()

    def ensemble(k: int) -> _Walked:
        made = moves(target, known)
        sampler = emcee.EnsembleSampler(
            plan.walkers,
            target.size,
            target.log_prob,
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
        return _Walked(np.stack(places), np.stack(log_probs), state, moved)

    with ThreadPoolExecutor(min(os.cpu_count() or 1, plan.ensembles)) as pool:
        try:
            found = list(pool.map(ensemble, range(plan.ensembles)))
        finally:
            stop.set()  # after an interrupt, all ensembles stop at their next step
    ends = [f.state for f in found]
    return ChainBlock(
        number=len(blocks),
        chain=np.stack([f.places for f in found]),
        log_prob=np.stack([f.log_prob for f in found]),
        random=(
            np.stack([s.random_state[1] for s in ends]),
            np.array([s.random_state[2:] for s in ends], float),
        ),
        accepted=np.array([f.moved for f in found]),
        learnt=None,
    )


class _Walked(NamedTuple):
    """Steps of one ensemble.

    Attributes:
        places: positions of the walkers after every step.
        log_prob: log density there.
        state: last state.
        moved: fraction of walkers that moved, averaged over the steps.
    """

    places: Float[np.ndarray, "step walker size"]
    log_prob: Float[np.ndarray, "step walker"]
    state: State
    moved: float


def _begin(plan: Plan, blocks: list[ChainBlock], known: Learnt) -> list[State]:
    """Return the state from which every ensemble continues."""
    if not blocks:
        seeds = [np.random.SeedSequence((plan.seed, k)) for k in range(plan.ensembles)]
        made = [np.random.RandomState(np.random.MT19937(seed)) for seed in seeds]
        each = [random.get_state(legacy=True) for random in made]
        return [State(x, random_state=r) for x, r in zip(known.places, each, strict=True)]
    last, states = blocks[-1], []
    places = last.learnt.places if last.learnt else last.chain[:, -1]
    for x, key, (place, has_gauss, gauss) in zip(places, *last.random, strict=True):
        random: RandomState = ("MT19937", key, int(place), int(has_gauss), float(gauss))
        states.append(State(x, random_state=random))
    return states
