"""Covariances of all runs together, written out."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np


def of_shared(problem, log_v):
    """What shared effects add to the covariance of the motion's residuals of all pieces."""
    n, m = problem.batch.pose.shape[0], problem.batch.dt.shape[1] * 3
    out = np.zeros((n, m, n, m))
    for of in problem.objective.shared:
        mine, root = np.asarray(of.segments), np.asarray(of.root(jnp.asarray(log_v)))
        effect = np.asarray(of.effect)
        both = np.einsum("ima,aiq,ajq,jla->imjl", effect, root, root, effect)
        out[np.ix_(mine, np.arange(m), mine, np.arange(m))] = both
    return out.reshape(n * m, n * m)
