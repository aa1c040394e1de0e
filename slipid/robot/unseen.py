"""Floors that nobody drove on: what a robot may meet beside the floors that it has learnt.

Floors differ most by how soft they are. From one to another of the floors in the public logs of
2022 and on the virtual test site, the logs of creep and of what rollers drag rise together, with a
slope of 0.8. So a floor that nobody drove on is taken for the middle of those that were driven on,
made softer or harder, with more friction or less. Currents, and a gyro, tell which of them a
strange floor is like; without either they count for little, being rare. Their numbers are not
identified, and the motion on them is unsure by a tenth of the way and 0.3 rad per metre.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from slipid.robot.record import Axes, FloorRecord, LoadRecord, Numbers, RecordedNumber, RobotRecord

SOFTNESS = (-2.0, -1.0, 0.0, 1.0, 2.0)
"""Log of the creep over that of the middle floor; its declared spread over floors is 1.5."""
DRAG = 0.8
"""Power of the creep with which the rollers' drag grows from floor to floor."""
GRIP = (-0.4, 0.4)
"""Log of the friction over that of the middle floor; its declared spread over floors is 0.5."""
EFFECT: Axes = (0.1, 0.1, 0.3)
"""Std of what the model misses all the way on such a floor [m/m, m/m, rad/m]."""
LOUDER = 1.5
"""Std of the currents' error on such a floor, over that of the floors that were driven on."""
_SIGNED = ("lead", "load_bias")
_NAME = "unseen_{}"


def with_unseen(record: RobotRecord) -> RobotRecord:
    """The robot with floors that nobody drove on, `unseen_1` and on, after its own.

    A robot that has them already is returned as it is.

    Raises:
        ValueError: a floor that was driven on has the name of one of them.
    """
    if any(floor.unseen for floor in record.floors):
        return record
    middle = _middle(record)
    cells = tuple(product(SOFTNESS, GRIP))
    names = [_NAME.format(k + 1) for k in range(len(cells))]
    if taken := set(names) & set(record.labels):
        raise ValueError(f"floor '{min(taken)}': the name of one that nobody drove on")
    parameters = dict(record.parameters)
    for name, (soft, grip) in zip(names, cells, strict=True):
        factor = {"creep": soft, "roller_drag": DRAG * soft, "friction": grip}
        for quantity, number in middle.items():
            value = float(np.exp(factor[quantity])) if quantity in factor else 1.0
            parameters[f"surface.{name}.{quantity}"] = replace(
                number, value=_scaled(number.value, value)
            )
    process = np.mean([floor.process for floor in record.floors], axis=0)
    current_std = LOUDER * float(np.mean([floor.current_std for floor in record.floors]))
    one = FloorRecord("", _axes(process), EFFECT, current_std, seen=None, unseen=True)
    floors = tuple(replace(one, name=name) for name in names)
    return replace(
        record,
        parameters=parameters,
        floors=record.floors + floors,
        loads=tuple(_load(load, len(names)) for load in record.loads),
    )


def _middle(record: RobotRecord) -> dict[str, RecordedNumber]:
    """Numbers of a floor in the middle of those that were driven on, geometric where positive."""
    first = f"surface.{record.labels[0]}."
    middle_floor: dict[str, RecordedNumber] = {}
    for path, number in record.parameters.items():
        if not path.startswith(first):
            continue
        quantity = path.removeprefix(first)
        each = np.array([record.parameters[f"surface.{n}.{quantity}"].value for n in record.labels])
        signed = quantity in _SIGNED
        middle = each.mean(axis=0) if signed else np.exp(np.log(each).mean(axis=0))
        value: Numbers = tuple(middle.tolist()) if middle.ndim else float(middle)
        middle_floor[quantity] = RecordedNumber(
            value=value,
            unit=number.unit,
            std=None,
            interval90=None,
            verdict="not_identified",
            provenance="borrowed",
            source="given",
        )
    return middle_floor


def _scaled(value: Numbers, factor: float) -> Numbers:
    return tuple(factor * x for x in value) if isinstance(value, tuple) else factor * value


def _load(load: LoadRecord, count: int) -> LoadRecord:
    """A load set-up with so many floors more, of whose effects nothing is told."""
    spread = _axes(np.mean(load.spread, axis=0))
    one = replace(load, spread=load.spread + (spread,) * count)
    if load.told is None:
        return one
    nothing, left = (0.0, 0.0, 0.0), _axes(np.hypot(EFFECT, spread))
    around, speeds = len(load.told.mean[0][0]), len(load.told.speeds)

    def more(axes: Axes) -> tuple[tuple[tuple[Axes, ...], ...], ...]:
        return ((((axes,) * around),) * speeds,) * count

    mean, rest = load.told.mean + more(nothing), load.told.left + more(left)
    return replace(one, told=replace(load.told, mean=mean, left=rest))


def _axes(values: Sequence[float] | np.ndarray) -> Axes:
    along, across, yaw = (float(x) for x in values)
    return along, across, yaw
