"""Start values of a new config from a reference robot: sizes, motor constants, floors."""

from collections.abc import Collection

import numpy as np

from slipid.app.new.config_lines import ConfigLine
from slipid.app.new.robot_answers import RobotOptions
from slipid.app.reference_robots import (
    ReferenceNumber,
    ReferenceRobot,
    reference_robot,
    reference_robots,
)
from slipid.infer.verdicts.draws import Z95
from slipid.support.errors import DataError

OPTION = "robot"
"""Name of the option, and of the attribute of the answers, that names a reference robot."""
_STARTED = (
    *("motor.coulomb_friction", "surface.*.friction", "surface.*.creep", "surface.*.roller_drag"),
    *("surface.*.roller_creep", "surface.*.rolling_resistance", "surface.*.scrub"),
)
"""Positive parameters, fitted by default, for which a reference robot may have a start value."""
_ELECTRIC = ("motor.coulomb_friction", "surface.*.friction")
"""Those of them that a config has only where currents or torques are logged."""


def wheeled_names() -> tuple[str, ...]:
    """Return the names of the reference robots from which a config can start."""
    return tuple(one.name for one in reference_robots() if one.nominal)


def reference_options(name: str) -> dict[str, str]:
    """Return the answers to the questions about a robot that a reference robot gives.

    Raises:
        DataError: there is no such robot, or it is a motor on a bench.
    """
    one = reference_robot(name)
    if not one.nominal:
        raise DataError(
            f"--robot {name}: a motor on a bench, which is no robot; expected one of "
            f"{', '.join(wheeled_names())}"
        )
    sizes = {key: _text(value) for key, value in one.nominal.items()}
    return {OPTION: name, "drive": one.drive, **sizes}


def with_reference(options: RobotOptions) -> RobotOptions:
    """Return command-line options, completed by those that the named reference robot gives.

    Raises:
        DataError: there is no such robot, or another drive is given beside it.
    """
    if OPTION not in options:
        return options
    given = reference_options(options[OPTION])
    drive = options.get("drive", given["drive"])
    if drive.strip().lower() != given["drive"]:
        raise DataError(
            f"--drive {drive}: reference robot {options[OPTION]} has drive {given['drive']}; "
            "expected only one of --drive and --robot"
        )
    return {**given, **options}


def _text(value: float | bool | str | list[float]) -> str:
    """Return a size as the text of an answer."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(map(_text, value))
    return value if isinstance(value, str) else f"{value:.10g}"


def prior_text(name: str, path: str) -> str:
    """Return the TOML text of a prior by a number of a reference robot; empty if it has none."""
    number = reference_robot(name).numbers.get(path) if name else None
    if number is None:
        return ""
    value, (low, high) = number.mean
    return f"{{ prior = {{ mean = {value:.4g}, std = {(high - low) / (2 * Z95):.2g} }} }}"


def start_lines(name: str, channels: Collection[str]) -> list[ConfigLine]:
    """Return config lines with the start values of parameters by a reference robot.

    A start value of all floors is the geometric mean over the floors whose logs determine it.

    Args:
        name: name of the reference robot; empty for none.
        channels: channels that are logged; without currents or torques, parameters that need them
            have no line.
    """
    if not name:
        return []
    one, lines = reference_robot(name), []
    has_torque = bool({"current", "motor_torque", "wheel_torque"} & set(channels))
    for pattern in _STARTED:
        found = _by_floor(one, pattern)
        if not found or (pattern in _ELECTRIC and not has_torque):
            continue
        start = float(np.exp(np.mean([np.log(number.mean[0]) for number in found.values()])))
        each = ", ".join(f"{number.mean[0]:.2g} on {floor}" for floor, number in found.items())
        comment = f"{name}: {each}" if "*" in pattern else name
        lines.append(ConfigLine(f'"{pattern}"', f"{{ start = {start:.3g} }}", comment))
    return lines


def _by_floor(one: ReferenceRobot, pattern: str) -> dict[str, ReferenceNumber]:
    """Return the determined numbers of a robot with `*` as the floor, keyed by floor."""
    named = {pattern.replace("*", floor): floor for floor in one.floors}
    return {
        named[path]: number
        for path, number in one.numbers.items()
        if path in named and number.is_determined
    }


def remark(name: str) -> str:
    """Return a sentence on the nominal sizes of a reference robot and how they roll on floors."""
    one = reference_robot(name)
    parts = []
    for floor in one.floors:
        radius, track = (one.multiplier(key, floor) for key in ("wheel_radius", "track"))
        each = [f"radius {radius:.3f}"] if radius is not None else []
        each += [f"{'track' if one.drive == 'skid' else 'base'} {track:.3f}"] if track else []
        parts += [f"{' and '.join(each)} on {floor}"] if each else []
    return (
        f"Nominal sizes of the reference robot {name}: {one.about}. By its logs it moves as if "
        f"they were multiplied: {'; '.join(parts)}."
    )
