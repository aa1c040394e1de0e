"""From a force balance that forecasts to a deployed robot, without the verdicts of a whole fit."""

from collections.abc import Mapping
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from slipid.control.deployed import DeployedRobot
from slipid.control.robot_file.record import Number, Sensors
from slipid.deploy.deploy import DRAWS
from slipid.deploy.record_of import plain, record_of
from slipid.deploy.told import told_by_load
from slipid.identify.compare.predictive import Contact
from slipid.identify.result import draws
from slipid.model.robot import Robot
from slipid.parameter import entries


def robot_of(
    contact: Contact,
    highest_speed: float,
    current_trend: tuple[float, float] = (0.0, 0.0),
    sensors: Sensors | None = None,
    load: str | None = None,
) -> DeployedRobot:
    """The robot of a fit as `slipid.deploy.deploy` has it, but for what a reader is told of it.

    Args:
        contact: the fit.
        highest_speed: of the wheels in the fitted runs [rad/s].
        current_trend: of the currents in the fitted runs, see
            `slipid.identify.slip_curves.current_trend`.
        sensors: of the logs; None where they are not known.
        load: set-up it drives with, the first one by default.
    """
    several = draws(contact.z, contact.covariance, DRAWS, seed=0)
    record = record_of(
        contact.robot,
        given(contact.robot),
        {name: float(np.sqrt(v)) for name, v in contact.forecast.items()},
        jax.vmap(contact.space.tree)(jnp.asarray(several)),
        highest_speed,
        current_trend,
        {},
        told_by_load(contact, contact.z, several),
    )
    return DeployedRobot.of(replace(record, sensors=sensors or Sensors()), load)


def given(robot: Robot) -> Mapping[str, Number]:
    """The numbers of a robot as they were given, by path."""
    return {
        e.path: Number(
            value=plain(np.asarray(e.get(robot))),
            unit=e.declaration.unit,
            std=None,
            interval90=None,
            verdict="fixed",
            provenance="override",
            source="given",
        )
        for e in entries(robot)
    }
