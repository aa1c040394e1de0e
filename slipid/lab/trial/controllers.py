"""Controllers that a trial compares: those of slipid, and published control laws."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.deploy.controllers import CONTROLLERS, ControllerRow
from slipid.lab.trial.published_laws import (
    GoswamiPadhy,
    Indiveri,
    TuningTask,
    by_gradient,
    by_swarm,
    inverse_kinematics,
)
from slipid.robot.closed_loop import Plant
from slipid.robot.controller import Law
from slipid.robot.deployed import DeployedRobot
from slipid.robot.gains import Gains
from slipid.robot.interface import PERIOD, Measurement, Readings
from slipid.robot.limits import Limits
from slipid.robot.trajectory import ROW_PERIOD, rectangle
from slipid.robot.twin import ActuatorModel
from slipid.support.errors import DataError

TUNING_STARTS = ((0.05, 0.0, 0.2), (0.0, 0.05, -0.2), (-0.05, 0.0, 0.2), (0.0, -0.05, -0.2))
"""Start poses of the robot, relative to the start of the path, with which the gains of published
control laws are tuned [m, m, rad]."""


def _indiveri(robot: DeployedRobot) -> Law:
    """Return Indiveri's control law for the identified wheels, with slipid's hand-set gains."""
    numbers, wheels, gains = robot.record.parameters, robot.record.wheels, Gains()
    matrix = inverse_kinematics(
        np.asarray(robot.places),
        np.asarray(wheels.drive_angle) + np.asarray(numbers["robot.drive_offset"].value),
        np.asarray(wheels.roller_angle),
        float(robot.frame.radius) * (1 + np.asarray(numbers["robot.radius_deviation"].value)),
    )
    both = jnp.stack([gains.place, gains.yaw])
    return Indiveri(jnp.asarray(matrix), both, jnp.asarray(Limits.of(robot).wheel_speed))


@cache
def _tuned_gains(by: Literal["swarm", "gradient"]) -> tuple[float, ...]:
    """Tune the gains of Goswami and Padhy's control law on two sides of the rectangle [1/s].

    The remaining two sides are mirror images of the first two. The tuning simulates a robot without
    slip, with the default delay and lag of twins, so that the gains are the same for all robots.
    """
    path, actuators = rectangle(), ActuatorModel()
    times, rows = np.arange(0.0, float(path.marks[1]), PERIOD), np.asarray(path.rows)
    own = ROW_PERIOD * np.arange(len(rows))
    reference = np.stack([np.interp(times, own, column) for column in rows.T], axis=1)
    task = TuningTask(
        reference, np.array(TUNING_STARTS), actuators.command_weights(), actuators.lag_gain, PERIOD
    )
    return tuple((by_swarm(task) if by == "swarm" else by_gradient(task)).tolist())


ROWS: Mapping[str, ControllerRow] = {
    **CONTROLLERS,
    "goswami_padhy": ControllerRow(
        "encoder",
        "law of Goswami and Padhy, gains by particle swarm",
        law=lambda _: GoswamiPadhy(jnp.asarray(_tuned_gains("swarm"))),
    ),
    "goswami_padhy_gradient": ControllerRow(
        "encoder",
        "law of Goswami and Padhy, gains by gradient",
        law=lambda _: GoswamiPadhy(jnp.asarray(_tuned_gains("gradient"))),
    ),
    "indiveri": ControllerRow(
        "encoder", "law of Indiveri, whose speed limit keeps the direction", law=_indiveri
    ),
    "true_pose": ControllerRow(
        "contact",
        "the controller's own limit: fixes of the true pose",
        designed=True,
        true_pose=True,
    ),
}
"""Controllers keyed by name: slipid's and the 2021 paper's, the published control laws, and the
limit of what an estimator can achieve."""
FIX_STD = 1e-3
"""Std with which a true pose is given to the estimator [m], [rad]."""


class TruePosePlant:
    """A plant whose readings contain its true pose, as a fix without delay."""

    def __init__(self, plant: Plant):
        self._plant = plant

    def reset(self) -> Measurement | Readings:
        """Return the first readings, with the pose."""
        return self._with_pose(self._plant.reset())

    def step(self, wheel_speed: Float[np.ndarray, " drive"]) -> Measurement | Readings:
        """Return the readings one control period after a command, with the pose."""
        return self._with_pose(self._plant.step(wheel_speed))

    @property
    def pose(self) -> tuple[float, float, float]:
        """True pose [m, m, rad]."""
        return self._plant.pose

    @property
    def power(self) -> float:
        """Total electric power of the motors [W]; NaN if the plant does not provide it."""
        return float(getattr(self._plant, "power", np.nan))

    def _with_pose(self, reading: Measurement | Readings) -> Measurement | Readings:
        std = jnp.full(2, FIX_STD)
        return replace(reading, fix=jnp.asarray(self.pose), fix_std=std, fix_age=jnp.zeros(()))


def applicable(names: Sequence[str], robot: DeployedRobot) -> tuple[str, ...]:
    """Return the controllers among `names` that can drive a robot.

    Raises:
        DataError: none of the controllers `names` can drive the robot.
    """
    kept = tuple(name for name in names if not ROWS[name].obstacle(robot))
    if not kept:
        reasons = "; ".join(f"{name}: {ROWS[name].obstacle(robot)}" for name in names)
        suited = [name for name, row in ROWS.items() if not row.obstacle(robot)]
        raise DataError(f"{reasons}; expected one of {', '.join(suited)}")
    return kept
