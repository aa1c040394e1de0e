"""Load shares from what scales show, and from masses whose place is known.

A mass m at p adds weights n_i to wheels at p_i, with sum n_i = m and sum n_i p_i = m p. Three
wheels have one solution; of more, the smallest is taken, as for wheels that give alike.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from slipid.job.config import Weights
from slipid.model.geometry import Geometry
from slipid.search_space import Choice


def share_priors(weights: Mapping[str, Weights], shape: Geometry) -> dict[str, Choice]:
    """Prior of the load shares of every set-up that something is known of.

    Raises:
        ValueError: a set-up is like none that is known, or a wheel would be lifted.
    """
    out = {}
    for name in weights:
        kg, variance = _weighed(weights, name, shape, ())
        whole, std = kg.sum(), float(np.sqrt(variance)) / kg.sum()
        share = (kg / whole).tolist()
        out[name] = Choice(f"robot.load_share@{name}", prior_mean=share, prior_std=[std] * len(kg))
    return out


def _weighed(
    weights: Mapping[str, Weights], name: str, shape: Geometry, above: tuple[str, ...]
) -> tuple[Float[np.ndarray, " wheel"], float]:
    """Weight on each wheel [kg], and its variance."""
    known = weights.get(name)
    if known is None or name in above:
        there = ", ".join(k for k in weights if k not in above)
        raise ValueError(f"weights.{above[-1]}.like = {name}: expected one of {there or 'none'}")
    if known.kg is not None:
        if len(known.kg) != shape.wheels:
            raise ValueError(f"weights.{name}.kg: {len(known.kg)}; expected {shape.wheels} numbers")
        return np.asarray(known.kg), known.std_kg**2
    if known.like is None or known.mass_kg is None or known.place_m is None:
        raise ValueError(f"weights.{name}: expected kg, or like, mass_kg and place_m")
    below, variance = _weighed(weights, known.like, shape, (*above, name))
    place = np.asarray(shape.place) * float(shape.base_radius)
    balance = np.concatenate([np.ones((1, shape.wheels)), place.T])
    added = np.linalg.pinv(balance) @ (known.mass_kg * np.array([1.0, *known.place_m]))
    total = below + added
    if (total <= 0).any():
        wheel = int(np.argmin(total)) + 1
        raise ValueError(f"weights.{name}: wheel {wheel} would be lifted; expected weight on all")
    return total, variance + known.std_kg**2
