"""Residuals at the end of a fit, what the data know there, and how far its own step still leads."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array

from slipid.identify.fit.problem import Problem, log_jacobian
from slipid.identify.fit.variances import Search, Square, Vector


@dataclass(frozen=True, eq=False)
class Rows:
    """Residuals at a search vector, block by block, with what they are weighed by.

    Roots are of the inverse covariance, weights of outliers (about 1, small for one) included; gram
    is the information of all rows without those weights, in prior stds.
    """

    residual: dict[str, np.ndarray]
    jacobian: dict[str, np.ndarray]
    roots: dict[str, np.ndarray]
    weight: dict[str, np.ndarray]
    whitened: dict[str, np.ndarray]
    gram: Square


def rows_at(problem: Problem, z: Vector, log_v: Vector) -> Rows:
    """Residuals of a problem at a search vector and these log variances."""
    linear = problem.linear(z, problem.volt(log_v))
    weighed = problem.whitening(linear[0], log_v, np.ones(len(problem.windows)))[:2]
    residual, jacobian, roots, weight = jax.device_get((*linear, *weighed))
    # roots of V^-1 without the weights of outliers
    plain = {k: root / np.sqrt(weight[k])[:, None, None] for k, root in roots.items()}
    gram = np.zeros((problem.space.size,) * 2)
    for k, jac in jacobian.items():
        half = np.einsum("nij,njp->nip", plain[k], jac).reshape(-1, len(gram))
        half = half * problem.space.prior_std
        gram += half.T @ half
    whitened = {k: np.einsum("nij,nj->ni", plain[k], r) for k, r in residual.items()}
    return Rows(residual, jacobian, roots, weight, whitened, gram)


def spectrum(gram: Square) -> Search:
    """Singular values of the Jacobian whose Gram matrix this is, the largest first."""
    return np.sqrt(np.maximum(np.linalg.eigvalsh(gram)[::-1], 0.0))


def remaining(problem: Problem, z: Search, volt: Array, rows: Rows) -> tuple[float, str]:
    """Largest step of a full Gauss-Newton step in posterior stds, and the number that takes it.

    delta = -(J^T W J + S^-2)^-1 (J^T W r + S^-2 (z - mean) - g), W with the weights of outliers, g
    the slope of log |d residuals / d data|; where currents do not inform motion, their rows move
    the electric numbers only.
    """
    own = problem.space.electric.astype(float)
    prior = problem.space.prior_std**-2
    _, slope = log_jacobian(problem.target, z, volt, np.ones(len(problem.windows)))
    gradient = prior * (z - problem.space.prior_mean) - np.asarray(slope)
    info = np.diag(prior)
    for k, r in rows.residual.items():
        root = rows.roots[k]
        white = np.einsum("nij,nj->ni", root, r).ravel()
        half = np.einsum("nij,njp->nip", root, rows.jacobian[k]).reshape(-1, len(z))
        half = half * (1.0 if k == "motion" else own)
        gradient = gradient + half.T @ white
        info = info + half.T @ half
    std = np.sqrt(np.diag(np.linalg.inv(info)))
    steps = np.abs(np.linalg.solve(info, gradient)) / std
    worst = int(np.argmax(steps))
    return float(steps[worst]), problem.space.names[worst]
