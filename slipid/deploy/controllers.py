"""Named combinations of estimator and controller, for trials and exports."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from slipid.robot.closed_loop import ControlLoop
from slipid.robot.controller import Controller, Correction, Law
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator, Odometry
from slipid.robot.filter.floor import Floor
from slipid.robot.gains import Gains
from slipid.robot.interface import AbstractEstimator, Settings
from slipid.support.errors import DataError

PAPER_WHEELS = 3
"""Number of wheels of the 2021 paper's robot."""


@dataclass(frozen=True)
class ControllerRow:
    """A combination of estimator and controller.

    Attributes:
        observer: estimator: `encoder` (odometry without slip), `curve` (odometry with each wheel's
            slip computed from its current) or `contact` (`slipid.Estimator`).
        about: description for people, in the output of `slipid trial`.
        correction: torque correction of the 2021 paper, see `slipid.robot.controller.Controller`.
        law: function from a robot to a published control law that replaces the pose loop; None for
            the pose loop.
        tuned: True to use the gains of `Gains.of`, designed or tuned; False for gains set by hand.
        gyro: True if the robot has a gyro.
        mapped: True if the estimator uses a map of the site's floors.
    """

    observer: str
    about: str
    correction: Correction = "none"
    law: Callable[[DeployedRobot], Law] | None = None
    tuned: bool = False
    gyro: bool = False
    mapped: bool = False

    def drives(self, robot: DeployedRobot) -> bool:
        """Return whether the row applies to a robot.

        Torque corrections have gains only for robots with three omni wheels.
        """
        if self.correction == "none":
            return True
        return robot.holonomic and robot.wheels == PAPER_WHEELS


CONTROLLERS: Mapping[str, ControllerRow] = {
    "encoder": ControllerRow("encoder", "odometry from encoders, without slip"),
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
        "contact", "contact estimator, gains designed if delay and lag are known", tuned=True
    ),
    "contact_hand": ControllerRow("contact", "contact estimator, gains set by hand"),
    "contact_map": ControllerRow(
        "contact", "contact estimator with a map of the floors", tuned=True, mapped=True
    ),
    "contact_gyro": ControllerRow(
        "contact", "contact estimator with a gyro", tuned=True, gyro=True
    ),
}
"""Combinations of estimator and controller, keyed by the name that users give."""


def control_loop_of(
    robot: DeployedRobot,
    row: ControllerRow,
    settings: Settings | None = None,
    forced: bool = False,
    floor: Floor | None = None,
) -> ControlLoop[eqx.Module]:
    """Return the control loop of a row for a robot.

    The gains are those of `Gains.of` if `row.tuned` is True, else those set by hand; `forced` is
    True to use tuned gains even if they are no better. `floor` is used if `row.mapped` is True.

    Raises:
        DataError: the row does not apply to the robot's wheels.
    """
    if not row.drives(robot):
        raise DataError(
            f"the torque correction of the 2021 paper has gains for {PAPER_WHEELS} wheels, but "
            f"this robot has {robot.wheels}; expected a controller without torque correction"
        )
    gains = Gains.of(robot, forced) if row.tuned else Gains()
    estimator: AbstractEstimator[Any] = Estimator(robot, settings, floor if row.mapped else None)
    if row.observer != "contact":
        estimator = Odometry(robot, settings, curve=row.observer == "curve")
        gains = replace(gains, preview=jnp.asarray(0.0))  # the 2021 paper's loop has no preview
    law = None if row.law is None else row.law(robot)
    controller = Controller(
        robot, gains, correction=row.correction, law=law, recovery=row.gyro or None
    )
    return ControlLoop(estimator, controller)
