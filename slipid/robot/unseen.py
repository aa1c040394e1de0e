"""Hypothetical floors for a robot that may drive on floors without identified parameters.

Floors differ mainly in softness. Over the floors in the public logs of 2022 and on the virtual test
site, the logarithm of roller drag rises with the logarithm of creep at a slope of 0.8. So a
hypothetical floor is the geometric mean of the known floors, made softer or harder along this
slope, and with more or less friction. Currents and a gyro show which hypothetical floor an
unfamiliar floor resembles; without these sensors the hypothetical floors have little influence,
since their prior probability is low. Their parameters are not identified, and the motion on them is
uncertain by a tenth of the path length and 0.3 rad per metre.
"""

from dataclasses import replace
from itertools import product

import numpy as np

from slipid.robot.record import (
    Axes,
    FloorRecord,
    LoadRecord,
    RecordedNumber,
    RobotRecord,
    axes_of,
    plain,
)

LOG_CREEPS = (-2.0, -1.0, 0.0, 1.0, 2.0)
"""Log ratios of creep to that of the middle floor (see `_middle`) [1]. The range exceeds the prior
std over floors, which is 1.5."""
DRAG_EXPONENT = 0.8
"""Exponent d of the assumed proportionality of roller drag to creep^d over floors [1]."""
LOG_FRICTIONS = (-0.4, 0.4)
"""Log ratios of friction to that of the middle floor [1]; the prior std over floors is 0.5."""
EFFECT: Axes = (0.1, 0.1, 0.3)
"""Std of the effects on a hypothetical floor [m/m, m/m, rad/m]."""
CURRENT_FACTOR = 1.5
"""Std of modelled currents on a hypothetical floor, relative to the mean of known floors [1]."""
_SIGNED = ("lead", "load_bias")
_NAME = "unseen_{}"


def with_unseen(record: RobotRecord) -> RobotRecord:
    """Return the robot with hypothetical floors `unseen_1`, `unseen_2`, ..., added at the end.

    A robot that already has hypothetical floors is returned unchanged.

    Raises:
        ValueError: a known floor has the name of a hypothetical floor.
    """
    if any(floor.unseen for floor in record.floors):
        return record
    middle = _middle(record)
    grid = tuple(product(LOG_CREEPS, LOG_FRICTIONS))
    names = [_NAME.format(k + 1) for k in range(len(grid))]
    if taken := set(names) & set(record.labels):
        raise ValueError(
            f"floor '{min(taken)}': this name is reserved for hypothetical floors without a run; "
            "rename the floor"
        )
    parameters = dict(record.parameters)
    for name, (soft, grip) in zip(names, grid, strict=True):
        factor = {"creep": soft, "roller_drag": DRAG_EXPONENT * soft, "friction": grip}
        for quantity, number in middle.items():
            value = np.asarray(np.exp(factor.get(quantity, 0.0)) * np.asarray(number.value))
            parameters[f"surface.{name}.{quantity}"] = replace(number, value=plain(value))
    process = np.mean([floor.process for floor in record.floors], axis=0)
    current_std = CURRENT_FACTOR * float(np.mean([floor.current_std for floor in record.floors]))
    one = FloorRecord("", axes_of(process), EFFECT, current_std, seen=None, unseen=True)
    floors = tuple(replace(one, name=name) for name in names)
    return replace(
        record,
        parameters=parameters,
        floors=record.floors + floors,
        loads=tuple(_load(load, len(names)) for load in record.loads),
    )


def _middle(record: RobotRecord) -> dict[str, RecordedNumber]:
    """Return the parameters of the middle floor, keyed by name.

    Parameters are geometric means over the known floors, or arithmetic means if they have a sign.
    """
    first = f"surface.{record.labels[0]}."
    middle_floor: dict[str, RecordedNumber] = {}
    for path, number in record.parameters.items():
        if not path.startswith(first):
            continue
        quantity = path.removeprefix(first)
        each = np.array([record.parameters[f"surface.{n}.{quantity}"].value for n in record.labels])
        signed = quantity in _SIGNED
        middle = each.mean(axis=0) if signed else np.exp(np.log(each).mean(axis=0))
        value = plain(np.asarray(middle))
        middle_floor[quantity] = RecordedNumber(
            value, number.unit, verdict="not_identified", provenance="borrowed"
        )
    return middle_floor


def _load(load: LoadRecord, count: int) -> LoadRecord:
    """Return a load set-up extended by `count` floors whose effects are unknown."""
    spread = axes_of(np.mean(load.spread, axis=0))
    one = replace(load, spread=load.spread + (spread,) * count)
    if load.told is None:
        return one
    left, shape = axes_of(np.hypot(EFFECT, spread)), np.shape(load.told.mean)
    zeros, lefts = ((((axes,) * shape[2],) * shape[1],) * count for axes in ((0.0, 0.0, 0.0), left))
    effects = replace(load.told, mean=load.told.mean + zeros, left=load.told.left + lefts)
    return replace(one, told=effects)
