"""Trees of arrays as one flat array: one leaf costs a compiled call least to dispatch."""

import itertools
import math
from typing import Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Tree = TypeVar("Tree")


class Flat(Generic[Tree]):
    """Which number of a tree lies where in a flat array.

    Args:
        like: a tree of arrays; every other one must have its structure and shapes.
    """

    def __init__(self, like: Tree):
        paths = jax.tree_util.tree_leaves_with_path(like)
        self._structure = jax.tree.structure(like)
        leaves = [leaf for _, leaf in paths]
        self._shapes = [jnp.shape(leaf) for leaf in leaves]
        self._kinds = [jnp.result_type(leaf) for leaf in leaves]
        ends = np.cumsum([0, *(math.prod(shape) for shape in self._shapes)]).tolist()
        self._places = [slice(a, b) for a, b in itertools.pairwise(ends)]
        self._names = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in paths]
        self.size: int = ends[-1]

    def place(self, name: str) -> slice:
        """Where a leaf lies, by its path: `place("pose")`, `place("wheels.angle")`.

        Raises:
            KeyError: no such leaf; names those there are.
        """
        if name not in self._names:
            raise KeyError(f"no '{name}'; there are {', '.join(self._names)}")
        return self._places[self._names.index(name)]

    def ravel(self, tree: Tree) -> Float[Array, " flat"]:
        """The flat array of a tree.

        Raises:
            ValueError: it has another structure.
        """
        structure: object = jax.tree.structure(tree)
        if structure != self._structure:
            raise ValueError(f"a tree of {structure}; expected one of {self._structure}")
        leaves = jax.tree.leaves(tree)
        return jnp.concatenate([jnp.asarray(x).reshape(-1).astype(float) for x in leaves])

    def unravel(self, flat: Float[Array, "*batch flat"] | Float[np.ndarray, "*batch flat"]) -> Tree:
        """The tree of a flat array, its leaves of the same library, batch axes in front."""
        batch = flat.shape[:-1]
        leaves = [
            flat[..., place].reshape(batch + shape).astype(kind)
            for place, shape, kind in zip(self._places, self._shapes, self._kinds, strict=True)
        ]
        tree: Tree = jax.tree.unflatten(self._structure, leaves)
        return tree
