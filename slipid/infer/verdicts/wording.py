"""Texts about flat directions: formulas in words, and logs or runs that would determine them."""

from collections.abc import Mapping, Sequence, Set
from typing import NamedTuple

import numpy as np

from slipid.infer.verdicts.estimates import NEEDS_VOLTAGE
from slipid.model.robot import Validity
from slipid.parameter import Entry

_LARGEST_POWER_RATIO = 10.0
"""Largest ratio of exponents in a product formula; a larger one would be hard to read."""
_POWER_TOLERANCE = 0.05
"""Difference below which two exponents count as equal."""

NOTHING = "the data have almost no information about "
OTHERS_CHANGE = ", while other parameters change slightly"


class Axis(NamedTuple):
    """One coordinate of the search space.

    Attributes:
        entry: parameter that the coordinate belongs to.
        label: name of the coordinate in texts.
        unit: unit of a step along the coordinate.
        is_log: True if a step along the coordinate multiplies the parameter by a factor.
    """

    entry: Entry
    label: str
    unit: str
    is_log: bool


def axes_of(entry: Entry) -> list[Axis]:
    """Return the coordinates of a free parameter; those of load fractions are log ratios."""
    d = entry.declaration
    unit = "log-odds" if np.isfinite(d.upper) else d.unit
    is_log = bool(np.isfinite(d.lower) and not np.isfinite(d.upper))
    if entry.size == 1:
        return [Axis(entry, entry.path, unit, is_log)]
    if d.shares:
        wheels = [", ".join(map(str, range(1, k))) for k in range(2, entry.size + 1)]
        before = ["wheel 1", *(f"wheels {several}" for several in wheels[1:])]
        each = [f"{entry.path} ({first} : wheel {k})" for k, first in enumerate(before, start=2)]
        return [Axis(entry, label, d.unit, True) for label in each]
    labels = entry.labels[: entry.coordinates]
    return [Axis(entry, f"{entry.path} [{label}]", unit, is_log) for label in labels]


def formula(axes: list[Axis], power: np.ndarray, step: np.ndarray) -> str:
    """Return a flat direction in words.

    Args:
        axes: the coordinates that change.
        power: exponents or multiples of the coordinates, relative to the largest one.
        step: changes of the coordinates for a step of one prior std along the direction.
    """
    names = [axis.label for axis in axes]
    if len(axes) == 1:
        return NOTHING + names[0]
    if all(axis.is_log for axis in axes) and np.ptp(np.log(np.abs(power))) < np.log(
        _LARGEST_POWER_RATIO
    ):
        return _product(axes, power)
    if not any(axis.is_log for axis in axes) and len({axis.unit for axis in axes}) == 1:
        return _sum(names, power)
    moves = [
        f"{axis.label} x {np.exp(s):.4g}" if axis.is_log else f"{axis.label} {s:+.2g} {axis.unit}"
        for axis, s in zip(axes, step, strict=True)
    ]
    return f"almost no effect on the data if changed together: {', '.join(moves)}"


def _product(axes: list[Axis], power: np.ndarray) -> str:
    names = [axis.label for axis in axes]
    if (np.abs(power - 1) < _POWER_TOLERANCE).all():
        short = [axis.label for axis in axes if axis.entry.quantity != "surface.friction"]
        if len(axes) - len(short) > 1:
            # A pattern keeps the sentence short where the frictions of several floors change.
            short.append("surface.*.friction")
        else:
            short = names
        last = NEEDS_VOLTAGE[1] if NEEDS_VOLTAGE[1] in short else short[0]
        return f"{', '.join(short)} only as {', '.join(f'{p}/{last}' for p in short if p != last)}"
    if len(names) == 2:
        # The formula is the quantity that stays constant along the direction: other / first^k.
        first, other, k = _pair(names, power)
        held = _power(first, abs(k))
        held = f"{held} * {other}" if k < 0 else f"{other} / {held}"
        return f"{names[0]} and {names[1]} only as {held}"
    parts = [
        f"{name} {'times' if k > 0 else 'divided by'} {_power('t', abs(k))}"
        for name, k in zip(names, power, strict=True)
    ]
    return f"changes without effect on the data, for any factor t: {', '.join(parts)}"


def _pair(names: list[str], power: np.ndarray) -> tuple[str, str, float]:
    """Return two names, and the exponent k of the second relative to that of the first.

    The names are ordered so that |k| >= 1.
    """
    k = float(power[1] / power[0])
    return (names[0], names[1], k) if abs(k) >= 1 else (names[1], names[0], 1 / k)


def _power(name: str, k: float) -> str:
    return name if abs(k - 1) < _POWER_TOLERANCE else f"{name}^{k:.2g}"


def _sum(names: list[str], weight: np.ndarray) -> str:
    if (np.abs(weight - 1) < _POWER_TOLERANCE).all():
        return f"{', '.join(names)} only as their differences"
    if len(names) == 2:
        # The formula is the quantity that stays constant along the direction: other - k first.
        first, other, k = _pair(names, weight)
        times = "" if abs(abs(k) - 1) < _POWER_TOLERANCE else f"{abs(k):.2g} "
        sign = "+" if k < 0 else "-"
        return f"{names[0]} and {names[1]} only as {other} {sign} {times}{first}"
    parts = [f"{n} {k:+.2g} t" for n, k in zip(names, weight, strict=True)]
    return f"changes without effect on the data, for any t: {', '.join(parts)}"


VOLTAGE = "log the motor voltage (or duty and bus voltage)"
_SCALE = (
    *("motor.resistance", "motor.back_emf", "motor.efficiency"),
    *(f"motor.brush_{name}" for name in ("drop", "current", "shape", "tail")),
)
_DRAG = ("motor.coulomb_friction", "motor.viscous_friction")
_FLOOR = "surface"
_CAMERA = (
    (
        ("camera.scale", "robot.wheel_radius"),
        "measure the wheel radius, or a length in the camera's image: more runs cannot help",
    ),
    (
        ("camera.marker_yaw", "robot.drive_offset"),
        "measure the marker's angle on the body: no motion can distinguish the two",
    ),
    (("camera.scale", _FLOOR), "add a floor on which the wheels do not slip"),
    (("robot.wheel_radius", _FLOOR), "add a floor on which the wheels do not slip"),
    (("robot.base_radius",), "turn on the spot"),
    (("camera.marker_place",), "turn on the spot in view of the camera"),
    (("camera.lag",), "start, stop and change speed in view of the camera"),
    *(
        ((f"camera.{name}",), "drive across the whole camera image, including its corners")
        for name in ("tilt", "radial", "tangential")
    ),
    (("camera.scale",), "measure a length in the camera's image"),
    (("robot.wheel_radius",), "measure the wheel radius"),
)
"""Remedies for flat directions: the first whose quantities all occur in the direction is used.

`_FLOOR` stands for any quantity of a floor.
"""
FEW_HEADINGS = 4
"""Number of headings below which the remedy proposes others; opposite headings count as two."""
TURNING = 0.05
"""Yaw rate by the encoders above which a run counts as a curve [rad/s]."""
LITTLE_SLIP = 0.03
"""Slip below which the parameters of a floor have little effect on the motion."""
SPEEDS_DIFFER = 1.3
"""Ratio of two speeds above which they count as different."""


def remedy(
    found: Sequence[Entry],
    has_current: bool,
    has_voltage: bool,
    validity: Mapping[str, Validity],
    sideways: bool = True,
) -> str:
    """Return a sentence on logs or runs that would determine the parameters of a flat direction.

    Args:
        found: parameters of the direction.
        has_current: True if currents were logged.
        has_voltage: True if voltages were logged.
        validity: ranges that the runs on each floor cover.
        sideways: True if the robot can drive in any direction.
    """
    quantities = {e.quantity for e in found}
    electric = all(e.declaration.electric or e.quantity == "robot.mass" for e in found)
    if electric or quantities & {*_SCALE}:
        return _electric(quantities, has_current, has_voltage, validity)
    if any(e.surface is not None for e in found):
        quantities.add(_FLOOR)
    for needed, text in _CAMERA:
        if quantities.issuperset(needed):
            return text
    return _runs(found, validity, sideways)


def _electric(
    quantities: Set[str], has_current: bool, has_voltage: bool, validity: Mapping[str, Validity]
) -> str:
    if not has_current:
        return f"log the motor currents, and {VOLTAGE.removeprefix('log ')}"
    if not has_voltage and quantities & {*_SCALE}:
        return VOLTAGE
    if quantities & {*_DRAG} and not any(_speeds(v) > 1 for v in validity.values()):
        return "drive at other speeds"
    return "drive with other loads and speeds, or weigh the robot"


def _runs(found: Sequence[Entry], validity: Mapping[str, Validity], sideways: bool) -> str:
    """Return a sentence on further runs for parameters of floors, load set-ups or the marker."""
    floors = {e.surface for e in found if e.surface is not None}
    loads = {e.load for e in found if e.load is not None}
    mine = [
        v
        for floor, v in validity.items()
        if (floor in floors if floors else not loads or loads & set(v.loads))
    ]
    where = " there" if floors else " with that load" if loads else ""
    ways = []
    headings = sorted({h for v in mine for h in v.headings_deg})
    if sideways and len(headings) < FEW_HEADINGS:
        driven = f" than {', '.join(f'{h:g}' for h in headings)} deg" if headings else ""
        ways.append(f"in other directions{driven}")
    if any(_speeds(v) < 2 for v in mine) or not mine:
        ways.append("at other speeds")
    if max((v.yaw_rate[1] for v in mine), default=0.0) < TURNING:
        ways.append("in curves" if sideways else "in curves and on the spot")
    slip = max((v.slip[1] for v in mine), default=1.0)
    if floors and slip < LITTLE_SLIP:
        ways.append(f"loaded unevenly (wheels slip by {slip:.1%} at most, with little effect)")
    if not ways and loads:
        return "weigh each wheel"
    return f"drive{where} {listed(ways) if ways else 'more often'}"


def listed(parts: Sequence[str]) -> str:
    """Return the parts joined by commas and a final "and"."""
    return " and ".join([", ".join(parts[:-1]), parts[-1]]) if len(parts) > 1 else parts[0]


def _speeds(validity: Validity) -> int:
    count, last = 0, 0.0
    for speed in sorted(validity.speeds):
        if speed > SPEEDS_DIFFER * max(last, 1e-3):
            count, last = count + 1, float(speed)
    return count
