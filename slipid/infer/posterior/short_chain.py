"""Short chain around a fit, for the intervals that its Laplace approximation does not describe.

The chain is that of `slipid.infer.posterior.ensemble` with fewer rows, walkers and blocks. The ends
of its intervals have sampling errors of about .1 standard deviations. As in `slipid sample`, the
uncertainty of the variances of the noise is added to its draws.
"""

from dataclasses import replace

import numpy as np

from slipid.fitting.problem import Problem
from slipid.infer.posterior import ensemble
from slipid.infer.posterior.blocks import Plan
from slipid.infer.posterior.coordinates import ELECTRIC, EVERYTHING, MOTION, Fitted
from slipid.infer.posterior.density import (
    MOST_REFUSED,
    Density,
    electric_given_motion,
    refused,
)
from slipid.infer.posterior.variance_draws import (
    CONDITIONED,
    added_covariance,
    drawn_variances,
    widened,
)
from slipid.infer.verdicts.draws import Draws
from slipid.support.progress import Reporter

SHORT = Plan(ensembles=2, walkers=32, block=16, warm_up=(1, 2), most=5, rows=2000, spread=1.0)
"""Settings of the sampler: the surrogate is learnt twice, and three blocks are kept.

With four, `ensemble` would judge their convergence, for which it needs packages of an extra."""
THINNED = 4
"""One of so many steps is kept."""
PROPOSALS = 32
"""Number of proposals for the electric parameters of every draw."""


def short_chain(problem: Problem, fitted: Fitted, seed: int, report: Reporter) -> Draws | None:
    """Return draws of the posterior of a fit, None if they are useless.

    Args:
        problem: likelihood of the runs on one floor each.
        fitted: fitted values around which the chain starts, with any runs over several floors.
        seed: seed of all random numbers.
        report: reporter of the progress.
    """
    first = Density(problem, fitted, EVERYTHING if problem.objective.joint else MOTION)
    if not first.size:
        return None
    try:
        found = _drawn(first, fitted, seed, report)
    except np.linalg.LinAlgError:
        found = None
    if found is None or not found.useful:
        report.line(
            "a short chain did not follow the posterior: intervals are those of the Laplace "
            "approximation"
        )
        return None
    return found


def _drawn(first: Density, fitted: Fitted, seed: int, report: Reporter) -> Draws | None:
    """Return the draws around a fit, None if too few electric proposals are accepted."""
    plan, problem = replace(SHORT, seed=seed), first.problem
    blocks = ensemble.extended(first.target(), plan, "for intervals", None, report)
    x = ensemble.chain(blocks, plan)[:, ::THINNED]
    ensembles, steps, walkers, size = x.shape
    x = x.transpose(0, 2, 1, 3).reshape(ensembles * walkers, steps, size)
    report.stage("drawing the variances of the noise")
    log_variance = drawn_variances(problem, fitted, (1, CONDITIONED), seed)
    added = added_covariance(problem, fitted, log_variance)
    rng = np.random.default_rng([seed, 2])
    x = widened(x, added[np.ix_(*[first.structure] * 2)], rng)
    z = np.broadcast_to(fitted.z, (*x.shape[:2], len(fitted.z))).copy()
    z[..., first.structure] = x
    if problem.objective.joint or not (second := Density(problem, fitted, ELECTRIC)).size:
        return Draws(z)
    report.stage(f"sampling {ELECTRIC}")
    drawn, moved = electric_given_motion(first, second, fitted.covariance, x, seed, PROPOSALS)
    z[..., second.structure] = widened(drawn, added[np.ix_(*[second.structure] * 2)], rng)
    return None if refused(moved) > MOST_REFUSED else Draws(z)
