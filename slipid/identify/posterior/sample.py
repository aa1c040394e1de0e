"""Posterior of a fit by sampling: motion first, then electric numbers given each draw of it.

Where currents do not inform motion the posterior is p(motion | motion data) p(electric | motion,
data), which no single density describes: its normaliser depends on the motion. It is drawn from in
two stages; in the second every walker keeps its own draw of the motion.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from slipid.identify.fit.problem import Problem
from slipid.identify.posterior import diagnosis, ensemble
from slipid.identify.posterior.blocks import Block, Chain, Plan, Record
from slipid.identify.posterior.coordinates import ELECTRIC, EVERYTHING, MOTION, Fitted
from slipid.identify.posterior.density import Density
from slipid.identify.posterior.diagnosis import Posterior
from slipid.identify.posterior.second_stage import electric_given_motion
from slipid.identify.posterior.target import Target

STILL = 0.01
"""Part of the walkers of the second stage that may never have moved."""


def sample(
    problem: Problem, fitted: Fitted, plan: Plan, draws: int = 400, record: Record | None = None
) -> Posterior:
    """Posterior around a fit, so many draws of each ensemble."""
    record = record or Record()
    parts = (EVERYTHING,) if problem.joint else (MOTION, ELECTRIC)
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
    still = unsettled = 0.0
    reason = f"{found.reason} ({first.names[found.worst]})"
    if len(parts) > 1:
        second = Density(problem, fitted, ELECTRIC)
        if second.size:
            later = electric_given_motion(first, second, fitted.covariance, x, plan, record)
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
        effects=at.parts(x)[2],
        fitted=fitted,
        log_prob=log_prob,
        names=at.names,
        diagnosis=found,
        accepted=accepted,
        still=still,
        unsettled=unsettled,
        converged=found.converged and still <= STILL and unsettled <= 1,
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
