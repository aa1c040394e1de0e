"""Posterior of a fit by sampling: motion first, then electric numbers given each draw of it.

Where currents do not inform motion the posterior is p(motion | motion data) p(electric | motion,
data), which no single density describes: its normaliser depends on the motion. It is drawn from in
two stages; in the second every walker keeps its own draw of the motion.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from slipid.identify import sampler
from slipid.identify.density import ELECTRIC, EVERYTHING, MOTION, Density, Fitted
from slipid.identify.moves import Target
from slipid.identify.problem import DEGREES, Problem
from slipid.identify.sampler import Block, Diagnosis, Plan

Keep = Callable[[str, Block], None]
Done = Callable[[str], Sequence[Block]]
STILL = 0.01
"""Part of the walkers of the second stage that may never have moved."""
FEWEST, MORE, MOST = 9, 4, 33
"""Blocks of the second stage: at first, then so many more until it has settled, at most (or a sixth
of the first stage's most)."""
DRIFT, MEMORY = 4.0, 0.5
"""Standard errors by which means and stds of its walkers may still move in the second half of the
chain, and correlation that they may still have with where they were in its middle."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """Draws, and whether they may be believed.

    Attributes:
        z: search vectors (ensemble, draw, free).
        log_variance: (ensemble, draw, variance).
        effects: of sessions, in stds of what they share (ensemble, draw, effect).
        fitted: what was sampled around.
        log_prob: of the first stage.
        names: of the coordinates of the first stage, as in `diagnosis`.
        diagnosis: of the first stage, from all its steps.
        accepted: part of the moves that moved something, by stage.
        still: part of the second stage's walkers with a group that never moved.
        unsettled: drift and memory of the second stage's walkers over what they may be, the worst.
        converged, reason: the verdict.
    """

    z: Float[np.ndarray, "ensemble draw free"]
    log_variance: Float[np.ndarray, "ensemble draw variance"]
    effects: Float[np.ndarray, "ensemble draw effect"]
    fitted: Fitted
    log_prob: Float[np.ndarray, "ensemble draw"]
    names: tuple[str, ...]
    diagnosis: Diagnosis
    accepted: dict[str, float]
    still: float
    unsettled: float
    converged: bool
    reason: str


def sample(
    problem: Problem,
    fitted: Fitted,
    plan: Plan,
    draws: int = 400,
    done: Done = lambda part: (),
    keep: Keep = lambda part, block: None,
    tell: Callable[[str, int], None] = lambda part, steps: None,
) -> Posterior:
    """Posterior around a fit.

    Args:
        problem: windows, robot, priors.
        fitted: where the fit ended.
        plan: ensembles, bars, seed.
        draws: that are kept of each ensemble.
        done: blocks of a part that an earlier call has made. The second part's name tells which
            draws of the first its blocks are of.
        keep: called with every new block.
        tell: called with the part and the steps of a block that are done.
    """
    parts = (EVERYTHING,) if problem.joint else (MOTION, ELECTRIC)
    first = Density(problem, fitted, parts[0])
    group = first.coordinates.group
    target = Target(first.terms, first.slope, group, first.kind, first.centre, first.covariance)
    blocks = _blocks([target] * plan.ensembles, plan, parts[0], done(parts[0]), keep, tell)
    chain = sampler.chain(blocks, plan)
    found = sampler.diagnose(chain, plan)
    x, log_prob = thinned(chain, blocks[plan.warm_up[-1] :], draws)
    shape = (plan.ensembles, draws)
    out_z = np.broadcast_to(fitted.z, (*shape, len(fitted.z))).copy()
    out_v = np.broadcast_to(fitted.log_variance, (*shape, len(fitted.log_variance))).copy()
    _put(first, x, out_z, out_v)
    accepted = {parts[0]: float(np.mean([b.accepted for b in blocks]))}
    still = unsettled = 0.0
    reason = f"{found.reason} ({first.names[found.worst]})"
    if len(parts) > 1:
        second = Density(problem, fitted, ELECTRIC)
        if second.size:
            later = _given(first, second, fitted.covariance, x, plan, done, keep, tell)
            _put(second, later.x, out_z, out_v)
            accepted[ELECTRIC], still = later.accepted, later.still
            unsettled = float(later.unsettled.max())
            if found.converged and unsettled > 1:
                worst = second.names[int(later.unsettled.argmax())]
                reason = f"electric walkers that have not settled ({worst})"
    if found.converged and still > STILL:
        reason = f"{100 * still:.1f} % of the electric walkers, which never moved"
    return Posterior(
        z=out_z,
        log_variance=out_v,
        effects=first.coordinates.parts(x)[2],
        fitted=fitted,
        log_prob=log_prob,
        names=first.names,
        diagnosis=found,
        accepted=accepted,
        still=still,
        unsettled=unsettled,
        converged=found.converged and still <= STILL and unsettled <= 1,
        reason=reason,
    )


def _blocks(
    targets: Sequence[Target],
    plan: Plan,
    part: str,
    done: Sequence[Block],
    keep: Keep,
    tell: Callable[[str, int], None],
) -> list[Block]:
    blocks = list(done)
    for block in sampler.run(targets, plan, blocks, lambda steps: tell(part, steps)):
        blocks.append(block)
        keep(part, block)
    return blocks


def likelihoods(
    problem: Problem, found: Posterior
) -> dict[str, Float[np.ndarray, "ensemble draw piece"]]:
    """Log likelihood of every piece and draw, by block of residuals."""
    density, x = _everything(problem, found)
    shape = x.shape[:2]
    out = density.pointwise(x.reshape(-1, x.shape[-1]))
    return {k: v.reshape(*shape, -1) for k, v in out.items()}


def replicates(
    problem: Problem, found: Posterior, draws: int, seed: int = 0
) -> dict[str, Float[np.ndarray, "ensemble draw piece m"]]:
    """Replicated less measured data of every piece, from some draws of each ensemble.

    What the model says, less what was measured, plus noise of the draw's own variances.
    """
    density, x = _everything(problem, found)
    some = x[:, np.linspace(0, x.shape[1] - 1, draws).astype(int)]
    rng = np.random.default_rng(seed)
    flat = some.reshape(-1, x.shape[-1])
    out = {k: np.array(v) for k, v in density.residuals(flat).items()}
    for k, r in out.items():
        for one, log_v in zip(r, density.coordinates.parts(flat)[1], strict=True):
            root = np.linalg.cholesky(np.asarray(problem.covariance(k, log_v)))
            normal = rng.standard_normal(one.shape)
            normal *= np.sqrt(DEGREES / rng.chisquare(DEGREES, (len(normal), 1)))
            one += np.einsum("nij,nj->ni", root, normal)
    return {k: v.reshape(*some.shape[:2], *v.shape[1:]) for k, v in out.items()}


def _everything(problem: Problem, found: Posterior) -> tuple[Density, np.ndarray]:
    """A density of all numbers together, and the draws as its coordinates."""
    middle = replace(
        found.fitted,
        z=found.z.mean(axis=(0, 1)),
        log_variance=found.log_variance.mean(axis=(0, 1)),
    )
    density = Density(problem, middle, EVERYTHING)
    return density, np.concatenate([found.z, found.log_variance, found.effects], axis=-1)


def thinned(
    chain: sampler.Chain, blocks: Sequence[Block], draws: int
) -> tuple[Float[np.ndarray, "ensemble draw size"], Float[np.ndarray, "ensemble draw"]]:
    """Draws spread evenly over steps and walkers; more than there are repeat some."""
    log_prob = np.concatenate([b.log_prob for b in blocks], axis=1)
    _, steps, walkers, _ = chain.shape
    step = ((np.arange(draws) + 0.5) / draws * steps).astype(int)
    walker = np.arange(draws) * 7 % walkers if walkers % 7 else np.arange(draws) % walkers
    return chain[:, step, walker], log_prob[:, step, walker]


def _put(density: Density, x: np.ndarray, z: np.ndarray, log_variance: np.ndarray) -> None:
    at = density.coordinates
    z[..., at.structure], log_variance[..., at.variance], _ = at.parts(x)


@dataclass(frozen=True, eq=False)
class _Later:
    x: Float[np.ndarray, "ensemble draw size"]
    accepted: float
    still: float
    unsettled: Float[np.ndarray, " size"]


def _given(
    first: Density,
    second: Density,
    covariance: Float[np.ndarray, "free free"],
    x: Float[np.ndarray, "ensemble draw size"],
    plan: Plan,
    done: Done,
    keep: Keep,
    tell: Callable[[str, int], None],
) -> _Later:
    """A draw of the electric numbers for every draw of the motion.

    Walkers are in coordinates less their regression on the motion, in which they are all alike.
    """
    motion, electric = first.coordinates.structure, second.coordinates.structure
    slope = np.linalg.solve(
        covariance[np.ix_(motion, motion)], covariance[np.ix_(motion, electric)]
    )
    n = len(electric)
    left = second.covariance.copy()
    left[:n, :n] -= covariance[np.ix_(electric, motion)] @ slope
    shift = np.zeros((*x.shape[:2], second.size))
    shift[..., :n] = (x[..., : len(motion)] - first.centre[: len(motion)]) @ slope
    targets = []
    for of_ensemble, moved in zip(x, shift, strict=True):
        held = first.hold(of_ensemble)

        def terms(u: np.ndarray, moved: np.ndarray = moved, held: object = held) -> np.ndarray:
            return second.terms(u + moved, held)

        def steep(u: np.ndarray, moved: np.ndarray = moved, held: object = held) -> np.ndarray:
            return second.slope(u + moved, held)

        group = second.coordinates.group
        targets.append(Target(terms, steep, group, second.kind, second.centre, left, apart=True))
    later = replace(
        plan, walkers=x.shape[1], seed=plan.seed + 1, block=8, warm_up=(1, 2, 3, 5), most=FEWEST
    )
    part = f"{ELECTRIC}-of-{hashlib.sha256(x.tobytes()).hexdigest()[:12]}"
    blocks = list(done(part))
    longest = max(MOST, plan.most // 6)
    while True:
        # asked after these numbers of blocks only, wherever an earlier call was interrupted
        while later.most < len(blocks):
            later = replace(later, most=later.most + MORE)
        blocks = _blocks(targets, later, part, blocks, keep, lambda _, k: tell(ELECTRIC, k))
        chain = sampler.chain(blocks, later)
        unsettled = _unsettled(chain)
        if len(blocks) >= longest or unsettled.max() < 1:
            break
        later = replace(later, most=later.most + MORE)
    moved = np.diff(chain, axis=1) != 0
    groups = second.coordinates.group
    never = np.any([~moved[..., groups == g].any(axis=(1, 3)) for g in np.unique(groups)], axis=0)
    return _Later(
        x=chain[:, -1] + shift,
        accepted=float(np.mean([b.accepted for b in blocks])),
        still=float(never.mean()),
        unsettled=unsettled,
    )


def _unsettled(chain: sampler.Chain) -> Float[np.ndarray, " size"]:
    """Drift and memory of walkers over the second half of a chain, the worse of the two; 1: enough.

    Walkers of the second stage know nothing of each other and have, less what the motion tells of
    them, one distribution: they are many independent draws of where a chain is after so many steps.
    """
    steps = chain.shape[1]
    middle, end = (chain[:, k].reshape(-1, chain.shape[-1]) for k in (steps // 2, steps - 1))
    std, before = end.std(axis=0) + 1e-300, middle.std(axis=0) + 1e-300
    error = np.sqrt(2 / len(end))  # of a difference of means; of one of log stds it is smaller
    of_mean = np.abs(end.mean(axis=0) - middle.mean(axis=0)) / std / error
    drift = np.maximum(of_mean, np.abs(np.log(std / before)) / error)
    together = ((end - end.mean(axis=0)) * (middle - middle.mean(axis=0))).mean(axis=0)
    return np.asarray(np.maximum(drift / DRIFT, together / std / before / MEMORY))
