"""Posterior of a fit by sampling: motion first, then electric numbers given each draw of it.

Where currents were logged the posterior is p(motion | motion data) p(electric | motion,
data), which no single density describes: its normaliser depends on the motion. Given the motion the
electric numbers are nearly linear with Gaussian noise, so that they are drawn by
Metropolis-Hastings steps with proposals around their most likely values.
"""

import importlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from slipid.identify.fit.hierarchy import effect_information, pooled_stds
from slipid.identify.fit.problem import Problem, linear
from slipid.identify.fit.variances import VARIANCE_SPREAD, information
from slipid.identify.posterior import diagnosis, ensemble
from slipid.identify.posterior.blocks import (
    Block,
    Chain,
    Plan,
    Record,
    Target,
    packed,
    unpacked,
)
from slipid.identify.posterior.coordinates import ELECTRIC, EVERYTHING, MOTION, Fitted, effects_at
from slipid.identify.posterior.density import Density
from slipid.identify.posterior.diagnosis import Posterior
from slipid.identify.posterior.electric import electric_given_motion
from slipid.identify.result import Fit, known
from slipid.support.checkpoint import Checkpoint
from slipid.support.progress import Reporter

for _module in ("arviz_base", "arviz_stats", "h5netcdf"):
    importlib.import_module(_module)  # they are used after hours of work: what is missing shows now

STILL = 0.01
"""Part of the draws whose electric numbers may never have moved."""


def sampled(
    fit: Fit, plan: Plan, draws: int, kept: Checkpoint | None, report: Reporter
) -> Posterior:
    """Posterior of a fit by the likelihood it was made of, with progress.

    It goes on from the blocks that an earlier call has kept, and keeps new ones.
    """

    def done(part: str) -> list[Block]:
        blocks: list[Block] = []
        if kept is None:
            return blocks
        while (arrays := kept.load(f"{part}-{len(blocks):04d}")) is not None:
            blocks.append(unpacked(arrays))
        if blocks:
            report.line(f"going on from block {len(blocks)} ({part}) of {kept.folder}")
        return blocks

    def keep(part: str, block: Block) -> None:
        if kept is not None:
            kept.save(f"{part}-{block.number:04d}", packed(block))
        _tell(block, plan, report)

    def steps(part: str, count: int) -> None:
        report.stage(f"sampling {part}")

    return sample(fit, plan, draws, Record(done, keep, steps))


def _tell(block: Block, plan: Plan, report: Reporter) -> None:
    """Progress of a chain; the time left is what it takes at most."""
    count = block.number + 1
    warm = "warm-up, " if count <= plan.warm_up[-1] else ""
    what = (
        f"block {count}: {warm}{count * block.chain.shape[1]} steps, "
        f"{100 * block.accepted.mean():.0f} % moved, "
        f"log density {block.log_prob[:, -1].mean():.1f}"
    )
    report.advance(count, plan.most, what)


def sample(fit: Fit, plan: Plan, draws: int = 400, record: Record | None = None) -> Posterior:
    """Posterior around a fit, so many draws of each ensemble."""
    problem, fitted = known(fit.problem), Fitted.of(fit)
    assert problem.several is None, "runs on one floor each"
    record = record or Record()
    parts = (EVERYTHING,) if problem.target.joint else (MOTION, ELECTRIC)
    first = Density(problem, fitted, parts[0])
    at = first.coordinates
    target = Target(first.terms, first.slope, at.group, first.centre, first.covariance)
    blocks = ensemble.extended(target, plan, parts[0], record)
    chain = ensemble.chain(blocks, plan)
    found = diagnosis.diagnose(chain, plan)
    x, log_prob = thinned(chain, blocks[plan.warm_up[-1] :], draws)
    shape = (plan.ensembles, draws)
    out = np.broadcast_to(fitted.z, (*shape, len(fitted.z))).copy()
    out[..., at.structure] = x
    accepted = {parts[0]: float(np.mean([b.accepted for b in blocks]))}
    still, reason = 0.0, f"{found.reason} ({first.names[found.worst]})"
    if len(parts) > 1:
        second = Density(problem, fitted, ELECTRIC)
        if second.size:
            record.tell(ELECTRIC, 0)
            later = electric_given_motion(first, second, fitted.covariance, x, plan.seed)
            out[..., second.coordinates.structure] = later.x
            accepted[ELECTRIC], still = later.accepted, later.still
    if not np.isfinite(out).all():
        still, reason = 1.0, "electric draws that are not finite"
    elif found.converged and still > STILL:
        reason = f"{100 * still:.1f} % of the electric draws, which never moved"
    return Posterior(
        fit=fit,
        z=out,
        log_variance=drawn_variances(problem, fitted, shape, plan.seed),
        log_prob=log_prob,
        names=at.names,
        diagnosis=found,
        accepted=accepted,
        converged=found.converged and still <= STILL,
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


def drawn_variances(
    problem: Problem, fitted: Fitted, shape: tuple[int, int], seed: int
) -> Float[np.ndarray, "ensemble draw variance"]:
    """Log variances from the Gaussian with their information at the fit.

    They hardly depend on the numbers of the model, which the chains hold them for. That of the load
    biases of floors, of which there are few, is drawn by how likely each of a grid is.
    """
    log_v, keep = fitted.log_variance, np.ones(len(problem.windows))
    electric = problem.electric(fitted.z, log_v)
    residual, jacobian, felt = linear(problem.target, fitted.z, electric)
    through = problem.through_voltage(fitted.z, log_v, felt)
    effect = effects_at(problem, residual, log_v)
    weight = problem.seen(residual, log_v, keep, effect).whitening.weight["motion"]
    motion = residual["motion"], jacobian["motion"]
    told = np.array(information(problem.noise.blocks, log_v, keep, through))
    of_blocks = np.asarray(problem.target.scored)
    told *= of_blocks[:, None] & of_blocks
    told += effect_information(problem.target, motion, weight, fitted.covariance, log_v)
    told[np.diag_indices_from(told)] += np.where(of_blocks, 0.0, 1 / VARIANCE_SPREAD**2)
    root = np.linalg.cholesky(np.linalg.inv(told))
    rng = np.random.default_rng([seed, 1])
    out = log_v + rng.standard_normal((*shape, len(log_v))) @ root.T
    precision = np.linalg.inv(fitted.covariance)
    pooled = pooled_stds(precision, fitted.z, problem.target, log_v)
    out[..., problem.target.pooled] = 2 * np.log(rng.choice(pooled.std, shape, p=pooled.weight))
    return np.asarray(out)
