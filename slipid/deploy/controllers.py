"""The controllers of a trial, each a row of its table, and the gains they have."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from slipid.baselines.steering.goswami_padhy import (
    GoswamiPadhy,
    Rehearsal,
    by_gradient,
    by_swarm,
)
from slipid.baselines.steering.indiveri import Indiveri, inverse_kinematics
from slipid.control.actuation import Habits
from slipid.control.closed_loop import PERIOD, Pilot
from slipid.control.controller import Controller, Correction, Gains, Law, Limits
from slipid.control.deployed import DeployedRobot
from slipid.control.estimator import Estimator, Odometry
from slipid.control.filter.floor import Floor
from slipid.control.interface import AbstractEstimator, Settings
from slipid.control.trajectory import STEP, rectangle
from slipid.support.errors import DataError


@dataclass(frozen=True)
class Row:
    """One controller of the trial.

    Attributes:
        observer: `encoder`, `curve` (slip over current, wheel by wheel) or `contact`.
        about: one sentence for people.
        correction: of the 2021 paper.
        law: a published one in place of the pose loop, made for a robot.
        tuned: whether it has the tuned gains of its file, where they are better than by hand.
        gyro: whether the robot has one.
        mapped: whether it is told the map of its floors.
    """

    observer: str
    about: str
    correction: Correction = "none"
    law: Callable[[DeployedRobot], Law] | None = None
    tuned: bool = False
    gyro: bool = False
    mapped: bool = False

    def drives(self, robot: DeployedRobot) -> bool:
        """Whether it applies: torque corrections have gains of the 2021 paper's three wheels."""
        return self.correction == "none" or robot.wheels == PAPER_WHEELS


BESIDE = ((0.05, 0.0, 0.2), (0.0, 0.05, -0.2), (-0.05, 0.0, 0.2), (0.0, -0.05, -0.2))
"""From where gains of published laws are rehearsed: beside the path's start [m, m, rad]."""


def _indiveri(robot: DeployedRobot) -> Law:
    """The wheels as they were identified, and the gains that the pose loop has by hand."""
    numbers, wheels, gains = robot.record.parameters, robot.record.wheels, Gains()
    matrix = inverse_kinematics(
        np.asarray(robot.places),
        np.asarray(wheels.drive_angle) + np.asarray(numbers["robot.drive_offset"].value),
        np.asarray(wheels.roller_angle),
        float(robot.frame.radius) * (1 + np.asarray(numbers["robot.radius_deviation"].value)),
    )
    both = jnp.stack([gains.place, gains.yaw])
    return Indiveri(jnp.asarray(matrix), both, jnp.asarray(Limits().wheel_speed))


def _goswami_padhy(robot: DeployedRobot) -> Law:
    return GoswamiPadhy(jnp.asarray(_rehearsed("swarm")))


def _goswami_padhy_gradient(robot: DeployedRobot) -> Law:
    return GoswamiPadhy(jnp.asarray(_rehearsed("gradient")))


@cache
def _rehearsed(by: Literal["swarm", "gradient"]) -> tuple[float, ...]:
    """Gains [1/s] on the first two sides of the rectangle; the others mirror them.

    The ideal robot is late as every robot's twin is, so that gains are the same for all of them.
    """
    path, habits = rectangle(), Habits()
    times, rows = np.arange(0.0, float(path.marks[1]), PERIOD), np.asarray(path.rows)
    own = STEP * np.arange(len(rows))
    reference = np.stack([np.interp(times, own, column) for column in rows.T], axis=1)
    task = Rehearsal(reference, np.array(BESIDE), habits.held(), habits.follow, PERIOD)
    return tuple((by_swarm(task) if by == "swarm" else by_gradient(task)).tolist())


PAPER_WHEELS = 3
"""Of the 2021 paper's robot."""
ROWS: Mapping[str, Row] = {
    "encoder": Row("encoder", "believes its encoders"),
    "slip_odometry": Row("curve", "odometry less slip over current (figure 5)"),
    "paper_print": Row("curve", "and torque correction as printed", "paper_print"),
    "paper_code": Row("curve", "and torque correction as its authors ran it", "paper_code"),
    "torque": Row("curve", "and torque correction, corrected", "torque"),
    "goswami_padhy": Row(
        "encoder", "law of Goswami and Padhy, gains by a swarm", law=_goswami_padhy
    ),
    "goswami_padhy_gradient": Row(
        "encoder", "and gains by the gradient", law=_goswami_padhy_gradient
    ),
    "indiveri": Row("encoder", "law of Indiveri, its limit keeps the direction", law=_indiveri),
    "contact": Row("contact", "contact estimator, tuned gains where they are better", tuned=True),
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


def check_gains(out: Path, robot: DeployedRobot) -> None:
    """Raise `DataError` if tuned gains are wanted that this robot and load set-up do not have."""
    tuned, path = robot.record.gains, out / "robot.json"
    if tuned is None:
        raise DataError(f"{path}: it has no tuned gains; leave out --tuned-gains")
    if tuned.load != robot.load_setup:
        raise DataError(
            f"{path}: gains were tuned for another load set-up ({tuned.load}), not for "
            f"{robot.load_setup}; leave out --tuned-gains, or drive with --load {tuned.load}"
        )


def unused_gains(robot: DeployedRobot, forced: bool) -> str:
    """Return which tuned gains of the file are not taken, and why; empty where all are."""
    tuned = robot.record.gains
    if tuned is None:
        return ""
    if tuned.load != robot.load_setup:
        return f"gains were tuned for load set-up {tuned.load}: driving with those set by hand"
    if not (tuned.is_better or forced):
        return (
            f"tuned gains are {tuned.verdict} (loss {tuned.loss.tuned:.1f} mm, by hand "
            f"{tuned.loss.hand:.1f} mm): driving with those set by hand; --tuned-gains takes the "
            "others"
        )
    if tuned.values.ahead.value == 0.0:
        return ""
    return (
        f"tuned gain ahead = {tuned.values.ahead.value:g} is not taken: there are no wheel speeds "
        "by the contact model any more"
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
    estimator: AbstractEstimator[Any] = Estimator(robot, settings, floor if row.mapped else None)
    if row.observer != "contact":
        estimator = Odometry(robot, settings, curve=row.observer == "curve")
        own = replace(own, preview=jnp.asarray(0.0))  # the paper's loop has none
    law = None if row.law is None else row.law(robot)
    return Pilot(estimator, Controller(robot, own, correction=row.correction, law=law))
