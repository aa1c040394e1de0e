"""A control loop on a twin as one function of JAX, for runs that are compiled, many at once."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.robot.closed_loop import ControlLoop, ControlLoopOutput, ControlLoopState
from slipid.robot.interface import PERIOD, Pose, Readings, State
from slipid.robot.trajectory import Path
from slipid.robot.twin import Twin, TwinState


def rollout(
    control_loop: ControlLoop[State], path: Path, twin: Twin, start: Pose, key: Array, steps: int
) -> tuple[Float[Array, "step 3"], ControlLoopOutput]:
    """True poses [m, m, rad] and what the control loop says over a fixed number of steps.

    A path that is over is a rest at its end.

    Args:
        control_loop, twin: who drives, and what is driven.
        path: as it lies for the start.
        start: where it stands and believes to stand [m, m, rad].
        key: of all that is drawn.
        steps: how many.
    """
    noise = jax.vmap(partial(twin.noise, key))(jnp.arange(steps + 1))
    state = twin.init(start, key)
    reading = twin.first(state, noise[0])

    def step(
        carry: tuple[TwinState, ControlLoopState[State], Readings], drawn: Array
    ) -> tuple[
        tuple[TwinState, ControlLoopState[State], Readings], tuple[Array, ControlLoopOutput]
    ]:
        before, held, reading = carry
        held, out = control_loop.step(path, held, reading, PERIOD)
        state, reading = twin.step(before, out.command, drawn)
        return (state, held, reading), (before.pose, out)

    return jax.lax.scan(step, (state, control_loop.init(start), reading), noise[1:])[1]
