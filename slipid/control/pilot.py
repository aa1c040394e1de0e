"""An estimator and a controller as one pure function."""

from typing import Generic

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.control.controller import Controller, ControllerState
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
