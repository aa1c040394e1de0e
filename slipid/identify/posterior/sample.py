"""Posterior of a fit by sampling: motion first, then electric numbers given each draw of it.

Where currents were logged the posterior is p(motion | motion data) p(electric | motion,
data), which no single density describes: its normaliser depends on the motion. It is drawn from in
two stages; in the second every walker keeps its own draw of the motion.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from slipid.identify.fit.problem import Problem
from slipid.identify.fit.variances import Square
from slipid.identify.posterior import diagnosis, ensemble
from slipid.identify.posterior.blocks import Block, Chain, Plan, Record, Target
from slipid.identify.posterior.coordinates import ELECTRIC, EVERYTHING, MOTION, Fitted
from slipid.identify.posterior.density import Density, Held
from slipid.identify.posterior.diagnosis import Posterior

STILL = 0.01
"""Part of the walkers of the second stage that may never have moved."""
FEWEST, MORE, MOST = 9, 4, 33
"""Blocks of the second stage: at first, then so many more until it has settled, at most (or a sixth
of the first stage's most)."""
DRIFT, MEMORY = 4.0, 0.5
"""Standard errors by which means and stds of walkers may still move in the second half of the
chain, and correlation that they may still have with where they were in its middle."""


def sample(
    problem: Problem, fitted: Fitted, plan: Plan, draws: int = 400, record: Record | None = None
) -> Posterior:
    """Posterior around a fit, so many draws of each ensemble."""
    record = record or Record()
    parts = (EVERYTHING,) if problem.target.joint else (MOTION, ELECTRIC)
    first = Density(problem, fitted, parts[0])
    at = first.coordinates
    target = Target(first.terms, first.slope, at.group, at.kind, first.centre, first.covariance)
    blocks = ensemble.extended([target] * plan.ensembles, plan, parts[0], record)
    chain = ensemble.chain(blocks, plan)
    found = diagnosis.diagnose(chain, plan)
    x, log_prob = thinned(chain, blocks[plan.warm_up[-1] :], draws)
    shape = (plan.ensembles, draws)
    out_z = np.broadcast_to(fitted.z, (*shape, len(fitted.z))).copy()
    out_v = np.broadcast_to(fitted.log_variance, (*shape, len(fitted.log_variance))).copy()
    _put(first, x, out_z, out_v)
    accepted = {parts[0]: float(np.mean([b.accepted for b in blocks]))}
    still = drifting = 0.0
    reason = f"{found.reason} ({first.names[found.worst]})"
    if len(parts) > 1:
        second = Density(problem, fitted, ELECTRIC)
        if second.size:
            later = electric_given_motion(first, second, fitted.covariance, x, plan, record)
            _put(second, later.x, out_z, out_v)
            accepted[ELECTRIC], still = later.accepted, later.still
            drifting = float(later.unsettled.max())
            if found.converged and drifting > 1:
                worst = second.names[int(later.unsettled.argmax())]
                reason = f"electric walkers that have not settled ({worst})"
    if found.converged and still > STILL:
        reason = f"{100 * still:.1f} % of the electric walkers, which never moved"
    return Posterior(
        z=out_z,
        log_variance=out_v,
        effects=at.parts(x)[2],
        fitted=fitted,
        log_prob=log_prob,
        names=at.names,
        diagnosis=found,
        accepted=accepted,
        unsettled=drifting,
        converged=found.converged and still <= STILL and drifting <= 1,
        reason=reason,
    )


def thinned(
    chain: Chain, blocks: Sequence[Block], draws: int
) -> tuple[Float[np.ndarray, "ensemble draw size"], Float[np.ndarray, "ensemble draw"]]:
    """Draws spread evenly over steps and walkers; some repeat where there are too few."""
    log_prob = np.concatenate([b.log_prob for b in blocks], axis=1)
    _, steps, walkers, _ = chain.shape
    step = ((np.arange(draws) + 0.5) / draws * steps).astype(int)
    walker = np.arange(draws) * 7 % walkers if walkers % 7 else np.arange(draws) % walkers
    return chain[:, step, walker], log_prob[:, step, walker]


def _put(density: Density, x: np.ndarray, z: np.ndarray, log_variance: np.ndarray) -> None:
    at = density.coordinates
    z[..., at.structure], log_variance[..., at.variance], _ = at.parts(x)


@dataclass(frozen=True, eq=False)
class SecondStage:
    """A draw of the electric numbers for every draw of the motion, and how it was found.

    Accepted is the part of the moves that moved something, still the part of the walkers with a
    group that never moved; drift or memory of each coordinate is as `unsettled` says.
    """

    x: Float[np.ndarray, "ensemble draw size"]
    accepted: float
    still: float
    unsettled: Float[np.ndarray, " size"]


def electric_given_motion(
    first: Density,
    second: Density,
    covariance: Square,
    x: Float[np.ndarray, "ensemble draw size"],
    plan: Plan,
    record: Record,
) -> SecondStage:
    """A draw of the electric numbers for every draw of the motion.

    Walkers are in coordinates less their regression on the motion, in which they are all alike. The
    covariance is Laplace's of the search vector, the plan that of the first stage.
    """
    motion, electric = first.coordinates.structure, second.coordinates.structure
    n, cross = len(electric), covariance[np.ix_(motion, electric)]
    slope = np.linalg.solve(covariance[np.ix_(motion, motion)], cross)
    left = second.covariance.copy()
    left[:n, :n] -= covariance[np.ix_(electric, motion)] @ slope
    shift = np.zeros((*x.shape[:2], second.size))
    shift[..., :n] = (x[..., : len(motion)] - first.centre[: len(motion)]) @ slope
    targets = [
        _target(second, left, moved, first.hold(of_ensemble))
        for of_ensemble, moved in zip(x, shift, strict=True)
    ]
    later = replace(
        plan, walkers=x.shape[1], seed=plan.seed + 1, block=8, warm_up=(1, 2, 3, 5), most=FEWEST
    )
    part = f"{ELECTRIC}-of-{hashlib.sha256(x.tobytes()).hexdigest()[:12]}"
    blocks = list(record.done(part))
    longest = max(MOST, plan.most // 6)
    while True:
        # asked after these numbers of blocks only, wherever an earlier call was interrupted
        while later.most < len(blocks):
            later = replace(later, most=later.most + MORE)
        blocks = ensemble.extended(targets, later, part, record, blocks)
        steps = ensemble.chain(blocks, later)
        left_over = unsettled(steps)
        if len(blocks) >= longest or left_over.max() < 1:
            break
        later = replace(later, most=later.most + MORE)
    moved = np.diff(steps, axis=1) != 0
    groups = second.coordinates.group
    never = np.any([~moved[..., groups == g].any(axis=(1, 3)) for g in np.unique(groups)], axis=0)
    return SecondStage(
        x=steps[:, -1] + shift,
        accepted=float(np.mean([b.accepted for b in blocks])),
        still=float(never.mean()),
        unsettled=left_over,
    )


def _target(second: Density, covariance: np.ndarray, shift: np.ndarray, held: Held) -> Target:
    """The electric numbers less their regression on the motion, each walker with its own motion."""
    at = second.coordinates
    return Target(
        lambda u: second.terms(u + shift, held),
        lambda u: second.slope(u + shift, held),
        at.group,
        at.kind,
        second.centre,
        covariance,
        apart=True,
    )


def unsettled(steps: Chain) -> Float[np.ndarray, " size"]:
    """Drift and memory of walkers over the second half of a chain, the worse of the two; 1: enough.

    Walkers of the second stage know nothing of each other and have, less what the motion tells of
    them, one distribution: they are many independent draws of where a chain is after so many steps.
    """
    count = steps.shape[1]
    middle, end = (steps[:, k].reshape(-1, steps.shape[-1]) for k in (count // 2, count - 1))
    std, before = end.std(axis=0) + 1e-300, middle.std(axis=0) + 1e-300
    error = np.sqrt(2 / len(end))  # of a difference of means; of one of log stds it is smaller
    of_mean = np.abs(end.mean(axis=0) - middle.mean(axis=0)) / std / error
    drift = np.maximum(of_mean, np.abs(np.log(std / before)) / error)
    together = ((end - end.mean(axis=0)) * (middle - middle.mean(axis=0))).mean(axis=0)
    return np.asarray(np.maximum(drift / DRIFT, together / std / before / MEMORY))
