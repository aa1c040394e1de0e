"""Parameters of a ROS node `slipid`: the robot's numbers, named by their paths in robot.json.

Names of floors and load set-ups are those of `identifiers`. Arrays per wheel are in the order of
robot.json; matrices are in row-major order.
"""

import math
from collections.abc import Iterator
from dataclasses import asdict

import numpy as np
from jaxtyping import Array, Float

from slipid.exports.description import LIMITS, gains_origin, verdict_text
from slipid.exports.ros.yaml_text import Check, Parameter
from slipid.exports.text import identifiers, interval, listed
from slipid.parameter import Declaration, Entry, entries
from slipid.robot.controller import Gains, Limits
from slipid.robot.deployed import DeployedRobot
from slipid.robot.record import RecordedNumber
from slipid.robot.robot_file import declared_numbers

NODE = "slipid"
_ZERO = Check("gt_eq<>", (0.0,))
_ZEROS = Check("lower_element_bounds<>", (0.0,))


def node_parameters(robot: DeployedRobot) -> tuple[Parameter, ...]:
    """Return all parameters; those of a group stand together."""
    return (*_choices(robot), *_numbers(robot), *_shape(robot), *_errors(robot), *_controls(robot))


def _choices(robot: DeployedRobot) -> Iterator[Parameter]:
    loads = [load.name for load in robot.record.loads]
    names = identifiers(loads, "load")
    chosen = names[loads.index(robot.load_setup)]
    yield Parameter(
        "load_setup",
        chosen,
        f"load set-up for which kinematics, noise and gains are, of: {listed(loads)}",
        (Check("one_of<>", (names,)),),
    )
    yield Parameter(
        "floors",
        identifiers(robot.labels, "floor"),
        f"floors in the order of robot.json: {listed(robot.labels)}",
        (Check("fixed_size<>", (len(robot.labels),)), Check("unique<>", ())),
    )


def _numbers(robot: DeployedRobot) -> Iterator[Parameter]:
    """Yield every number of the record; groups and their numbers are in the declared order."""
    floors = dict(zip(robot.labels, identifiers(robot.labels, "floor"), strict=True))
    names = [load.name for load in robot.record.loads]
    loads = dict(zip(names, identifiers(names, "load"), strict=True))

    def name(e: Entry) -> str:
        quantity = e.quantity
        if e.surface is not None:
            part, _, last = quantity.rpartition(".")
            return f"{part}.{floors[e.surface]}.{last}"
        return quantity if e.load is None else f"{quantity}.{loads[e.load]}"

    named = [(name(e), e) for e in declared_numbers(robot.record)]
    groups = [n.rpartition(".")[0] for n, _ in named]
    order = {group: k for k, group in enumerate(dict.fromkeys(groups))}
    for called, e in sorted(named, key=lambda pair: order[pair[0].rpartition(".")[0]]):
        number = robot.record.parameters[e.path]
        yield Parameter(called, number.value, _about(e, number), tuple(_checks(e)))


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
    d = e.declaration
    if e.size > 1:
        yield Check("fixed_size<>", (e.size,))
    if d.shares:
        yield Check("element_bounds<>", (0.0, 1.0))
    elif not d.deviation:
        yield from _bounds(d, e.size > 1)


def _bounds(d: Declaration, several: bool) -> Iterator[Check]:
    for name, element, bound in (("gt<>", "lower", d.lower), ("lt<>", "upper", d.upper)):
        if not math.isinf(bound):
            yield Check(f"{element}_element_bounds<>" if several else name, (bound,))


def _shape(robot: DeployedRobot) -> Iterator[Parameter]:
    """Yield the parameters of wheels and kinematics."""
    wheels, count = robot.record.wheels, robot.wheels
    size, both = (Check("fixed_size<>", (count,)),), (Check("fixed_size<>", (2 * count,)),)
    yield Parameter("wheels.gear_ratio", wheels.gear_ratio, _GEAR, (Check("gt<>", (0.0,)),))
    places = "where the wheels stand, x and y of each, in base radii"
    yield _flat("wheels.place", wheels.place, places, both)
    yield _flat("wheels.drive_angle", wheels.drive_angle, _DRIVE, size)
    yield _flat("wheels.roller_angle", wheels.roller_angle, _ROLLER, size)
    grips = "whether a wheel has no rollers"
    yield Parameter("wheels.grips", tuple(bool(x) for x in wheels.grips), grips, size)
    triple = (Check("fixed_size<>", (3 * count,)),)
    yield _flat("kinematics.forward", robot.forward, _FORWARD, triple)
    yield _flat("kinematics.inverse", robot.inverse, _INVERSE, triple)


def _errors(robot: DeployedRobot) -> Iterator[Parameter]:
    """Yield the parameters of the model's errors, and of the range of the fitted runs."""
    three, two = (Check("fixed_size<>", (3,)), _ZEROS), (Check("fixed_size<>", (2,)),)
    for k, name in enumerate(identifiers(robot.labels, "floor")):
        yield _flat(f"errors.{name}.process", robot.process[k], _PROCESS, three)
        yield _flat(f"errors.{name}.effect", robot.effect[k], _EFFECT, three)
        std = float(robot.current_std[k])
        yield Parameter(f"errors.{name}.current_std", std, _CURRENT, (_ZERO,))
    yield _flat("seen.current_trend", robot.current_trend, _TREND, two)
    speed, current = (float(x) for x in robot.highest)
    yield Parameter(
        "seen.highest_speed", speed, "highest wheel speed of the fitted runs [rad/s]", (_ZERO,)
    )
    yield Parameter("seen.highest_current", current, _HIGHEST, (_ZERO,))
    curve = (Check("fixed_size<>", (2 * robot.wheels,)),)
    yield _flat("seen.wheel_curve", robot.wheel_curve, _CURVE, curve)
    for name, value in asdict(robot.record.sensors).items():
        yield Parameter(f"seen.{name}", bool(value), f"whether it was so in the logs: {name}")


def _controls(robot: DeployedRobot) -> Iterator[Parameter]:
    """Yield gains and limits, which may be changed while the node runs."""
    gains = Gains.of(robot)
    for e in entries(gains):
        about = f"{e.declaration.doc} {e.declaration.symbol} [{e.declaration.unit}]"
        if e.path == "place":
            about = f"{about}. {gains_origin(robot)}"
        yield Parameter(f"gains.{e.path}", float(e.get(gains)), about, (), read_only=False)
    for name, value in asdict(Limits()).items():
        checks = (Check("gt<>", (0.0,)),)
        unit, about = LIMITS[name]
        yield Parameter(f"limits.{name}", float(value), f"{about} [{unit}]", checks, False)


def _flat(
    name: str,
    values: Float[Array, "..."] | tuple[float, ...] | tuple[tuple[float, float], ...],
    about: str,
    checks: tuple[Check, ...],
) -> Parameter:
    return Parameter(name, tuple(np.asarray(values, float).reshape(-1).tolist()), about, checks)


_GEAR = "motor speed over wheel speed n [1]"
_DRIVE = "direction of travel of a positive wheel speed [rad], drive_offset left out"
_ROLLER = "from the free rolling direction to the drive direction [rad]"
_FORWARD = "J: rim speed of each wheel from vx, vy [m/s], yaw rate [rad/s], a row per wheel"
_INVERSE = "pseudo-inverse of J: vx, vy, yaw rate from rim speeds [m/s], a row each"
_PROCESS = "std of random errors, per root of the path length, along, across [m/sqrt(m)], in yaw"
_EFFECT = "std of effects, the same over a path, along, across [m/m], in yaw [rad/m]"
_CURRENT = "std of measured currents about the model's [A]"
_TREND = "a + b v, excess of measured currents over the model's [A, A s/m]"
_HIGHEST = "largest current of the model up to 0.8 of the highest speed [A]"
_CURVE = "a, b of each wheel: slip ratio a + b |I| over all floors [1, 1/A]"
