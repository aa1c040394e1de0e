"""An estimator and a controller as one pure function, and that compiled for a robot's computer."""

from collections.abc import Callable
from typing import Generic

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.control.controller import Controller, ControllerState
from slipid.control.flat import Flat
from slipid.control.interface import (
    AbstractEstimator,
    Estimate,
    Measurement,
    Numbers,
    Pose,
    Readings,
    State,
)
from slipid.control.trajectory import Path


class PilotState(eqx.Module, Generic[State]):
    """What a pilot keeps: state of its estimator, of its controller, time of the path [s]."""

    seen: State
    held: ControllerState
    time: Float[Array, ""]


class PilotOutput(eqx.Module):
    """What a pilot says after a step: wheel speeds [rad/s], an estimate, time of the path [s].

    Runs have leading axes in front of every array.
    """

    command: Float[Array, " wheel"]
    estimate: Estimate
    time: Float[Array, ""]


class Pilot(eqx.Module, Generic[State]):
    """An estimator of any kind and a controller as one pure function."""

    estimator: AbstractEstimator[State]
    controller: Controller

    def init(self, pose: Pose = (0.0, 0.0, 0.0)) -> PilotState[State]:
        """State of a robot at rest at a pose [m, m, rad], at the start of its path."""
        seen = self.estimator.init(jnp.asarray(pose, dtype=float))
        return PilotState(seen, self.controller.init(), jnp.zeros(()))

    def step(
        self,
        path: Path,
        state: PilotState[State],
        measurement: Measurement | Readings,
        dt: Float[Numbers, ""] | float,
    ) -> tuple[PilotState[State], PilotOutput]:
        """Next state, and what is commanded and believed."""
        dt = jnp.asarray(dt, dtype=float)
        seen, estimate = self.estimator.step(state.seen, measurement, dt)
        here = jnp.where(jnp.isfinite(estimate.pose), estimate.pose, 1e3)
        time, reference = path.follow(state.time, here, dt, self.controller.gains.preview)
        held, command = self.controller.step(state.held, reference, estimate, dt)
        return PilotState(seen, held, time), PilotOutput(command, estimate, time)


class CompiledPilot(Generic[State]):
    """A pilot's step on numpy arrays, cheapest to call: (state, measurement, dt) to both arrays.

    The robot's numbers and the path become constants of the compiled code, and one flat array goes
    in and one comes out; handing over the pilot's leaves at every call costs 100 us, and making the
    named types 10. `states`, `measurements` and `outputs` say where the numbers lie. Where
    `jax_cpu_enable_async_dispatch` is off before JAX starts, nothing waits for another thread
    (8 us less, more on a busy machine).

    Attributes:
        states, measurements, outputs: order of the numbers of each flat array.
        call: the step.
    """

    def __init__(self, pilot: Pilot[State], path: Path):
        """Prepare a pilot for a path as it lies for the start; the first call compiles."""
        self.pilot = pilot
        begin, nothing = pilot.init(), Readings.nothing(pilot.controller.robot.wheels)
        said = eqx.filter_eval_shape(pilot.step, path, begin, nothing, 0.0)[1]
        self.states, self.measurements, self.outputs = Flat(begin), Flat(nothing), Flat(said)
        self.call = self._call(path)

    def init(self, pose: Pose = (0.0, 0.0, 0.0)) -> Float[np.ndarray, " state"]:
        """Flat state of a robot at rest at a pose [m, m, rad]."""
        return np.asarray(self.states.ravel(self.pilot.init(pose)))

    def _call(
        self, path: Path
    ) -> Callable[[np.ndarray, np.ndarray, float], tuple[np.ndarray, np.ndarray]]:
        size = self.states.size
        last = size + self.measurements.size
        given = np.zeros(last + 1, np.asarray(self.pilot.init().time).dtype)

        def step(flat: Array) -> Array:
            state = self.states.unravel(flat[:size])
            z = self.measurements.unravel(flat[size:last])
            new, said = self.pilot.step(path, state, z, flat[last])
            return jnp.concatenate([self.states.ravel(new), self.outputs.ravel(said)])

        run = jax.jit(step)

        def call(
            state: np.ndarray, measurement: np.ndarray, dt: float
        ) -> tuple[np.ndarray, np.ndarray]:
            given[:size], given[size:last], given[last] = state, measurement, dt
            both = np.asarray(run(given))
            return both[:size], both[size:]

        return call
