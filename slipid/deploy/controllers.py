"""The controllers of a trial, each a row of its table, and the gains they have."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from slipid.control.closed_loop import Pilot
from slipid.control.controller import Controller, Correction, Gains
from slipid.control.deployed import DeployedRobot
from slipid.control.estimator import Estimator, Odometry
from slipid.control.filter.floor import Floor
from slipid.control.interface import AbstractEstimator, Settings
from slipid.support.errors import DataError


@dataclass(frozen=True)
class Row:
    """One controller of the trial.

    Attributes:
        observer: `encoder`, `curve` (slip over current, wheel by wheel) or `contact`.
        about: one sentence for people.
        correction: of the 2021 paper.
        tuned: whether it has the gains of `slipid tune`, where they are better than by hand.
        ahead: whether wheel speeds come from the contact model, whatever the gains say.
        gyro: whether the robot has one.
        mapped: whether it is told the map of its floors.
    """

    observer: str
    about: str
    correction: Correction = "none"
    tuned: bool = False
    ahead: bool = False
    gyro: bool = False
    mapped: bool = False

    def drives(self, robot: DeployedRobot) -> bool:
        """Whether it applies: torque corrections have gains of the 2021 paper's three wheels."""
        return self.correction == "none" or robot.wheels == PAPER_WHEELS


PAPER_WHEELS = 3
"""Of the 2021 paper's robot."""
ROWS: Mapping[str, Row] = {
    "encoder": Row("encoder", "believes its encoders"),
    "slip_odometry": Row("curve", "odometry less slip over current (figure 5)"),
    "paper_print": Row("curve", "and torque correction as printed", "paper_print"),
    "paper_code": Row("curve", "and torque correction as its authors ran it", "paper_code"),
    "torque": Row("curve", "and torque correction, corrected", "torque"),
    "contact": Row("contact", "contact estimator, tuned gains where they are better", tuned=True),
    "contact_ahead": Row("contact", "and wheel speeds by the contact model", ahead=True),
    "contact_map": Row("contact", "contact, told the map of its floors", tuned=True, mapped=True),
    "contact_gyro": Row("contact", "contact, with a gyro", tuned=True, gyro=True),
}


def applying(names: Sequence[str], robot: DeployedRobot) -> tuple[str, ...]:
    """The controllers among these that apply to a robot.

    Raises:
        DataError: none does.
    """
    kept = tuple(name for name in names if ROWS[name].drives(robot))
    if not kept:
        raise DataError(
            f"{', '.join(names)}: for robots with {PAPER_WHEELS} wheels, as that of the 2021 "
            f"paper; this one has {robot.wheels}, expected some of "
            f"{', '.join(name for name, row in ROWS.items() if row.drives(robot))}"
        )
    return kept


def check_gains(out: Path, robot: DeployedRobot, forced: bool) -> None:
    """Refuse gains that `slipid tune` found for other numbers or another load set-up.

    So are gains that are wanted (`forced`) and not there.
    """
    tuned, path = robot.record.gains, out / "gains.json"
    if tuned is None and path.is_file():
        raise DataError(
            f"{path}: tuned for another fit; run slipid tune again, or remove it to drive with "
            "gains set by hand"
        )
    if forced and tuned is None:
        raise DataError(
            f"{out / 'robot.json'}: it has no tuned gains; run slipid tune, or leave out "
            "--tuned-gains"
        )
    if tuned is not None and (tuned.is_better or forced) and tuned.load != robot.load_setup:
        raise DataError(
            f"{out / 'robot.json'}: gains were tuned for another load set-up ({tuned.load}); run "
            f"slipid tune again with --load {robot.load_setup}"
        )


def unused_gains(robot: DeployedRobot, forced: bool) -> str:
    """What a driver must know of tuned gains that are not taken; empty where there are none."""
    tuned = robot.record.gains
    if tuned is None or tuned.is_better or forced:
        return ""
    return (
        f"tuned gains are {tuned.verdict} (loss {tuned.loss.tuned:.1f} mm, by hand "
        f"{tuned.loss.hand:.1f} mm): driving with those set by hand; --tuned-gains takes the others"
    )


def pilot_of(
    robot: DeployedRobot,
    row: Row,
    settings: Settings | None = None,
    forced: bool = False,
    floor: Floor | None = None,
) -> Pilot[eqx.Module]:
    """Estimator and controller of a row; some rows have the gains tuned for the robot.

    Those are taken where they are better than gains set by hand, or forced. A map of the floors is
    told to the rows that may know it.

    Raises:
        DataError: the row does not apply to the robot's wheels.
    """
    if not row.drives(robot):
        raise DataError(
            f"the torque correction of the 2021 paper has gains for {PAPER_WHEELS} wheels; this "
            f"robot has {robot.wheels}"
        )
    own = Gains.of(robot, forced) if row.tuned else Gains()
    if row.ahead:
        own = replace(own, ahead=jnp.asarray(1.0))
    estimator: AbstractEstimator[Any] = Estimator(robot, settings, floor if row.mapped else None)
    if row.observer != "contact":
        estimator = Odometry(robot, settings, curve=row.observer == "curve")
        own = replace(own, preview=jnp.asarray(0.0))  # the paper's loop has none
    return Pilot(estimator, Controller(robot, own, correction=row.correction))
