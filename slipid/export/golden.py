"""Steps that an exported program must repeat: what goes in, and what the library makes of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.robot.closed_loop import PERIOD, ControlLoop
from slipid.robot.interface import Readings

STEPS = 48


@dataclass(frozen=True)
class Golden:
    """Steps in a row from rest at 0, 0, 0, a row each.

    Attributes:
        given: leaves of the reading, the reference, and dt; said: leaves of the estimate.
        command: wheel speeds [rad/s].
    """

    given: Float[np.ndarray, "step given"]
    said: Float[np.ndarray, "step said"]
    command: Float[np.ndarray, "step wheel"]


def golden(pilot: ControlLoop[eqx.Module]) -> Golden:
    """A drive in which every sensor speaks up, and is silent, once."""
    run = jax.jit(lambda *given: _step(pilot, *given))
    begin = pilot.init()
    state, rows = (begin.seen, begin.held), []
    for z, reference, dt in _drive(pilot):
        state, said, command = run(state, z, reference, dt)
        rows.append((_flat((z, reference, dt)), _flat(said), np.asarray(command)))
    given, estimates, commands = zip(*rows, strict=True)
    return Golden(np.array(given), np.array(estimates), np.array(commands))


def _step(
    pilot: ControlLoop[eqx.Module], state: tuple, z: Readings, reference: jax.Array, dt: jax.Array
) -> tuple:
    seen, said = pilot.estimator.step(state[0], z, dt)
    held, command = pilot.controller.step(state[1], reference, said, dt)
    return (seen, held), said, command


def _drive(pilot: ControlLoop[eqx.Module]) -> Iterator[tuple[Readings, jax.Array, float]]:
    """Readings, references and time steps: a late and a lost one, and wheels silent for long."""
    robot = pilot.controller.robot
    angle, count = np.zeros(robot.wheels), robot.wheels
    for step in range(STEPS):
        t = step * PERIOD
        twist = np.array([0.15 * np.cos(2 * t), 0.12 * np.sin(3 * t), 0.4 * np.sin(t)])
        speed = np.asarray(robot.forward) @ twist / float(robot.frame.radius)
        angle = angle + speed * PERIOD
        z = Readings.nothing(count)
        if step not in (9, *range(26, 34)):
            z = eqx.tree_at(lambda z: z.wheel_angle, z, jnp.asarray(angle))
        if step % 5:
            amps = 0.4 + 0.1 * np.sin(t + np.arange(count))
            z = eqx.tree_at(lambda z: z.current, z, jnp.asarray(amps))
        if step > 40:
            z = eqx.tree_at(lambda z: z.wheel_angle, z, jnp.full(count, jnp.nan))
            z = eqx.tree_at(lambda z: z.wheel_speed, z, jnp.asarray(speed))
        if step > 17:
            z = eqx.tree_at(lambda z: z.voltage, z, jnp.asarray(0.3 * speed))
        if 6 <= step < 16:
            z = eqx.tree_at(lambda z: z.gyro, z, jnp.asarray(twist[2] + 0.01))
        if step in (12, 20):
            fix = jnp.asarray([0.05, 0.02, 0.05]), jnp.asarray([0.01, 0.02]), jnp.asarray(0.08)
            z = eqx.tree_at(lambda z: (z.fix, z.fix_std, z.fix_age), z, fix)
        reference = jnp.asarray([0.15 * t, 0.05 * t, 0.1 * t, 0.15, 0.05, 0.1])
        yield z, reference, {5: 0.02, 15: 0.13, 37: 0.0}.get(step, PERIOD)


def _flat(tree: object) -> Float[np.ndarray, " flat"]:
    leaves = [np.asarray(leaf, float).reshape(-1) for leaf in jax.tree.leaves(tree)]
    return np.concatenate(leaves)
