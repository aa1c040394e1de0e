"""Which channel or which run would tell numbers apart that the data leave open."""

from collections.abc import Mapping, Sequence, Set

import numpy as np

from slipid.model.robot import Validity
from slipid.parameter import Entry

VOLTAGE = "log the motor voltage (or duty and bus voltage)"
_SCALE = ("motor.resistance", "motor.back_emf", "motor.efficiency", "motor.brush_drop")
_DRAG = ("motor.coulomb_friction", "motor.viscous_friction")
_FLOOR = "surface"
_CAMERA = (
    (
        ("camera.scale", "robot.wheel_radius"),
        "measure the wheel radius, or a length in the camera's picture, motion tells no more",
    ),
    (
        ("camera.marker_yaw", "robot.drive_offset"),
        "measure how the marker stands on the body, no motion tells them apart",
    ),
    (("camera.scale", _FLOOR), "add a floor on which the wheels do not slip"),
    (("robot.wheel_radius", _FLOOR), "add a floor on which the wheels do not slip"),
    (("robot.base_radius",), "turn on the spot"),
    (("camera.marker_place",), "turn on the spot in view of the camera"),
    (("camera.lag",), "start, stop and change speed in view of the camera"),
    *(
        ((f"camera.{name}",), "drive across the whole picture, its corners included")
        for name in ("tilt", "radial", "tangential")
    ),
    (("camera.scale",), "measure a length in the camera's picture"),
    (("robot.wheel_radius",), "measure the wheel radius"),
)
"""Quantities that must all occur (any of a floor) and what helps; the first that fits counts."""
FEW_HEADINGS = 4
"""Directions of travel, opposite ones counted as two, below which more are asked for."""
TURNING = 0.05
"""Yaw rate by the encoders from which a run is a curve [rad/s]."""
LITTLE_SLIP = 0.03
"""Slip below which a floor is hardly felt."""
SPEEDS_DIFFER = 1.3
"""Factor between two speeds from which they count as two."""


def remedy(
    found: Sequence[Entry], has_current: bool, has_voltage: bool, validity: Mapping[str, Validity]
) -> str:
    """What to log or to drive for numbers that are open, by what each floor was driven with."""
    quantities = {e.quantity for e in found}
    electric = all(e.declaration.electric or e.quantity == "robot.mass" for e in found)
    if electric or quantities & {*_SCALE}:
        return _electric(quantities, has_current, has_voltage, validity)
    if any(e.surface is not None for e in found):
        quantities.add(_FLOOR)
    for needed, text in _CAMERA:
        if quantities.issuperset(needed):
            return text
    return _runs(found, validity)


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


def _runs(found: Sequence[Entry], validity: Mapping[str, Validity]) -> str:
    """What to drive for numbers of floors, loads and marker, by what was driven."""
    floors = {e.surface for e in found if e.surface is not None}
    loads = {e.load for e in found if e.load is not None}
    mine = [
        v
        for floor, v in validity.items()
        if (floor in floors if floors else not loads or loads & set(v.loads))
    ]
    where = " there" if floors else " with that load" if loads else ""
    said = []
    headings = sorted({h for v in mine for h in v.headings_deg})
    if len(headings) < FEW_HEADINGS:
        seen = f" than {', '.join(f'{h:g}' for h in headings)} deg" if headings else ""
        said.append(f"in other directions{seen}")
    if any(_speeds(v) < 2 for v in mine) or not mine:
        said.append("at other speeds")
    if max((v.yaw_rate[1] for v in mine), default=0.0) < TURNING:
        said.append("in curves")
    slip = max((v.slip[1] for v in mine), default=1.0)
    if floors and slip < LITTLE_SLIP:
        said.append(f"loaded unevenly (wheels slip by {slip:.1%} at most, so it hardly matters)")
    if not said and loads:
        return "weigh each wheel"
    return f"drive{where} {listed(said) if said else 'more often'}"


def listed(parts: Sequence[str]) -> str:
    """The parts as a sentence lists them."""
    return " and ".join([", ".join(parts[:-1]), parts[-1]]) if len(parts) > 1 else parts[0]


def _speeds(seen: Validity) -> int:
    count, last = 0, 0.0
    for speed in np.sort(np.asarray(seen.speeds, float)):
        if speed > SPEEDS_DIFFER * max(last, 1e-3):
            count, last = count + 1, float(speed)
    return count
