"""Steps of generated C and of JAX from common states, compared number by number."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from slipid.robot.closed_loop import ControlLoop
from slipid.robot.interface import Readings
from tests.helpers.compiled_c import CompiledC

Draw = Callable[[Array, Array], tuple[Readings, Array]]
"""Readings and time steps of robots, from a key and the angles that their wheels have reached."""
LEAST = 1e-3
"""Scale of a field below which numbers count as 0."""


def wander(wheels: int) -> Draw:
    """Readings such as a robot has: its wheels turn at random, any sensor may be there or not."""

    def draw(key: Array, angle: Array) -> tuple[Readings, Array]:
        k = jax.random.split(key, 14)
        count = len(angle)
        there = [jax.random.bernoulli(k[9 + i], p, (count, 1)) for i, p in enumerate((0.8, 0.3))]
        some = (
            jax.random.bernoulli(k[11], 0.5, (count,)),
            jax.random.bernoulli(k[12], 0.05, (count,)),
        )
        normal = jax.random.normal
        turned = angle + 0.05 * 3.0 * normal(k[0], (count, wheels))
        z = Readings(
            wheel_angle=turned,
            wheel_speed=jnp.where(there[1], 3.0 * normal(k[1], (count, wheels)), jnp.nan),
            current=jnp.where(there[0], 0.5 + 0.4 * normal(k[2], (count, wheels)), jnp.nan),
            voltage=jnp.where(there[1], 8.0 * normal(k[3], (count, wheels)), jnp.nan),
            gyro=jnp.where(some[0], 0.8 * normal(k[4], (count,)), jnp.nan),
            fix=jnp.where(some[1][:, None], normal(k[5], (count, 3)), jnp.nan),
            fix_std=jnp.abs(0.02 * normal(k[6], (count, 2))),
            fix_age=jnp.abs(0.2 * normal(k[7], (count,))),
        )
        return z, jax.random.uniform(k[8], (count,), minval=0.02, maxval=0.1)

    return draw


@dataclass(frozen=True)
class Batch:
    """Steps of many robots by JAX, a leading axis on every array.

    Attributes:
        seen, held: states before; reading, reference, dt: what goes in.
        after: states, estimates and commands after.
    """

    seen: object
    held: object
    reading: Readings
    reference: np.ndarray
    dt: np.ndarray
    after: tuple[object, object, object, np.ndarray]


class Source:
    """Batches of steps by JAX, each of which goes on from the last."""

    def __init__(self, control_loop: ControlLoop, draw: Draw, robots: int, steps: int):
        wheels = control_loop.controller.robot.drives
        self._key, self._steps = jax.random.key(0), steps

        def one(given):
            seen, held, z, reference, dt = given
            seen, said = control_loop.estimator.step(seen, z, dt)
            held, command = control_loop.controller.step(held, reference, said, dt)
            return seen, held, said, command

        def go(carry, key):
            (seen, held), angle = carry
            own, other = jax.random.split(key)
            z, dt = draw(own, angle)
            gap = jax.random.normal(other, (robots, 6)) * jnp.array([0.1, 0.1, 0.3, 0.2, 0.2, 0.5])
            reference = gap.at[:, :3].add(jnp.nan_to_num(_pose(seen)))
            given = (seen, held, z, reference, dt)
            after = jax.lax.map(one, given)
            angle = jnp.where(jnp.isfinite(z.wheel_angle), z.wheel_angle, angle)
            return (after[:2], angle), (given, after)

        begin = control_loop.init()
        spread = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (robots, *x.shape)), (begin.estimator, begin.controller)
        )
        self._carry = spread, jnp.zeros((robots, wheels))
        self._go = jax.jit(lambda carry, keys: jax.lax.scan(go, carry, keys))

    def next(self) -> Batch:
        """The next batch."""
        self._key, own = jax.random.split(self._key)
        keys = jax.random.split(own, self._steps)
        self._carry, both = self._go(self._carry, keys)
        flat = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[2:]), both)
        (seen, held, z, reference, dt), after = flat
        return Batch(seen, held, z, reference, dt, after)


def _pose(seen: object) -> Array:
    place = getattr(seen, "place", seen)
    return place.pose  # type: ignore[no-any-return]


def records(like: np.ndarray, tree: object, count: int) -> np.ndarray:
    """Records with the leaves of a tree whose arrays have a leading axis."""
    out = np.zeros(count, like.dtype)
    names = like.dtype.names
    assert names is not None
    with np.errstate(over="ignore"):
        for name, leaf in zip(names, jax.tree.leaves(tree), strict=True):
            out[name] = leaf
    return out


def differences(compiled: CompiledC, batch: Batch) -> dict[str, np.ndarray]:
    """Largest difference of each field in each step, over the scale of the field in that step."""
    count = len(batch.dt)
    seen = records(compiled.estimator, batch.seen, count)
    held = records(compiled.controller, batch.held, count)
    reading = records(compiled.reading, batch.reading, count)
    said, command = compiled.many(seen, held, reading, batch.reference, batch.dt)
    out = {}
    own = batch.after
    for kind, got, tree in (("seen", seen, own[0]), ("held", held, own[1]), ("said", said, own[2])):
        for name, leaf in zip(got.dtype.names, jax.tree.leaves(tree), strict=True):
            out[f"{kind}.{name}"] = _gaps(got[name], np.asarray(leaf))
    out["command"] = _gaps(command, np.asarray(own[3]))
    return out


def _gaps(got: np.ndarray, want: np.ndarray) -> np.ndarray:
    a = got.reshape(len(got), -1).astype(float)
    b = want.reshape(len(want), -1).astype(float)
    if not a.shape[1]:
        return np.zeros(len(got))
    same = (np.isnan(a) & np.isnan(b)) | (a == b)
    with np.errstate(invalid="ignore", over="ignore"):
        gap = np.where(same, 0.0, np.abs(a - b))
        scale = np.maximum(np.nanmax(np.where(np.isfinite(b), np.abs(b), 0.0), axis=1), LEAST)
        out = np.max(np.where(np.isnan(gap), np.inf, gap), axis=1) / scale
    return np.asarray(out)
