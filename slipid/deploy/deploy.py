"""From a fit, or its posterior, to robot.json, which is all that runs on the robot needs.

From a force balance that forecasts to a deployed robot, without the verdicts of a whole fit.
"""

import glob
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from slipid.deploy.robot_record import effects_by_load, plain, robot_record
from slipid.infer.posterior.diagnosis import Posterior
from slipid.infer.result import Fit, draws
from slipid.infer.verdicts.estimates import Estimate
from slipid.model.robot import Robot
from slipid.parameter import entries
from slipid.predict.predictive import ForceBalance
from slipid.robot.deployed import DeployedRobot
from slipid.robot.interface import MIXED_FLOORS_PENALTY
from slipid.robot.record import LogSensors, RecordedNumber, Source
from slipid.robot.robot_file import typed
from slipid.robot.twin import ActuatorModel
from slipid.search_space import Choice, Space
from slipid.support.checkpoint import versions
from slipid.support.errors import DataError

ROBOT = "robot.json"
NO_CONTROLLER = (
    "the wheels of this robot cannot be asked for any motion ahead, sideways and in yaw, each "
    "wheel alone: it has an estimator (slipid.Estimator), but no controller, so nothing to drive "
    "in a trial or to export; identify, validate, compare, sample, selftest and design apply"
)
"""What is said of wheels that have no controller."""
DRAWS = 64
"""Draws of the posterior that are kept."""
SOURCE: dict[type, Source] = {Fit: "laplace", Posterior: "posterior"}
"""What the intervals of a robot are made of."""


def deploy(found: Fit | Posterior) -> DeployedRobot:
    """The robot of a fit or of its posterior, with its first load set-up.

    Its numbers are those of `identified.json`: of the posterior where there is one, else of the
    fit's Laplace approximation. `DeployedRobot.record.source` says which.
    """
    numbers, source = found.parameters, SOURCE[type(found)]
    if isinstance(found, Posterior):
        fit, flat = found.fit, found.flat
        rows = np.random.default_rng(0).choice(len(flat), DRAWS, replace=len(flat) < DRAWS)
        vectors, center = flat[rows], flat.mean(axis=0)
    else:
        fit, vectors, center = found, found.draws(DRAWS), found.z
    record = robot_record(
        _at(fit.robot, numbers),
        {path: _number(e) for path, e in numbers.items()},
        {name: float(v) ** 0.5 for name, v in fit.contact.forecast.items()},
        jax.vmap(fit.space.tree)(jnp.asarray(vectors)),
        max(max(v.wheel_speed) for v in fit.validity.values()),
        fit.current_trend,
        fit.validity,
        effects_by_load(fit.contact, center, vectors),
    )
    # one that has learnt from runs over several floors expects to drive on several
    alike = record.alike if fit.mixed is None else MIXED_FLOORS_PENALTY
    about = replace(
        record,
        source=source,
        sensors=LogSensors(current_is_signed=fit.channels.signed, voltage=fit.channels.voltage),
        alike=alike,
        messages=found.messages,
        data=fit.data_hash,
        versions=versions(),
    )
    return DeployedRobot.of(about)


def write_robot(out: Path, found: Fit | Posterior) -> tuple[str, ...]:
    """Write robot.json beside a fit; names of files written."""
    robot, kept = deploy(found), out / ROBOT
    with suppress(DataError):  # gains outlive a fit that came to the same numbers
        before = DeployedRobot.load(kept).record if kept.is_file() else robot.record
        if before.numbers == robot.record.numbers:
            robot = DeployedRobot.of(replace(robot.record, gains=before.gains))
    robot.save(kept)
    return (ROBOT,)


def read_robot(out: Path, load: str | None = None) -> DeployedRobot:
    """The robot of a folder that is to be driven.

    Raises:
        DataError: there is none, its wheels have no controller, or as of `DeployedRobot.load`.
    """
    path = out / ROBOT
    if not path.is_file():
        raise DataError(
            f"{path}: not there; `slipid identify` writes it, so run it with --out {out}"
        )
    return require_steering(path, DeployedRobot.load(path, load))


def require_steering(path: Path, robot: DeployedRobot) -> DeployedRobot:
    """The robot of a file; DataError where its wheels have no controller."""
    if not robot.steers:
        raise DataError(f"{path}: {NO_CONTROLLER}")
    return robot


def actuator_model_of(robot: DeployedRobot, gyro: bool) -> ActuatorModel:
    """What the twin of a robot has: the sensors of its logs, and a gyro where it has one."""
    sensors = robot.record.sensors
    return ActuatorModel(voltage=sensors.voltage, gyro=gyro, signed=sensors.current_is_signed)


def _at(robot: Robot, numbers: Mapping[str, Estimate]) -> Robot:
    """The robot with its numbers at their estimates."""
    fixed = [Choice(glob.escape(path), fixed=e.value) for path, e in numbers.items()]
    return Space(robot, fixed).template


def _number(e: Estimate) -> RecordedNumber:
    """As robot.json has it."""
    kept = {f.name: getattr(e, f.name) for f in fields(RecordedNumber)}
    return typed(RecordedNumber, json.loads(json.dumps(kept)), e.path)


def robot_of_force_balance(
    contact: ForceBalance,
    highest_speed: float,
    current_trend: tuple[float, float] = (0.0, 0.0),
    sensors: LogSensors | None = None,
    load: str | None = None,
) -> DeployedRobot:
    """The robot of a fit as `slipid.deploy.deploy` has it, but for what a reader is told of it.

    Args:
        contact: the fit.
        highest_speed: of the wheels in the fitted runs [rad/s].
        current_trend: of the currents in the fitted runs, see
            `slipid.infer.slip_curves.current_trend`.
        sensors: of the logs; None where they are not known.
        load: set-up it drives with, the first one by default.
    """
    several = draws(contact.z, contact.covariance, DRAWS, seed=0)
    record = robot_record(
        contact.robot,
        given_numbers(contact.robot),
        {name: float(np.sqrt(v)) for name, v in contact.forecast.items()},
        jax.vmap(contact.space.tree)(jnp.asarray(several)),
        highest_speed,
        current_trend,
        {},
        effects_by_load(contact, contact.z, several),
    )
    return DeployedRobot.of(replace(record, sensors=sensors or LogSensors()), load)


def given_numbers(robot: Robot) -> Mapping[str, RecordedNumber]:
    """The numbers of a robot as they were given, by path."""
    return {
        e.path: RecordedNumber(
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
