"""Evaluation of compiled functions for any number of rows in blocks of one size."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

BLOCK = 512
"""Number of rows that are computed at a time."""


def in_blocks(of: Callable[..., Any], *rows: Any, block: int = BLOCK) -> Any:
    """Return the results of a compiled function for rows that do not depend on each other.

    JAX compiles a function anew for every shape. Here it sees blocks of one shape only; the last
    block is padded with copies of the last row.

    Args:
        of: function of arrays with `block` rows, which returns a tree of such arrays.
        rows: trees of arrays with equally many rows, one or more.
        block: number of rows that are computed at a time.
    """
    count = len(jax.tree.leaves(rows)[0])
    parts = []
    for first in range(0, count, block):
        at = np.minimum(np.arange(first, first + block), count - 1)
        parts.append(of(*jax.tree.map(lambda x, at=at: np.asarray(x)[at], rows)))
    return jax.tree.map(lambda *x: np.concatenate([np.asarray(a) for a in x])[:count], *parts)
