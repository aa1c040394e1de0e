"""A twin that tells its pose."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.robot.interface import Readings
from slipid.robot.twin import Twin, TwinState


class TellingTwin(Twin):
    """A twin whose readings have its true pose.

    Attributes:
        fix_std: how sure they are of place [m] and heading [rad]; NaN tells nothing.
    """

    fix_std: Float[Array, "2"] = eqx.field(kw_only=True)

    def step(
        self, state: TwinState, command: Float[Array, " wheel"], noise: Float[Array, " noise"]
    ) -> tuple[TwinState, Readings]:
        """State and readings a period after a command [rad/s]."""
        new, reading = super().step(state, command, noise)
        return new, replace(reading, fix=new.pose, fix_std=self.fix_std, fix_age=jnp.zeros(()))
