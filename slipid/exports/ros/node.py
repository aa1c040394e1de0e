"""Parameters of a ROS node `slipid`: the robot's parameters, named by their robot.json paths.

Names of floors and load set-ups are converted by `identifiers`. Arrays with an element per wheel or
drive are in the order of robot.json; matrices are in row-major order.
"""

import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Array, Float

from slipid.exports.description import BASES, SETTINGS, gains_origin, settings, verdict_text
from slipid.exports.feedforward import gain_parameters
from slipid.exports.ros.yaml_text import Check, Parameter
from slipid.exports.text import identifiers, interval, listed
from slipid.parameter import Entry
from slipid.robot.deployed import DeployedRobot
from slipid.robot.feedforward import robot_feedforwards
from slipid.robot.gains import Gains, used_gains
from slipid.robot.record import UNITS, RecordedNumber
from slipid.robot.robot_file import declared_numbers

NODE = "slipid"


def node_parameters(robot: DeployedRobot) -> tuple[Parameter, ...]:
    """Return all parameters of the node; parameters of the same group follow one another."""
    robot_itself = (*_choices(robot), *_numbers(robot), *_shape(robot), *_errors(robot))
    return (*robot_itself, *_controls(robot), *gain_parameters(robot_feedforwards(robot)))


def _choices(robot: DeployedRobot) -> Iterator[Parameter]:
    loads = [load.name for load in robot.record.loads]
    names, labels = identifiers(loads, "load"), robot.labels
    chosen = names[loads.index(robot.load_setup)]
    about = f"load set-up for which kinematics, noise and gains are valid, one of: {listed(loads)}"
    yield Parameter("load_setup", chosen, about, (Check("one_of<>", (names,)),))
    checks = _size(len(labels)), Check("unique<>", ())
    about = f"floors in the order of robot.json: {listed(labels)}"
    yield Parameter("floors", identifiers(labels, "floor"), about, checks)


def _numbers(robot: DeployedRobot) -> Iterator[Parameter]:
    """Yield every parameter in the robot's record, one group of parameters after the other."""
    floors = dict(zip(robot.labels, identifiers(robot.labels, "floor"), strict=True))
    names = [load.name for load in robot.record.loads]
    loads = dict(zip(names, identifiers(names, "load"), strict=True))

    groups: dict[str, list[Parameter]] = {}
    for e in declared_numbers(robot.record):
        group, _, name = e.quantity.rpartition(".")
        if e.surface is not None:
            group = f"{group}.{floors[e.surface]}"
        elif e.load is not None:
            group, name = e.quantity, loads[e.load]
        number = robot.record.parameters[e.path]
        parameter = Parameter(f"{group}.{name}", number.value, _about(e, number), tuple(_checks(e)))
        groups.setdefault(group, []).append(parameter)
    for parameters in groups.values():
        yield from parameters


def _about(e: Entry, number: RecordedNumber) -> str:
    d = e.declaration
    ends = number.interval90
    pairs = [] if ends is None else np.reshape(ends, (-1, 2)).tolist()
    each = "; ".join(interval((low, high)) for low, high in pairs)
    known = f", 90 % interval {each}" if each else ""
    return (
        f"{d.doc} {d.symbol} [{d.unit}]; {verdict_text(number.verdict)}, {number.provenance}{known}"
    )


def _checks(e: Entry) -> Iterator[Check]:
    """Yield the validators of a parameter of the robot: for its size and its bounds."""
    d, several = e.declaration, e.size > 1
    if several:
        yield _size(e.size)
    if d.shares:
        yield Check("element_bounds<>", (0.0, 1.0))
    elif not d.deviation:
        for name, element, bound in (("gt<>", "lower", d.lower), ("lt<>", "upper", d.upper)):
            if not math.isinf(bound):
                yield Check(f"{element}_element_bounds<>" if several else name, (bound,))


def _shape(robot: DeployedRobot) -> Iterator[Parameter]:
    """Yield the parameters of wheels and kinematics."""
    wheels, size, matrix = robot.record.wheels, _size(robot.wheels), _size(3 * robot.drives)
    gear = "motor speed over wheel speed n [1]"
    yield Parameter("wheels.gear_ratio", wheels.gear_ratio, gear, (Check("gt<>", (0.0,)),))
    for name, values, about, check in (
        ("place", wheels.place, _PLACE, _size(2 * robot.wheels)),
        ("drive_angle", wheels.drive_angle, _DRIVE, size),
        ("roller_angle", wheels.roller_angle, _ROLLER, size),
    ):
        yield _flat(f"wheels.{name}", values, about, check)
    grips = tuple(bool(x) for x in wheels.grips)
    yield Parameter("wheels.grips", grips, "true for a wheel without rollers", (size,))
    yield _flat("kinematics.forward", robot.forward, _FORWARD, matrix)
    yield _flat("kinematics.inverse", robot.inverse, _INVERSE, matrix)


def _errors(robot: DeployedRobot) -> Iterator[Parameter]:
    """Yield the parameters about the model's errors, and about the range of the fitted runs."""
    zero, zeros = Check("gt_eq<>", (0.0,)), Check("lower_element_bounds<>", (0.0,))
    for k, name in enumerate(identifiers(robot.labels, "floor")):
        yield _flat(f"errors.{name}.process", robot.process[k], _PROCESS, _size(3), zeros)
        yield _flat(f"errors.{name}.effect", robot.effect[k], _EFFECT, _size(3), zeros)
        std = float(robot.current_std[k])
        yield Parameter(f"errors.{name}.current_std", std, _CURRENT, (zero,))
    yield _flat("seen.current_trend", robot.current_trend, _TREND, _size(2))
    speed, current = (float(x) for x in robot.highest)
    yield Parameter("seen.highest_speed", speed, _HIGHEST_SPEED, (zero,))
    yield Parameter("seen.highest_current", current, _HIGHEST_CURRENT, (zero,))
    yield _flat("seen.wheel_curve", robot.wheel_curve, _CURVE, _size(2 * robot.drives))
    for name, value in vars(robot.record.sensors).items():
        if isinstance(value, bool):
            yield Parameter(f"seen.{name}", value, f"{name}: true if the logs had this")


def _controls(robot: DeployedRobot) -> Iterator[Parameter]:
    """Yield gains, limits and settings of sensors, which may be changed while the node runs."""
    gains = Gains.of(robot)
    for e in used_gains(robot):
        about = f"{e.declaration.doc} {e.declaration.symbol} [{e.declaration.unit}]"
        if e.path == "place":
            about = f"{about}. {gains_origin(robot)}"
        yield Parameter(f"gains.{e.path}", float(e.get(gains)), about, (), read_only=False)
    for path, one in settings(robot).items():
        verdict, origin = BASES[one.provenance]
        about = f"{SETTINGS[path]} [{UNITS[path]}]; {verdict}, {origin}"
        check = Check("gt_eq<>" if path.startswith("actuators.") else "gt<>", (0.0,))
        yield Parameter(path, one.value, about, (check,), read_only=False)


def _size(count: int) -> Check:
    return Check("fixed_size<>", (count,))


def _flat(
    name: str,
    values: Float[Array, "..."] | tuple[float, ...] | tuple[tuple[float, float], ...],
    about: str,
    *checks: Check,
) -> Parameter:
    return Parameter(name, tuple(np.ravel(np.asarray(values, float)).tolist()), about, checks)


_PLACE = "centre of each wheel, x and y, in base radii"
_DRIVE = "direction of travel at a positive wheel speed, without drive_offset [rad]"
_ROLLER = "angle from the free rolling direction to the drive direction [rad]"
_FORWARD = "J: rim speed of each drive from vx, vy [m/s], yaw rate [rad/s], a row per drive"
_INVERSE = "pseudo-inverse of J: vx, vy, yaw rate from rim speeds [m/s], a row for each"
_PROCESS = (
    "std of random errors that grow with the root of the path length: along, across [m/sqrt(m)], "
    "in yaw [rad/sqrt(m)]"
)
_EFFECT = "std of effects, errors that stay the same over a path: along, across [m/m], yaw [rad/m]"
_CURRENT = "std of measured less modelled currents [A]"
_TREND = "a [A], b [A s/m] of the excess a + b v of measured over modelled currents at a speed v"
_HIGHEST_SPEED = "highest wheel speed of the fitted runs [rad/s]"
_HIGHEST_CURRENT = "largest modelled current at up to 0.8 of the highest wheel speed [A]"
_CURVE = "a [1], b [1/A] of each drive's slip ratio a + b |I| at a current I, over all floors"
