"""Named combinations of estimator and controller, for trials and exports."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.parameter import as_numbers
from slipid.robot.closed_loop import ControlLoop
from slipid.robot.controller import Controller, Correction, Law
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator, Odometry
from slipid.robot.filter.floor import Floor
from slipid.robot.gains import Gains
from slipid.robot.interface import AbstractEstimator, Settings
from slipid.robot.record import Rows
from slipid.support.errors import DataError

PAPER_WHEELS = 3
"""Number of wheels of the 2021 paper's robot."""


@dataclass(frozen=True)
class ControllerRow:
    """A combination of estimator and controller.

    Attributes:
        observer: estimator: `encoder` (odometry with the lengths of the config, without slip),
            `calibrated` (odometry with calibrated lengths, the mean over floors), `curve` (odometry
            with each wheel's slip computed from its current) or `contact` (`slipid.Estimator`).
        about: description for people, in the output of `slipid trial`.
        correction: torque correction of the 2021 paper, see `slipid.robot.controller.Controller`.
        law: function from a robot to a published control law that replaces the pose loop; None for
            the pose loop.
        designed: True to use the gains of `Gains.of`; False for gains set by hand.
        gyro: True if the robot has a gyro.
        mapped: True if the estimator uses a map of the site's floors.
        true_pose: True if the estimator receives the true pose as a pose fix in every period.
    """

    observer: str
    about: str
    correction: Correction = "none"
    law: Callable[[DeployedRobot], Law] | None = None
    designed: bool = False
    gyro: bool = False
    mapped: bool = False
    true_pose: bool = False

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of what the row needs besides encoders and ammeters: gyro, map, true pose."""
        parts = {"gyro": self.gyro, "map": self.mapped, "true pose": self.true_pose}
        return tuple(name for name, needed in parts.items() if needed)

    def obstacle(self, robot: DeployedRobot) -> str:
        """Return why the row does not apply to a robot; empty if it applies.

        Published laws and slip curves are for robots that can drive sideways, and torque
        corrections have gains only for three omni wheels.
        """
        if self.correction != "none" and not (robot.holonomic and robot.wheels == PAPER_WHEELS):
            return f"only for robots with {PAPER_WHEELS} wheels, like that of the 2021 paper"
        if (self.law is not None or self.observer == "curve") and not robot.holonomic:
            return "only for robots that can drive sideways"
        if self.observer == "calibrated" and not _calibrations(robot):
            return "robot.json has no calibration; write it again with `slipid identify`"
        return ""


CONTROLLERS: Mapping[str, ControllerRow] = {
    "encoder": ControllerRow("encoder", "odometry from encoders, without slip"),
    "calibrated": ControllerRow(
        "calibrated",
        "odometry from encoders with calibrated lengths (effective track and radius)",
        designed=True,
    ),
    "slip_odometry": ControllerRow("curve", "odometry corrected by slip over current (figure 5)"),
    "paper_print": ControllerRow(
        "curve", "slip odometry and the torque correction as printed", "paper_print"
    ),
    "paper_code": ControllerRow(
        "curve", "slip odometry and the torque correction as in the authors' program", "paper_code"
    ),
    "torque": ControllerRow(
        "curve", "slip odometry and the torque correction without its two errors", "torque"
    ),
    "contact": ControllerRow(
        "contact", "contact estimator, gains designed if delay and lag are known", designed=True
    ),
    "contact_hand": ControllerRow("contact", "contact estimator, gains set by hand"),
    "contact_map": ControllerRow(
        "contact", "contact estimator with a map of the floors", designed=True, mapped=True
    ),
    "contact_gyro": ControllerRow(
        "contact", "contact estimator with a gyro", designed=True, gyro=True
    ),
}
"""Combinations of estimator and controller, keyed by the name that users give."""


def control_loop_of(
    robot: DeployedRobot,
    row: ControllerRow,
    settings: Settings | None = None,
    floor: Floor | None = None,
    recovery: bool | None = None,
) -> ControlLoop[eqx.Module]:
    """Return the control loop of a row for a robot.

    The gains are those of `Gains.of` if `row.designed` is True, else those set by hand. `floor` is
    used if `row.mapped` is True.
    `recovery` is True if a stuck robot may try to free itself; None if the row has a gyro or the
    robot's logs have one.

    Raises:
        DataError: the row does not apply to the robot.
    """
    if obstacle := row.obstacle(robot):
        raise DataError(f"{row.about}: {obstacle}; expected another controller")
    robot = _known(row, robot)
    gains = Gains.of(robot) if row.designed else Gains()
    estimator: AbstractEstimator[Any] = Estimator(robot, settings, floor if row.mapped else None)
    if row.observer != "contact":
        estimator = Odometry(robot, settings, curve=row.observer == "curve")
    if row.observer in ("encoder", "curve"):
        gains = replace(gains, preview=jnp.asarray(0.0))  # the 2021 paper's loop has no preview
    if recovery is None and row.gyro:
        recovery = True
    law = None if row.law is None else row.law(robot)
    controller = Controller(robot, gains, correction=row.correction, law=law, recovery=recovery)
    return ControlLoop(estimator, controller)


def centre_of(row: ControllerRow, robot: DeployedRobot) -> float:
    """Return how far ahead of its middle a robot turns on the spot by the row's model [m].

    For the contact estimator it is the mean over the floors that were driven on, by the model that
    was selected for each.
    """
    if robot.holonomic:
        return 0.0
    known = _known(row, robot)
    speed = jnp.asarray(known.forward[:, 2] / known.frame.radius)
    if row.observer == "contact":
        driven = np.flatnonzero(~np.array(robot.unseen)).tolist()
        twists = [_twist_on(robot, k, speed) for k in driven]
    else:
        twists = [known.inverse @ (known.frame.radius * speed)]
    return float(np.mean([-twist[1] / twist[2] for twist in twists]))


def _twist_on(robot: DeployedRobot, floor: int, speed: Array) -> Array:
    """Return the twist at wheel speeds of the drives [rad/s], with all wheels on one floor."""
    if robot.calibrated[floor]:
        return robot.kinematics[floor] @ speed
    under = jnp.full(robot.wheels, floor)
    return robot.standing(under).twist(robot.at_wheels(speed))


def _known(row: ControllerRow, robot: DeployedRobot) -> DeployedRobot:
    """Return a robot with the lengths by which the row's odometry rolls."""
    if row.observer == "encoder" and robot.record.nominal is not None:
        return _rolling_by(robot, np.array(robot.record.nominal))
    if row.observer == "calibrated":
        return _rolling_by(robot, np.mean(_calibrations(robot), axis=0))
    return robot


def _calibrations(robot: DeployedRobot) -> list[Rows]:
    """Return the calibrated kinematics of the floors that have them."""
    return [floor.calibration for floor in robot.record.floors if floor.calibration is not None]


def _rolling_by(robot: DeployedRobot, to_twist: Float[np.ndarray, "3 drive"]) -> DeployedRobot:
    """Return a robot whose wheels roll without slip by a matrix from wheel speeds to twist."""
    radius, axes = robot.frame.radius, [0, 1, 2] if robot.holonomic else [0, 2]
    to_wheels = np.zeros(to_twist.T.shape)
    to_wheels[:, axes] = np.linalg.pinv(to_twist[axes])
    forward, inverse = radius * as_numbers(to_wheels), as_numbers(to_twist) / radius
    return replace(robot, forward=forward, inverse=inverse)
