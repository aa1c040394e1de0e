"""Reference steps: inputs and outputs of slipid's own steps, which an export must reproduce."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.robot.closed_loop import ControlLoop
from slipid.robot.interface import PERIOD, Measurement, Readings, StateEstimate
from slipid.robot.supervision import ControllerState

GOLDEN_STEPS = 48
"""Number of reference steps; each sensor has readings in some of these steps, see `_inputs`."""


@dataclass(frozen=True)
class Golden:
    """Successive steps of a robot that starts at rest at the pose 0, 0, 0, one row for each step.

    Attributes:
        given: inputs of the step: all arrays of the reading, the reference, the twist, and dt [s],
            concatenated.
        said: outputs of the estimator: all arrays of the estimate, concatenated.
        command: outputs of the controller: wheel speeds [rad/s].
    """

    given: Float[np.ndarray, "step input"]
    said: Float[np.ndarray, "step output"]
    command: Float[np.ndarray, "step drive"]


def golden(loop: ControlLoop[eqx.Module]) -> Golden:
    """Return reference steps; every sensor has readings in some of them and none in others."""
    run = jax.jit(lambda *inputs: loop_step(loop, *inputs))
    begin = loop.init()
    state, rows = (begin.estimator, begin.controller), []
    for given in _inputs(loop):
        state, estimate, command = run(state, *given)
        rows.append((_flat(given), _flat(estimate), np.asarray(command)))
    return Golden(*map(np.array, zip(*rows, strict=True)))


def loop_step(
    loop: ControlLoop[eqx.Module],
    state: tuple[eqx.Module, ControllerState],
    z: Readings,
    reference: jax.Array,
    twist: jax.Array,
    dt: jax.Array,
) -> tuple[tuple[eqx.Module, ControllerState], StateEstimate, jax.Array]:
    """Return the next state, the estimate and the command of a control loop's step.

    Args:
        loop: estimator and controller.
        state: states of estimator and controller.
        z: readings.
        reference: pose and rates in the world [m, m, rad, m/s, m/s, rad/s].
        twist: velocity of the body to drive with instead [m/s, m/s, rad/s]; NaN to follow the
            reference.
        dt: time since the last step [s].
    """
    estimator, estimate = loop.estimator.step(state[0], z, dt)
    pursuing, asked = loop.controller.asked(state[1], reference, estimate, dt)
    pursues = jnp.all(jnp.isnan(twist))
    # without a reference to follow, the state is as if `asked` had not been called
    controller = jax.tree.map(lambda *of: jnp.where(pursues, *of), pursuing, state[1])
    twist = jnp.where(pursues, asked, twist)
    controller, command = loop.controller.drive(controller, twist, estimate, dt)
    return (estimator, controller), estimate, command


def _inputs(
    loop: ControlLoop[eqx.Module],
) -> Iterator[tuple[Readings, jax.Array, jax.Array, float]]:
    """Yield reading, reference, twist and time step of every reference step.

    Among the time steps are a short one, a long one and 0. Readings have gaps, one of which lasts
    longer than `Settings.stale_s`.
    """
    robot = loop.controller.robot
    angle = np.zeros(robot.drives)
    for step in range(GOLDEN_STEPS):
        t = step * PERIOD
        twist = np.array([0.15 * np.cos(2 * t), 0.12 * np.sin(3 * t), 0.4 * np.sin(t)])
        speed = np.asarray(robot.forward) @ twist / float(robot.frame.radius)
        angle = angle + speed * PERIOD
        has_angle, has_fix = step not in (9, *range(26, 34)) and step <= 40, step in (12, 20)
        z = Measurement(
            wheel_angle=angle if has_angle else None,
            wheel_speed=speed if step > 40 else None,
            current=0.4 + 0.1 * np.sin(t + np.arange(robot.drives)) if step % 5 else None,
            voltage=0.3 * speed if step > 17 else None,
            gyro=twist[2] + 0.01 if 6 <= step < 16 else None,
            fix=(0.05, 0.02, 0.05) if has_fix else None,
            fix_std=(0.01, 0.02) if has_fix else None,
            fix_age=0.08 if has_fix else None,
        ).filled(robot.drives)
        reference = jnp.asarray([0.15 * t, 0.05 * t, 0.1 * t, 0.15, 0.05, 0.1])
        asked = twist if step % 4 == 3 else np.full(3, np.nan)
        yield z, reference, jnp.asarray(asked), {5: 0.02, 15: 0.13, 37: 0.0}.get(step, PERIOD)


def _flat(tree: object) -> Float[np.ndarray, " flat"]:
    return np.concatenate([np.asarray(x, float).reshape(-1) for x in jax.tree.leaves(tree)])
