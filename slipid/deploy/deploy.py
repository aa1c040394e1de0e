"""Conversion of a fit, a posterior or a fitted force balance to robot.json."""

import glob
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np

from slipid.data.runs import Runs
from slipid.deploy.robot_record import effects_by_load, robot_record
from slipid.exports.feedforward import gains_json
from slipid.fitting.calibration.result import Calibration
from slipid.infer.posterior.diagnosis import Posterior
from slipid.infer.result import Fit, draws
from slipid.infer.result_folder import IDENTIFIED, ROBOT, fit_of
from slipid.infer.verdicts.draws import some_of
from slipid.infer.verdicts.estimates import Estimate
from slipid.model.geometry import Geometry
from slipid.model.kinematics import matrices, with_lengths
from slipid.model.robot import Robot, Validity
from slipid.parameter import entries
from slipid.predict.predictive import ForceBalance
from slipid.robot.controller import NO_CONTROLLER
from slipid.robot.deployed import DeployedRobot
from slipid.robot.feedforward import robot_feedforwards
from slipid.robot.gains import known_actuator
from slipid.robot.interface import MIXED_FLOORS_PENALTY
from slipid.robot.record import (
    Axes,
    FloorRecord,
    LoadRecord,
    LogSensors,
    Pair,
    RecordedNumber,
    RobotRecord,
    Rows,
    Setting,
    Source,
    SteeringRecord,
    axes_of,
    plain,
    rows_of,
)
from slipid.robot.robot_file import robot_bytes, typed
from slipid.robot.twin import LONGEST_DELAY_S, ActuatorModel
from slipid.search_space import Choice, Space
from slipid.support.checkpoint import versions
from slipid.support.errors import DataError
from slipid.support.files import hash_of, json_text, read_json, write_together

DRAWS = 64
"""Number of posterior draws in robot.json."""


def deploy(found: Fit | Posterior) -> DeployedRobot:
    """Return the robot of a fit or of its posterior, with its first load set-up.

    Parameters are as in `identified.json`, and draws are those of the posterior if one is given,
    else those of the fit's short chain or, without one, of its Laplace approximation.
    `DeployedRobot.record.source` is the name of the one that was used.
    """
    source: Source
    if isinstance(found, Posterior):
        fit, flat, source = found.fit, found.flat, "posterior"
        vectors, center = some_of(flat, DRAWS), flat.mean(axis=0)
    else:
        fit, vectors, center = found, found.draws(DRAWS), found.z
        source = "laplace" if found.chain is None else "short_chain"
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
        fit.robot_settings,
    )
    # a robot that was fitted to runs over several floors is expected to drive across edges, so use
    # the smaller penalty for several floors under it
    alike = record.alike if fit.mixed is None else MIXED_FLOORS_PENALTY
    if fit.calibration is not None:
        models = {floor: one.model for floor, one in fit.selection.items()}
        record = with_kinematics(record, fit.calibration, fit.config_shape, models)
    return DeployedRobot.of(
        replace(
            record,
            source=source,
            sensors=replace(
                record.sensors,
                current_is_signed=fit.channels.signed,
                voltage=fit.channels.voltage,
                gyro=fit.channels.gyro,
            ),
            alike=alike,
            messages=found.messages,
            data=fit.data_hash,
            versions=versions(),
        )
    )


def with_kinematics(
    record: RobotRecord, found: Calibration, shape: Geometry, models: Mapping[str, str]
) -> RobotRecord:
    """Return the record with calibrated kinematics, in use on floors where they were selected.

    Args:
        record: record of the force balance.
        found: the calibration.
        shape: geometry with the lengths of the config.
        models: name of the selected slip model, keyed by floor; `nominal` stands for kinematics
            with the lengths of the config.
    """
    rolling, one = np.asarray(shape.pseudo_inverse()), float(shape.wheel_radius)

    def rows(floor: str, calibrated: bool) -> tuple[Rows, float]:
        *radius, base, centre = found.numbers(floor)[: shape.drives + 2] * calibrated
        matrix = matrices(rolling, one * np.exp(radius), np.exp(base), np.asarray(centre))
        return rows_of(matrix), float(np.exp(base))

    floors, spread = list(record.floors), {}
    for k, floor in enumerate(record.floors):
        floors[k] = replace(floor, calibration=rows(floor.name, True)[0])
        model = models.get(floor.name, "contact")
        if model == "contact":
            continue
        # floors share their steering, so that a robot that steers has calibrated kinematics on all
        whole = model == "calibrated" or shape.driven is not None
        kinematics, base_ratio = rows(floor.name, whole)
        effect = found.noise.effect[floor.name]
        floors[k] = replace(
            floors[k],
            kinematics=kinematics,
            process=found.noise.process[floor.name],
            effect=effect,
            wheelbase=found.nominal_base * base_ratio if shape.driven else None,
        )
        spread[k] = found.spread(floor.name)
    loads = tuple(_without_effects(load, floors, spread) for load in record.loads)
    steering = None
    if found.steering:
        names = ("zero_rad", "gain", "understeer")
        steering = SteeringRecord(*(found.steering[name].value for name in names))
    nominal = rows_of(rolling * one)
    return replace(record, floors=tuple(floors), loads=loads, steering=steering, nominal=nominal)


def _without_effects(
    load: LoadRecord, floors: Sequence[FloorRecord], spread: Mapping[int, Axes]
) -> LoadRecord:
    """Return a load set-up in which floors with calibrated kinematics have no expected effects.

    `spread` is the std of their motion per metre due to uncertain lengths, keyed by the floor's
    index.
    """
    wide = tuple(spread.get(k, axes) for k, axes in enumerate(load.spread))
    if load.told is None:
        return replace(load, spread=wide)
    mean, left = list(load.told.mean), list(load.told.left)
    for k, axes in spread.items():
        whole = axes_of(np.hypot(floors[k].effect, axes))
        mean[k] = tuple(((0.0, 0.0, 0.0),) * len(row) for row in mean[k])
        left[k] = tuple((whole,) * len(row) for row in left[k])
    return replace(load, spread=wide, told=replace(load.told, mean=tuple(mean), left=tuple(left)))


def calibrated_robot(
    found: Calibration,
    robot: Robot,
    models: Mapping[str, str],
    data: Runs,
    settings: Mapping[str, tuple[float, str]] = MappingProxyType({}),
) -> DeployedRobot:
    """Return the robot of a calibration alone, with a force balance at its start values.

    The force balance is only used while the wheels are on several floors.

    Args:
        found: the calibration.
        robot: robot with the lengths of the config, and the floors and loads of the runs.
        models: name of the selected kinematic model, keyed by floor.
        data: the calibrated runs.
        settings: known limits, noise of sensors and delays, see `Fit.robot_settings`.
    """
    shape = with_lengths(robot.geometry, found.nominal_radius, found.nominal_base)
    speed = max(
        float(np.abs(np.gradient(angle, log.time, axis=0)).max())
        for log in data.logs
        if len(angle := log.wheel_angle) > 2
    )
    draws = jax.tree.map(lambda leaf: np.stack([np.asarray(leaf)] * 2), robot)
    known = _settings(settings)
    record = robot_record(
        robot, given_numbers(robot), {}, draws, speed, (0.0, 0.0), {}, settings=known
    )
    signed = data.current_is_signed and data.current is not None
    return DeployedRobot.of(
        replace(
            with_kinematics(record, found, shape, models),
            sensors=replace(
                record.sensors,
                current_is_signed=signed,
                voltage=data.voltage is not None,
                gyro=all(log.gyro is not None for log in data.logs),
            ),
            messages=("calibrated kinematics alone: no force balance was fitted",),
            data=hash_of((log.name, log.sha256) for log in data.logs),
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
    settings: Mapping[str, tuple[float, str]] = MappingProxyType({}),
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
        _settings(settings),
    )


def _settings(given: Mapping[str, tuple[float, str]]) -> dict[str, Setting]:
    """Return pairs of value and origin as settings of a record."""
    return {
        path: typed(Setting, {"value": v, "provenance": o}, path) for path, (v, o) in given.items()
    }


def write_robot(out: Path, found: Fit | Posterior) -> tuple[str, ...]:
    """Write robot.json into the folder of a fit; return the names of the written files.

    The feed-forward and feedback gains of the robot are added to identified.json.
    """
    robot = deploy(found)
    return switch_robot(out, robot, gains_json(robot_feedforwards(robot)))


def switch_robot(
    out: Path, robot: DeployedRobot, gains: Mapping[str, object] = MappingProxyType({})
) -> tuple[str, ...]:
    """Write robot.json into the folder of a fit; return the names of the written files.

    The hash of the robot's numbers, by which `robot_of_folder` recognizes it, and the gains are
    added to identified.json.
    """
    content = read_json(out / IDENTIFIED, "the result of a fit")
    content |= {**gains, "robot": robot.record.numbers}
    files = {IDENTIFIED: json_text(content).encode(), ROBOT: robot_bytes(robot.record)}
    write_together({out / name: data for name, data in files.items()}, [out / ROBOT])
    return (ROBOT,)


def robot_of_folder(out: Path, load: str | None = None) -> DeployedRobot:
    """Return the robot in a result folder, with the load set-up of a name or the first one.

    Raises:
        DataError: reading it fails as in `DeployedRobot.load`, or it is not the robot of the fit.
    """
    robot = DeployedRobot.load(out / ROBOT, load)
    fit_of(out)
    path = out / IDENTIFIED
    about = read_json(path, "the result of a fit") if path.exists() else {}
    if about.get("robot", robot.record.numbers) != robot.record.numbers:
        raise DataError(
            f"{out / ROBOT}: not the robot of the fit in {path}; run `slipid identify`, or "
            "`slipid sample` after it, again"
        )
    return robot


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
    robot = DeployedRobot.load(path, load) if path == source else robot_of_folder(source, load)
    if not robot.has_controller:
        raise DataError(f"{path}: {NO_CONTROLLER}")
    try:
        return robot.on(*floors) if floors else robot
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error


def actuator_model_of(robot: DeployedRobot, gyro: bool) -> ActuatorModel:
    """Return the actuator model of a robot's twin, with the sensors that the robot's logs have.

    Wheels accelerate up to the robot's limit. The noise is what logs show, where they show it; a
    config may have more, to be on the safe side. Delay and lag are those of the robot if they are
    known; the twin's delay is limited to `LONGEST_DELAY_S`.
    """
    sensors, known = robot.record.sensors, known_actuator(robot)
    noise = {name: getattr(sensors, own) for name, own in _NOISE.items()}
    model = ActuatorModel(
        slew=robot.record.limits.acceleration.value / float(robot.frame.radius),
        voltage=sensors.voltage,
        gyro=gyro,
        signed=sensors.current_is_signed,
        **{name: one.value for name, one in noise.items() if one.provenance == "logs"},
    )
    if known is None:
        return model
    return replace(model, delay_s=min(known.delay_s, LONGEST_DELAY_S), lag_s=known.lag_s)


_NOISE = {
    "ammeter_a": "ammeter_std_a",
    "voltmeter_v": "voltmeter_std_v",
    "gyro_noise": "gyro_std",
    "gyro_bias": "gyro_bias_std",
}
"""Name in robot.json of the noise of each sensor of an actuator model."""


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
