"""Padding of the arrays of several runs to one array."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Shaped


def padded(
    runs: Sequence[Shaped[np.ndarray, "_ *of"]], shape: tuple[int, int], fill: float = 0.0
) -> Shaped[np.ndarray, "run row *of"]:
    """Return arrays of runs in one array of this shape (run, row), padded with `fill`."""
    out = np.full((*shape, *runs[0].shape[1:]), fill, dtype=runs[0].dtype)
    for k, rows in enumerate(runs):
        out[k, : len(rows)] = rows
    return out
