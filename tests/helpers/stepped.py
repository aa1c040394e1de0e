"""Steps of an estimator that are compiled once for all robots of one shape and one settings."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax


@partial(jax.jit, static_argnums=0)
def _step(rest: Any, arrays: Any, state: Any, z: Any, dt: Any) -> Any:
    return eqx.combine(arrays, rest).step(state, z, dt)


def stepped(estimator: Any) -> Callable:
    """Its `step`, whose calls cost less than those of the interface; for long ways."""
    arrays, rest = eqx.partition(estimator, eqx.is_array)
    return partial(_step, rest, arrays)
