"""A control loop's step compiled for a robot's computer, on flat arrays, to measure its time.

One leaf costs a compiled call least to dispatch.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.robot.closed_loop import ControlLoop
from slipid.robot.interface import Pose, Readings, State
from slipid.robot.trajectory import Path

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


class CompiledLoop(Generic[State]):
    """A control loop's step on numpy arrays: (state, measurement, dt) to both arrays.

    It is the cheapest to call. The robot's numbers and the path become constants of the compiled
    code, and one flat array goes in and one comes out; passing the loop's leaves at every call
    costs 100 us, and making the named types 10. `states`, `measurements` and
    `outputs` describe the arrays. With `jax_cpu_enable_async_dispatch` off before JAX starts,
    nothing waits for another thread (8 us less, more on a busy machine).

    Attributes:
        states, measurements, outputs: order of the numbers of each flat array.
        call: the step.
    """

    def __init__(self, control_loop: ControlLoop[State], path: Path):
        """Prepare a control loop for a path as it lies for the start; the first call compiles."""
        self.loop = control_loop
        begin, nothing = control_loop.init(), Readings.nothing(control_loop.controller.robot.wheels)
        said = eqx.filter_eval_shape(control_loop.step, path, begin, nothing, 0.0)[1]
        self.states, self.measurements, self.outputs = Flat(begin), Flat(nothing), Flat(said)
        self.call = self._call(path)

    def init(self, pose: Pose = (0.0, 0.0, 0.0)) -> Float[np.ndarray, " state"]:
        """Flat state of a robot at rest at a pose [m, m, rad]."""
        return np.asarray(self.states.ravel(self.loop.init(pose)))

    def _call(
        self, path: Path
    ) -> Callable[[np.ndarray, np.ndarray, float], tuple[np.ndarray, np.ndarray]]:
        size = self.states.size
        last = size + self.measurements.size
        given = np.zeros(last + 1, np.asarray(self.loop.init().time).dtype)

        def step(flat: Array) -> Array:
            state = self.states.unravel(flat[:size])
            z = self.measurements.unravel(flat[size:last])
            new, said = self.loop.step(path, state, z, flat[last])
            return jnp.concatenate([self.states.ravel(new), self.outputs.ravel(said)])

        run = jax.jit(step)

        def call(
            state: np.ndarray, measurement: np.ndarray, dt: float
        ) -> tuple[np.ndarray, np.ndarray]:
            given[:size], given[size:last], given[last] = state, measurement, dt
            both = np.asarray(run(given))
            return both[:size], both[size:]

        return call
