"""Whether the parts of a record fit together and its numbers lie within their bounds."""

from dataclasses import fields
from typing import Any

import numpy as np

from slipid.control.robot_file.record import Numbers, RobotRecord
from slipid.model.contact_law import ContactSurface
from slipid.model.geometry import Geometry
from slipid.model.motor import Motor
from slipid.model.robot import Body
from slipid.parameter import Declaration

PER_WHEEL = ("drive_offset", "load_share")
"""Names of numbers of which every wheel has its own."""


def declared(kind: type[Any]) -> dict[str, Declaration]:
    """Declarations of a module's own numbers, by name."""
    return {f.name: f.metadata["parameter"] for f in fields(kind) if "parameter" in f.metadata}


def _known(record: RobotRecord, wheels: int) -> dict[str, tuple[Declaration, int]]:
    """Declaration and size of every number that a robot of this shape has, by path."""
    surfaces = [(f"surface.{label}", ContactSurface) for label in record.labels]
    known = {}
    for prefix, kind in [("robot", Geometry), ("robot", Body), ("motor", Motor), *surfaces]:
        for name, number in declared(kind).items():
            size = wheels if name in PER_WHEEL else 1
            each = [f"@{load.name}" for load in record.loads] if name == "load_share" else [""]
            known |= {f"{prefix}.{name}{of}": (number, size) for of in each}
    return known


def check(record: RobotRecord) -> None:
    """Refuse a record whose parts do not fit together.

    Raises:
        ValueError: says which and how.
    """
    wheels = len(record.wheels.place)
    for name in ("drive_angle", "roller_angle", "grips"):
        _counted(f"wheels.{name}", getattr(record.wheels, name), wheels)
    for kind, names in (("floors", record.labels), ("loads", [x.name for x in record.loads])):
        if not names or len(set(names)) < len(names):
            raise ValueError(f"{kind} {list(names)}; expected one or more, each once")
    for load in record.loads:
        _counted(f"loads, {load.name}: spread", load.spread, len(record.floors))
        _counted(f"loads, {load.name}: wheel_curve", load.wheel_curve, wheels)
    _numbers(record, wheels)


def _numbers(record: RobotRecord, wheels: int) -> None:
    known = _known(record, wheels)
    for path in known:
        if path not in record.parameters:
            raise ValueError(f"parameters['{path}'] is missing")
    for path in (*record.parameters, *record.draws):
        if path not in known:
            raise ValueError(f"'{path}': no such number of a robot with these floors and loads")
    for path, number in record.parameters.items():
        (declaration, size), where = known[path], f"parameters['{path}']"
        _inside(f"{where}.value", number.value, declaration, size)
        if number.unit != declaration.unit:
            raise ValueError(f"{where}.unit: '{number.unit}'; expected '{declaration.unit}'")
        if number.std is not None:
            _sized(f"{where}.std", number.std, size)
        if number.interval90 is not None and (np.ndim(number.interval90) > 1) != (size > 1):
            raise ValueError(f"{where}.interval90: expected {size} intervals")
    counts = {len(rows) for rows in record.draws.values()}
    if len(counts) > 1 or 0 in counts:
        raise ValueError(f"draws: {sorted(counts)} of different numbers; expected as many of each")
    for path, rows in record.draws.items():
        for k, row in enumerate(rows):
            _inside(f"draws['{path}'][{k}]", row, *known[path])


def _counted(name: str, values: tuple[object, ...], count: int) -> None:
    if len(values) != count:
        raise ValueError(f"{name}: {len(values)} entries; expected {count}")


def _sized(where: str, value: Numbers, size: int) -> None:
    if np.shape(value) != (() if size == 1 else (size,)):
        raise ValueError(f"{where}: expected {'one number' if size == 1 else f'{size} numbers'}")


def _inside(where: str, value: Numbers, declaration: Declaration, size: int) -> None:
    """Refuse a value of another size, or one out of its declared bounds."""
    _sized(where, value, size)
    x = np.asarray(value)
    if declaration.shares:
        if not ((x > 0).all() and abs(x.sum() - 1) < 1e-6):
            raise ValueError(f"{where} = {value}: expected positive shares that sum to 1")
    elif not ((x > declaration.lower) & (x < declaration.upper)).all():
        low, high = declaration.lower, declaration.upper
        raise ValueError(f"{where} = {value}: expected inside ({low:g}, {high:g})")
