"""Several independent emcee ensembles, sampled in blocks that can be stored and continued.

Walkers of one ensemble depend on each other, so that convergence is judged between ensembles.
During the warm-up, which is discarded, proposals are learnt from all ensembles; after it they stay
fixed. The content of a block and the end of sampling depend on earlier blocks only, so that a
continued chain equals an uninterrupted one.
"""

import os
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import emcee
import numpy as np
from emcee.state import State

from slipid.infer.posterior import diagnosis
from slipid.infer.posterior.blocks import Chain, ChainBlock, LogDensity, Plan, packed, unpacked
from slipid.infer.posterior.proposals import QUARTER_TURN, Hamiltonian, families, moves
from slipid.infer.posterior.transport_map import Transport, learnt
from slipid.support.checkpoint import Checkpoint
from slipid.support.progress import Reporter

RandomState = tuple[str, np.ndarray, int, int, float]
"""State of a Mersenne twister in NumPy's form."""

TARGET_ACCEPTED = 0.8
"""Target fraction of accepted Hamiltonian moves, to which their step is adapted in the warm-up."""
FIRST_ANGLE, LEAST_ANGLE = 0.3, 0.03
"""First and smallest step of Hamiltonian moves [rad]."""
DRAWS_PER_EFFECTIVE = 20.0
"""Approximate number of warm-up draws that carry the information of one independent draw."""


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
    while not _ended(blocks, plan):
        block = _block(target, plan, blocks)
        blocks.append(block)
        if checkpoint:
            checkpoint.save(f"{part}-{block.number:04d}", packed(block))
        warm = "warm-up, " if len(blocks) <= plan.warm_up[-1] else ""
        what = (
            f"block {len(blocks)}: {warm}{len(blocks) * plan.block} steps, "
            f"{100 * block.accepted.mean():.0f} % moved, "
            f"log density {block.log_prob[:, -1].mean():.1f}"
        )
        # The block at which sampling converges is unknown, so the remaining time is estimated for
        # the limit of blocks.
        report.advance(len(blocks), plan.most, what)
    return blocks


def _ended(blocks: list[ChainBlock], plan: Plan) -> bool:
    after = len(blocks) - plan.warm_up[-1]
    if len(blocks) >= plan.most:
        return True
    # The check is slow, so it is done for every fourth block at first, and later less often.
    if after < 4 or after % max(4, 2 ** int(np.log2(after) - 3)):
        return False
    return diagnosis.diagnose(chain(blocks, plan), plan).converged


def chain(blocks: Sequence[ChainBlock], plan: Plan) -> Chain:
    """Return the positions of all walkers after the warm-up."""
    return np.concatenate([b.chain for b in blocks[plan.warm_up[-1] :]], axis=1)


def _block(target: LogDensity, plan: Plan, blocks: list[ChainBlock]) -> ChainBlock:
    """Sample the next block of a chain; the ensembles run in parallel threads."""
    states, map, angle = _begin(target, plan, blocks)
    stop = threading.Event()

    def ensemble(k: int) -> tuple[np.ndarray, np.ndarray, State, float, list[list[float]]]:
        inner = target.in_coordinates(map)
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
        turns = [move.accepted for move, _ in made if isinstance(move, Hamiltonian)]
        return np.stack(places), np.stack(log_probs), state, moved, turns

    with ThreadPoolExecutor(min(os.cpu_count() or 1, plan.ensembles)) as pool:
        try:
            found = list(pool.map(ensemble, range(plan.ensembles)))
        finally:
            stop.set()  # after an interrupt, all ensembles stop at their next step
    ends = [f[2] for f in found]
    places = np.stack([f[0] for f in found])
    x, log = map.placed(places.reshape(-1, places.shape[-1]))
    block = ChainBlock(
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
    turns = [[a for of in every for a in of] for every in zip(*(f[4] for f in found), strict=True)]
    return _with_learnt(block, target, plan, blocks, turns)


def _begin(
    target: LogDensity, plan: Plan, blocks: list[ChainBlock]
) -> tuple[list[State], Transport, np.ndarray]:
    """Return every ensemble's state in mapped coordinates, the map, and Hamiltonian steps [rad]."""
    if not blocks:
        map = target.laplace()
        starts = [_start(target, plan, k) for k in range(plan.ensembles)]
        angle = np.full(len(families(target)), FIRST_ANGLE)
        return [State(map.forward(x), random_state=r) for x, r in starts], map, angle
    last, states = blocks[-1], []
    for x, key, (place, has_gauss, gauss) in zip(last.chain[:, -1], *last.random, strict=True):
        random: RandomState = ("MT19937", key, int(place), int(has_gauss), float(gauss))
        states.append(State(last.map.forward(x), random_state=random))
    return states, last.map, last.angle


def _start(target: LogDensity, plan: Plan, ensemble: int) -> tuple[np.ndarray, RandomState]:
    """Return start positions of an ensemble's walkers, and the state of its random numbers.

    Walkers are spread more widely than the fit's uncertainty (`Plan.spread`), at positions where
    the log density is finite.
    """
    root = np.linalg.cholesky(target.covariance)
    wide = plan.spread * np.geomspace(0.25, 1.0, plan.walkers)[:, None]
    seeds = np.random.SeedSequence((plan.seed, ensemble))
    random = np.random.RandomState(np.random.MT19937(seeds))
    x = np.empty((plan.walkers, len(root)))
    lost = np.ones(plan.walkers, bool)
    for shrink in 0.7 ** np.arange(30):
        # All walkers are drawn in each try: a smaller array would compile the density once more.
        tried = target.centre + shrink * wide * random.standard_normal(x.shape) @ root.T
        found = np.isfinite(target.terms(tried)).all(axis=1)
        x[lost & found] = tried[lost & found]
        lost &= ~found
        if not lost.any():
            state = random.get_state(legacy=True)
            assert isinstance(state, tuple)
            return x, state
    raise ValueError("the log density is not finite at any point near the fit")


def _with_learnt(
    block: ChainBlock,
    target: LogDensity,
    plan: Plan,
    blocks: list[ChainBlock],
    turns: list[list[float]],
) -> ChainBlock:
    """Return the block with the map and Hamiltonian steps of the next block.

    Both are adapted during the warm-up only. `turns` holds, for each family, the fractions of
    accepted Hamiltonian moves.
    """
    count = block.number + 1
    if count > plan.warm_up[-1]:
        return block
    more = np.array([np.mean(of) - TARGET_ACCEPTED if of else 0.0 for of in turns])
    block = replace(block, angle=np.clip(block.angle * np.exp(more), LEAST_ANGLE, QUARTER_TURN))
    if count in plan.warm_up[:-1]:
        recent = [b.chain for b in [*blocks, block][count // 2 :]]
        draws = np.concatenate(recent, axis=1).reshape(-1, len(target.centre))
        effective = len(draws) / DRAWS_PER_EFFECTIVE
        map = learnt(draws, effective, target.covariance, target.group)
        block = replace(block, map=map)
    return block
