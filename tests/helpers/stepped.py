"""Steps of an estimator that are compiled once for all robots of one shape."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from slipid.robot.interface import Measurement


@partial(jax.jit, static_argnums=0)
def _step(rest: Any, arrays: Any, state: Any, z: Any, dt: Any) -> Any:
    return eqx.combine(arrays, rest).step(state, z, dt)


def _of_one_type(tree: Any) -> Any:
    """The tree without weak types, for which a step would be compiled anew."""
    return jax.tree.map(lambda x: jnp.asarray(x, x.dtype) if x.weak_type else x, tree)


def stepped(estimator: Any) -> Callable:
    """Its `step`, whose calls cost less than those of the interface; for long ways."""
    arrays, rest = eqx.partition(estimator, eqx.is_array)
    arrays, wheels = _of_one_type(jax.tree.map(jnp.asarray, arrays)), len(arrays.robot.forward)

    def step(state: Any, z: Any, dt: Any) -> Any:
        readings = z.filled(wheels) if isinstance(z, Measurement) else z
        return _step(rest, arrays, _of_one_type(state), readings, jnp.asarray(dt, float))

    return step
