"""Conversion of a fit, a posterior or a fitted force balance to robot.json."""

import glob
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np

from slipid.deploy.robot_record import effects_by_load, robot_record
from slipid.infer.posterior.diagnosis import Posterior
from slipid.infer.result import Fit, draws
from slipid.infer.verdicts.estimates import Estimate
from slipid.model.robot import Robot, Validity
from slipid.parameter import entries
from slipid.predict.predictive import ForceBalance
from slipid.robot.deployed import DeployedRobot
from slipid.robot.interface import MIXED_FLOORS_PENALTY
from slipid.robot.record import LogSensors, Pair, RecordedNumber, RobotRecord, Source, plain
from slipid.robot.robot_file import typed
from slipid.robot.twin import ActuatorModel
from slipid.search_space import Choice, Space
from slipid.support.checkpoint import versions
from slipid.support.errors import DataError

ROBOT = "robot.json"
NO_CONTROLLER = (
    "the drives of this robot cannot produce every motion ahead, sideways and in yaw: the robot "
    "has an estimator (slipid.Estimator), but no controller, so `slipid trial` and `slipid export` "
    "are not available; identify, validate, compare, sample, selftest and design are available"
)
"""Message for robots that have no controller, see `DeployedRobot.steers`."""
DRAWS = 64
"""Number of posterior draws in robot.json."""


def deploy(found: Fit | Posterior) -> DeployedRobot:
    """Return the robot of a fit or of its posterior, with its first load set-up.

    Parameters are as in `identified.json`: from the posterior if one is given, else from the fit's
    Laplace approximation. `DeployedRobot.record.source` tells which.
    """
    source: Source
    if isinstance(found, Posterior):
        fit, flat, source = found.fit, found.flat, "posterior"
        rows = np.random.default_rng(0).choice(len(flat), DRAWS, replace=len(flat) < DRAWS)
        vectors, center = flat[rows], flat.mean(axis=0)
    else:
        fit, vectors, center, source = found, found.draws(DRAWS), found.z, "laplace"
    numbers = found.parameters
    fixed = [Choice(glob.escape(path), fixed=e.value) for path, e in numbers.items()]
    record = _record(
        fit.contact,
        Space(fit.robot, fixed).template,
        {path: _number(e) for path, e in numbers.items()},
        center,
        vectors,
        max(max(v.wheel_speed) for v in fit.validity.values()),
        fit.current_trend,
        fit.validity,
    )
    # a robot that was fitted to runs over several floors is expected to drive across edges, so use
    # the smaller penalty for several floors under it
    alike = record.alike if fit.mixed is None else MIXED_FLOORS_PENALTY
    return DeployedRobot.of(
        replace(
            record,
            source=source,
            sensors=LogSensors(current_is_signed=fit.channels.signed, voltage=fit.channels.voltage),
            alike=alike,
            messages=found.messages,
            data=fit.data_hash,
            versions=versions(),
        )
    )


def robot_of_force_balance(
    contact: ForceBalance,
    highest_speed: float,
    current_trend: Pair = (0.0, 0.0),
    sensors: LogSensors | None = None,
    load: str | None = None,
) -> DeployedRobot:
    """Return the robot of a fitted force balance as `deploy` does, without verdicts and messages.

    Args:
        contact: fitted force balance.
        highest_speed: highest wheel speed of the fitted runs [rad/s].
        current_trend: a [A] and b [A s/m] of the excess a + b v of measured over modelled currents
            at a body speed v, see `slipid.infer.slip_curves.current_trend`.
        sensors: sensors of the logs; by default no sensors besides encoders.
        load: name of the load set-up, by default the first one.
    """
    vectors = draws(contact.z, contact.covariance, DRAWS, seed=0)
    numbers = given_numbers(contact.robot)
    record = _record(
        contact, contact.robot, numbers, contact.z, vectors, highest_speed, current_trend
    )
    return DeployedRobot.of(replace(record, sensors=sensors or LogSensors()), load)


def _record(
    contact: ForceBalance,
    robot: Robot,
    numbers: Mapping[str, RecordedNumber],
    center: np.ndarray,
    vectors: np.ndarray,
    highest_speed: float,
    current_trend: Pair,
    seen: Mapping[str, Validity] = MappingProxyType({}),
) -> RobotRecord:
    """Return the record of a robot.

    `center` is the search vector of the robot's parameters, and `vectors` are posterior draws of
    this vector.
    """
    return robot_record(
        robot,
        numbers,
        {name: float(v) ** 0.5 for name, v in contact.forecast.items()},
        jax.vmap(contact.space.tree)(jnp.asarray(vectors)),
        highest_speed,
        current_trend,
        seen,
        effects_by_load(contact, center, vectors),
    )


def write_robot(out: Path, found: Fit | Posterior) -> tuple[str, ...]:
    """Write robot.json into the folder of a fit; return the names of the written files."""
    robot, path = deploy(found), out / ROBOT
    # keep tuned gains of an existing readable file if the robot's parameters are unchanged
    with suppress(DataError):
        before = DeployedRobot.load(path).record if path.is_file() else robot.record
        if before.numbers == robot.record.numbers:
            robot = DeployedRobot.of(replace(robot.record, gains=before.gains))
    robot.save(path)
    return (ROBOT,)


def read_robot(source: Path, load: str | None = None, floors: Sequence[str] = ()) -> DeployedRobot:
    """Return the robot in a file, or in a result folder of `slipid identify`.

    `load` is the name of the load set-up, by default the first one. `floors` are the names of the
    floors to keep, by default all.

    Raises:
        DataError: there is no robot, there is no controller for its wheels, it has no such load
            set-up or floor, or reading it fails as in `DeployedRobot.load`.
    """
    path = source if source.suffix == ".json" else source / ROBOT
    if not path.is_file():
        raise DataError(f"{path}: missing; write it by `slipid identify` with --out {path.parent}")
    robot = DeployedRobot.load(path, load)
    if not robot.steers:
        raise DataError(f"{path}: {NO_CONTROLLER}")
    try:
        return robot.on(*floors) if floors else robot
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error


def actuator_model_of(robot: DeployedRobot, gyro: bool) -> ActuatorModel:
    """Return the actuator model of a robot's twin, with the sensors that the robot's logs have."""
    sensors = robot.record.sensors
    return ActuatorModel(voltage=sensors.voltage, gyro=gyro, signed=sensors.current_is_signed)


def _number(e: Estimate) -> RecordedNumber:
    """Convert an estimate of identified.json to a parameter of robot.json."""
    values = {f.name: getattr(e, f.name) for f in fields(RecordedNumber)}
    return typed(RecordedNumber, json.loads(json.dumps(values)), e.path)


def given_numbers(robot: Robot) -> Mapping[str, RecordedNumber]:
    """Return the parameters of a robot, keyed by path and recorded as given instead of fitted."""
    return {
        e.path: RecordedNumber(plain(np.asarray(e.get(robot))), e.declaration.unit)
        for e in entries(robot)
    }
