"""Short chain around a fit, for the intervals that its Laplace approximation does not describe.

The chain is that of `slipid.infer.posterior.ensemble` with fewer rows, walkers and blocks: a fifth
of the time, and some hundred effective draws, whose quantiles have errors of about a tenth of a
standard deviation.
"""

from dataclasses import replace

import numpy as np

from slipid.fitting.problem import Problem
from slipid.infer.posterior import ensemble
from slipid.infer.posterior.blocks import Plan
from slipid.infer.posterior.coordinates import ELECTRIC, EVERYTHING, MOTION, Fitted
from slipid.infer.posterior.density import Density, electric_given_motion
from slipid.infer.verdicts.draws import Draws
from slipid.support.progress import Reporter

SHORT = Plan(ensembles=2, walkers=32, block=8, warm_up=(1, 2), most=5, rows=800, spread=1.0)
"""Settings of the sampler: the surrogate is learnt twice, and three blocks are kept."""
THINNED = 4
"""One of so many steps is kept."""
PROPOSALS = 32
"""Number of proposals for the electric parameters of every draw."""


def short_chain(problem: Problem, fitted: Fitted, seed: int, report: Reporter) -> Draws | None:
    """Return draws of the posterior of a fit to runs on one floor each, None if they are useless.

    Args:
        problem: likelihood of the runs.
        fitted: fitted values around which the chain starts.
        seed: seed of all random numbers.
        report: reporter of the progress.
    """
    first = Density(problem, fitted, EVERYTHING if problem.objective.joint else MOTION)
    plan = replace(SHORT, seed=seed)
    blocks = ensemble.extended(first.target(), plan, "for intervals", None, report)
    x = ensemble.chain(blocks, plan)[:, ::THINNED]
    ensembles, steps, walkers, size = x.shape
    x = x.transpose(0, 2, 1, 3).reshape(ensembles * walkers, steps, size)
    z = np.broadcast_to(fitted.z, (*x.shape[:2], len(fitted.z))).copy()
    z[..., first.structure] = x
    if not problem.objective.joint:
        second = Density(problem, fitted, ELECTRIC)
        if second.size:
            drawn, _ = electric_given_motion(first, second, fitted.covariance, x, seed, PROPOSALS)
            z[..., second.structure] = drawn
    found = Draws(z)
    if found.useful:
        return found
    report.line(
        "the short chain has too few effective draws: intervals are those of the Laplace "
        "approximation"
    )
    return None
