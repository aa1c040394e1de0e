"""What draws say of the data: the likelihood of every piece, and replicates of it."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from slipid.identify.fit.problem import DEGREES, Problem
from slipid.identify.posterior.coordinates import EVERYTHING
from slipid.identify.posterior.density import Density
from slipid.identify.posterior.sample import Posterior


def likelihoods(
    problem: Problem, found: Posterior
) -> dict[str, Float[np.ndarray, "ensemble draw piece"]]:
    """Log likelihood of every piece under every draw, by block of residuals."""
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
