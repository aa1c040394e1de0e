"""Types of arrays in maps."""

from typing import TypeVar

import numpy as np
from jaxtyping import Array, Float

Matrix = Float[np.ndarray, "_ _"]
Vector = Float[np.ndarray, " _"]
Leaf = Array | np.ndarray
"""An array of numpy while a map is learnt, of jax where the way back is computed."""
A = TypeVar("A", Array, np.ndarray)
"""Either of them; what comes out is what went in."""
