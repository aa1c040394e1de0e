"""Reading and writing of robot.json; a failed write leaves the old file unchanged.

`typed` turns JSON values into dataclasses. `robot.schema.json` in this folder describes the
file for other programs.
"""

import json
import re
import sys
import typing
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, fields, is_dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

import jax.numpy as jnp
import numpy as np

from slipid.model.geometry import Geometry
from slipid.model.robot import build
from slipid.parameter import Declaration, Entry, entries
from slipid.robot.record import (
    UNITS,
    EffectRecord,
    Numbers,
    RobotRecord,
    Setting,
)
from slipid.support.errors import DataError
from slipid.support.files import checksum, read_bytes, write_bytes
from slipid.support.parsing import json_of

_MOST = sys.float_info.max
_PLAIN = {bool: "true or false", str: "a string", int: "a whole number", NoneType: "null"}


def typed(kind: Any, value: object, where: str = "") -> Any:
    """Convert a JSON value to a dataclass; numbers must be finite, keys complete and known.

    Args:
        kind: a dataclass, or the type of one of its fields: bool, int, float, str, None, a
            `Literal`, a tuple, a mapping by str, a union or a dataclass.
        value: value returned by `json.loads`.
        where: path of the value in the file, such as `floors[0].name`, for messages.

    Raises:
        ValueError: a key is missing or unknown, or a value has another type; the message gives its
            path in the file.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return _one_of(inner, value, where)
    if origin is Literal:
        if not isinstance(value, str) or value not in inner:
            raise _wrong(where, value, " or ".join(repr(x) for x in inner))
        return value
    if origin is tuple:
        return _items(inner, value, where)
    if origin is Mapping:
        if not isinstance(value, dict):
            raise _wrong(where, value, "an object")
        return {k: typed(inner[1], v, f"{where}['{k}']") for k, v in value.items()}
    if is_dataclass(kind):
        return _object(kind, value, where)
    if kind is float:
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _MOST:
            return float(value)
        raise _wrong(where, value, "a number")
    if type(value) is not kind:
        raise _wrong(where, value, _PLAIN[kind])
    return value


def _one_of(kinds: tuple[Any, ...], value: object, where: str) -> Any:
    if value is None and NoneType in kinds:
        return None
    *others, last = (k for k in kinds if k is not NoneType)
    for k in others:
        with suppress(ValueError):
            return typed(k, value, where)
    return typed(last, value, where)


def _items(inner: tuple[Any, ...], value: object, where: str) -> tuple[Any, ...]:
    endless = len(inner) == 2 and inner[1] is Ellipsis
    if not isinstance(value, list):
        raise _wrong(where, value, "a list")
    if not endless and len(value) != len(inner):
        raise ValueError(f"{where}: {len(value)} entries; expected {len(inner)}")
    kinds = [inner[0]] * len(value) if endless else inner
    return tuple(
        typed(k, v, f"{where}[{n}]") for n, (k, v) in enumerate(zip(kinds, value, strict=True))
    )


def _object(kind: Any, value: object, where: str) -> Any:
    if not isinstance(value, dict):
        raise _wrong(where, value, "an object")
    hints, before = typing.get_type_hints(kind), f"{where}." if where else ""
    names = [f.name for f in fields(kind)]
    for name in names:
        if name not in value:
            raise ValueError(f"the field {before}{name} is missing")
    for name in value:
        if name not in names:
            known = ", ".join(names)
            raise ValueError(f"{before}{name}: no such field; expected only these fields: {known}")
    return kind(**{name: typed(hints[name], value[name], f"{before}{name}") for name in names})


def _wrong(where: str, value: object, expected: str) -> ValueError:
    shown = repr(value)
    shown = shown if len(shown) <= 40 else f"{shown[:37]}..."
    return ValueError(f"{where}: {shown}; expected {expected}")


SCHEMA = "slipid.robot/10"
REWRITE_HINT = "copy it again, or write it again with `slipid identify`"


def write_robot(path: Path, record: RobotRecord) -> None:
    """Write a robot's file; raise `DataError` if it cannot be written."""
    write_bytes(path, robot_bytes(record))


def robot_bytes(record: RobotRecord) -> bytes:
    """Return the content of robot.json."""
    content: dict[str, object] = {"schema": SCHEMA, "units": UNITS, **asdict(record)}
    content["numbers"] = record.numbers
    content["checksum"] = checksum(content)
    return (_text(content) + "\n").encode()


def read_robot(path: Path) -> RobotRecord:
    """Return the record in a robot's file; raise the same errors as `DeployedRobot.load`."""
    content = _content(path)
    written, computed = content.pop("checksum", None), checksum(content)
    del content["schema"]
    if content.pop("units", None) != UNITS:
        raise DataError(
            f"{path}: the units in this file differ from the units of {SCHEMA}; {REWRITE_HINT}"
        )
    numbers = content.pop("numbers", None)
    try:
        record = typed(RobotRecord, content)
        check_record(record)
    except ValueError as error:
        raise DataError(f"{path}: {error}; {REWRITE_HINT}") from error
    if written != computed or numbers != record.numbers:
        raise DataError(
            f"{path}: the content does not match its checksum, so it was changed or damaged after "
            f"it was written; {REWRITE_HINT}"
        )
    return record


def _content(path: Path) -> dict[str, object]:
    """Return the JSON object in a robot's file; raise `DataError` if its schema is not known."""
    raw = read_bytes(path, "a robot.json that `slipid identify` wrote")
    try:
        content = json_of(raw)
    except ValueError as error:
        raise DataError(f"{path}: {error}; {REWRITE_HINT}") from error
    schema = content.get("schema") if isinstance(content, dict) else None
    if not (isinstance(schema, str) and re.fullmatch(r"slipid\.robot/[1-9][0-9]{0,8}", schema)):
        raise DataError(
            f"{path}: not a robot of slipid (its schema is not {SCHEMA}); expected the robot.json "
            "that `slipid identify` writes"
        )
    if schema != SCHEMA:
        newer = int(schema.partition("/")[2]) > int(SCHEMA.partition("/")[2])
        age, then = ("a newer", "update slipid") if newer else ("an older", REWRITE_HINT)
        raise DataError(
            f"{path}: written by {age} slipid as {schema}, but this slipid reads {SCHEMA}; {then}"
        )
    return dict(content)


def _text(value: object, indent: str = "") -> str:
    """Return JSON text with one line per key of an object; a list without objects is one line."""
    inner = indent + " "
    if isinstance(value, dict) and value:
        rows = [f"{inner}{json.dumps(k)}: {_text(v, inner)}" for k, v in value.items()]
        return "{\n" + ",\n".join(rows) + f"\n{indent}}}"
    if isinstance(value, list | tuple) and any(isinstance(v, dict) for v in value):
        return "[\n" + ",\n".join(inner + _text(v, inner) for v in value) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False)


def check_record(record: RobotRecord) -> None:
    """Raise `ValueError` if parts of a record contradict each other.

    The message gives the field and the expected content.
    """
    wheels = len(record.wheels.place)
    if not wheels:
        raise ValueError("wheels.place: no entries; expected one entry for every wheel")
    for name in ("drive_angle", "roller_angle", "grips"):
        _counted(f"wheels.{name}", getattr(record.wheels, name), wheels)
    # geometry_of raises ValueError for wheels that cannot drive, or that have no drive
    drives = geometry_of(record).drives
    for kind, names in (("floors", record.labels), ("loads", [x.name for x in record.loads])):
        if not names or len(set(names)) < len(names):
            raise ValueError(
                f"{kind} {list(names)}; expected at least one name, and each name only once"
            )
    for floor in record.floors:
        for name in ("kinematics", "calibration"):
            for row in getattr(floor, name) or ():
                _counted(f"floors, {floor.name}: {name}", row, drives)
    for row in record.nominal or ():
        _counted("nominal", row, drives)
    _steered(record)
    for load in record.loads:
        _counted(f"loads, {load.name}: spread", load.spread, len(record.floors))
        _counted(f"loads, {load.name}: wheel_curve", load.wheel_curve, drives)
        if load.inverse_kinematics is not None:
            _counted(
                f"loads, {load.name}: inverse_kinematics",
                load.inverse_kinematics,
                len(record.floors),
            )
            for rows in load.inverse_kinematics:
                _counted(f"loads, {load.name}: inverse_kinematics, rows of a floor", rows, drives)
        if load.told is not None:
            _check_effects(f"loads, {load.name}: told", load.told, len(record.floors))
    _check_settings(record)
    _numbers(record)


def _check_settings(record: RobotRecord) -> None:
    """Raise `ValueError` for a limit, a std or a time that is not positive, or a delay below 0."""
    for group in ("limits", "sensors", "actuators"):
        for name, setting in vars(getattr(record, group)).items():
            if not isinstance(setting, Setting):
                continue
            may_be_0 = group == "actuators"  # actuators may answer at once
            if setting.value < 0 or (setting.value == 0 and not may_be_0):
                expected = "0 or more" if may_be_0 else "a positive number"
                raise ValueError(f"{group}.{name}.value: {setting.value}; expected {expected}")


def _steered(record: RobotRecord) -> None:
    """Raise `ValueError` if a record has only some of the numbers of a robot that steers."""
    driven = record.wheels.driven
    if driven not in (None, "rear", "front"):
        raise ValueError(f"wheels.driven: '{driven}'; expected rear, front or null")
    parts = [record.steering, *(of for f in record.floors for of in (f.kinematics, f.wheelbase))]
    if driven is not None and None in parts:
        raise ValueError(
            "wheels.driven is given, but not steering, or not kinematics and wheelbase of every "
            "floor; expected all of them, since a robot that steers has no force balance"
        )


def geometry_of(record: RobotRecord) -> Geometry:
    """Return the geometry of a record's wheels, with fitted parameters at their start values."""
    plain = Geometry(**vars(record.wheels))
    return replace(
        plain, drive_offset=jnp.zeros(plain.wheels), radius_deviation=jnp.zeros(plain.drives)
    )


def _check_effects(where: str, table: EffectRecord, floors: int) -> None:
    """Raise `ValueError` for an effect table with unsorted speeds or with missing rows."""
    speeds = table.speeds
    if not speeds or speeds[0] <= 0 or any(a >= b for a, b in pairwise(speeds)):
        raise ValueError(
            f"{where}.speeds: {list(speeds)}; expected positive speeds in rising order"
        )
    around = len(table.mean[0][0]) if table.mean and table.mean[0] else 0
    for name, by_floor in (("mean", table.mean), ("left", table.left)):
        _counted(f"{where}.{name}", by_floor, floors)
        for rows in by_floor:
            _counted(f"{where}.{name}, rows of a floor", rows, len(speeds))
            for row in rows:
                _counted(f"{where}.{name}, directions of a speed", row, max(around, 1))
    if any(x < 0 for rows in table.left for row in rows for axes in row for x in axes):
        raise ValueError(f"{where}.left: a std is below 0; expected 0 or more")


def declared_numbers(record: RobotRecord) -> tuple[Entry, ...]:
    """Return the declarations of all parameters of a record's robot, except the camera's."""
    robot = build(geometry_of(record), record.labels, [load.name for load in record.loads])
    return tuple(e for e in entries(robot) if e.part != "camera")


def _numbers(record: RobotRecord) -> None:
    known = {e.path: (e.declaration, e.size) for e in declared_numbers(record)}
    for path in known:
        if path not in record.parameters:
            raise ValueError(f"parameters['{path}'] is missing")
    for path in (*record.parameters, *record.draws):
        if path not in known:
            raise ValueError(
                f"'{path}' is not a parameter of a robot with the record's wheels, floors and load "
                f"set-ups; expected a path such as '{next(iter(known))}'"
            )
    for path, number in record.parameters.items():
        (declaration, size), where = known[path], f"parameters['{path}']"
        _inside(f"{where}.value", number.value, declaration, size)
        if number.unit != declaration.unit:
            raise ValueError(f"{where}.unit: '{number.unit}'; expected '{declaration.unit}'")
        if number.std is not None:
            _sized(f"{where}.std", number.std, size)
        if number.interval90 is not None and (np.ndim(number.interval90) > 1) != (size > 1):
            raise ValueError(
                f"{where}.interval90: wrong number of intervals; expected {size}, one for each "
                "element of the parameter"
            )
    counts = {len(rows) for rows in record.draws.values()}
    if len(counts) > 1 or 0 in counts:
        raise ValueError(
            f"draws: parameters have {sorted(counts)} draws; expected the same number, at least 1, "
            "for every parameter"
        )
    for path, rows in record.draws.items():
        for k, row in enumerate(rows):
            _inside(f"draws['{path}'][{k}]", row, *known[path])


def _counted(name: str, values: tuple[object, ...], count: int) -> None:
    if len(values) != count:
        raise ValueError(f"{name}: {len(values)} entries; expected {count}")


def _sized(where: str, value: Numbers, size: int) -> None:
    if np.shape(value) != (() if size == 1 else (size,)):
        raise ValueError(
            f"{where}: {np.size(value)} elements; expected "
            f"{'one number' if size == 1 else f'a list of {size} numbers'}"
        )


def _inside(where: str, value: Numbers, declaration: Declaration, size: int) -> None:
    """Raise `ValueError` if a value has a wrong size or breaks a rule of its declaration."""
    _sized(where, value, size)
    if rule := declaration.broken_rule(np.asarray(value)):
        raise ValueError(f"{where} = {value}: expected {rule}")
