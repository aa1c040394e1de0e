"""Descriptions of config keys and parameters in words, made from the code that checks them.

The meaning of a key is its line in the docstring of the class that declares it; its possible values
follow from its type. The unit, meaning and default prior of a parameter are in its declaration.
"""

import inspect
import math
import re
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from slipid.app.config import BenchMotors, Config, ParameterSection, geometry
from slipid.infer.bench.motor import BenchMotor, BenchRoot
from slipid.model.geometry import omni
from slipid.model.robot import Robot
from slipid.parameter import Declaration, Entry, entries
from slipid.support.quantities import Bounds

_ATTRIBUTE = re.compile(r"^([a-z_0-9]+(?:, [a-z_0-9]+)*): (.+)$")
_NEXT_ATTRIBUTE = re.compile(r"; (?=[a-z_0-9]+: )")


@lru_cache(maxsize=64)
def meanings(kind: type) -> dict[str, str]:
    """Return the meaning of each key of a model or a dataclass, including inherited keys."""
    found: dict[str, str] = {}
    for one in reversed(kind.__mro__):
        if one.__doc__ and (issubclass(one, BaseModel) or is_dataclass(one)):
            found |= _attributes(one.__doc__)
    return found


def meaning(kind: type, key: str) -> str:
    """Return the meaning of one key; raise `KeyError` if its class does not explain it."""
    found = meanings(kind)
    if key not in found:
        raise KeyError(f"the docstring of {kind.__name__} has no attribute line for '{key}'")
    return found[key]


def in_short(kind: type, key: str) -> str:
    """Return the meaning of a key up to its first full stop, colon or semicolon."""
    return re.split(r"[.:;](?= |$)", meaning(kind, key))[0]


def purpose(kind: type) -> str:
    """Return the docstring of a class without its list of attributes."""
    text = inspect.cleandoc(kind.__doc__ or "").split("\n\nAttributes:")[0]
    return " ".join(text.split())


def keys(kind: type) -> dict[str, str]:
    """Return the key, as a config spells it, of each attribute of a model or a dataclass.

    Attributes are in the order of declaration.
    """
    if issubclass(kind, BaseModel):
        return {name: field.alias or name for name, field in kind.model_fields.items()}
    return {field.name: field.name for field in fields(kind)} if is_dataclass(kind) else {}


def _attributes(docstring: str) -> dict[str, str]:
    """Return the text of each attribute in the list below `Attributes:` of a docstring."""
    _, _, block = inspect.cleandoc(docstring).partition("Attributes:\n")
    found: dict[str, str] = {}
    names: tuple[str, ...] = ()
    for line in block.splitlines():
        if line.strip() and not line.startswith("    "):
            break
        started = _ATTRIBUTE.match(line[4:])
        if started:
            names = tuple(started[1].split(", "))
            text = started[2]
        elif line.strip() and names:
            text = f"{found[names[0]]} {line.strip()}"
        else:
            continue
        found |= dict.fromkeys(names, text)
    return {name: part for key, text in found.items() for name, part in _split_line(key, text)}


def _split_line(key: str, text: str) -> list[tuple[str, str]]:
    """Return the (name, text) of each attribute in a line such as `mean: centre; std: width`."""
    first, *others = _NEXT_ATTRIBUTE.split(text)
    pairs = [(key, first)]
    for other in others:
        name, _, text = other.partition(": ")
        pairs.append((name, text))
    return pairs


FLOOR, SESSION = "FLOOR", "SESSION"
"""Placeholders for the names of floors and sessions, which only the logs have."""


@dataclass(frozen=True)
class ParameterRow:
    """Description of a parameter in words.

    Attributes:
        path: path of the parameter, by which a config names it.
        size: number of its entries.
        symbol: symbol in the equations.
        unit: unit of its values.
        means: meaning of the parameter.
        start: declared start value.
        prior: default prior, with a remark if the parameter is not fitted.
        here: choice for the parameter in the config; empty if there is none.
    """

    path: str
    size: int
    symbol: str
    unit: str
    means: str
    start: str
    prior: str
    here: str = ""


def parameter_rows(config: Config | None = None) -> list[ParameterRow]:
    """Return the parameters of a config's robot, or of a robot with three omni wheels."""
    if config is None:
        whole = Robot.of(omni([60.0, 180.0, 300.0], 0.125, 0.04)).on((FLOOR,), sessions=(SESSION,))
        return [_row(entry, whole, {}) for entry in entries(whole)]
    content = config.content
    if isinstance(content.robot, BenchMotors):
        bench = BenchRoot(BenchMotor())
        return [_row(entry, bench, content.parameters) for entry in entries(bench)]
    floors = [FLOOR if s.surface == "folder" else s.surface for s in content.logs if s.map is None]
    loads = tuple(dict.fromkeys(section.load for section in content.logs))
    shape, mass = geometry(content.robot), content.robot.mass_kg
    robot = Robot.of(shape) if mass is None else Robot.of(shape, mass)
    whole = robot.on(tuple(dict.fromkeys(floors)), loads, (SESSION,))
    return [_row(entry, whole, content.parameters) for entry in entries(whole)]


def _row(
    entry: Entry, robot: Robot | BenchRoot, settings: dict[str, ParameterSection]
) -> ParameterRow:
    one = entry.declaration
    value = np.atleast_1d(np.asarray(entry.get(robot), float))
    start = f"{value[0]:.4g}" if np.ptp(value) == 0 else ", ".join(f"{v:.4g}" for v in value)
    choices = [
        _setting_text(choice)
        for pattern, choice in settings.items()
        if fnmatchcase(entry.path, pattern)
    ]
    return ParameterRow(
        *(entry.path, entry.size, one.symbol, one.unit, one.doc, start, prior(one)),
        here="; ".join(choices),
    )


def prior(one: Declaration) -> str:
    """Return the default prior of a parameter in words, with a remark if it is not fitted."""
    if one.shares:
        width = f"shares around an even load, log-std {one.spread:g}"
    elif one.deviation:
        width = f"deviations of sum 0, std up to {one.spread:g}"
    elif math.isinf(one.lower):
        width = f"normal, std {one.spread:g}"
    elif math.isinf(one.upper):
        above = f" above {one.lower:g}" if one.lower else ""
        width = f"log-normal{above}, log-std {one.spread:g}"
    else:
        width = f"between {one.lower:g} and {one.upper:g}, std {one.spread:g} in log-odds"
    return width if one.free else f"not fitted; if free: {width}"


def _setting_text(choice: ParameterSection) -> str:
    """Return the choice that a config has for a parameter, in words."""
    if choice.fixed is not None:
        return f"fixed = {choice.fixed}"
    parts = [] if choice.start is None else [f"start = {choice.start}"]
    if choice.free is not None:
        parts.append("fitted" if choice.free else "not fitted")
    if choice.prior is not None:
        parts.append(f"prior {choice.prior.mean} +- {choice.prior.std}")
    return ", ".join(parts)


_PLAIN = {
    str: "text",
    Path: "text",
    bool: "true or false",
    int: "whole number",
    float: "number",
    object: "anything",
    NoneType: "nothing",
}


@dataclass(frozen=True)
class ConfigKey:
    """A key of a config: its name, possible values, default and meaning in words."""

    name: str
    kind: str
    default: str
    means: str


def keys_of(kind: type, hidden: tuple[str, ...] = ()) -> list[ConfigKey]:
    """Return every key of a model or a dataclass."""
    hints = get_type_hints(kind, include_extras=True)
    found = []
    for name, key in keys(kind).items():
        if key in hidden:
            continue
        hint = hints[name]
        limits = tuple(kind.model_fields[name].metadata) if issubclass(kind, BaseModel) else ()
        # The type of the key `drive` lists its few values, so its meaning need not be explained.
        listed = key == "drive" and get_origin(hint) is Literal
        means = "" if listed else meaning(kind, key)
        found.append(ConfigKey(key, in_words(hint, limits), _default(kind, name), means))
    return found


def in_words(hint: object, limits: tuple[object, ...] = ()) -> str:
    """Return a type in words, with limits such as "> 0"."""
    origin, inside = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return in_words(inside[0], (*limits, *inside[1:]))
    if origin in (Union, UnionType):
        words = dict.fromkeys(in_words(one, limits) for one in inside if one is not NoneType)
        return " or ".join(words)
    if origin is Literal:
        return " or ".join(f'"{value}"' for value in inside)
    if origin in (list, tuple):
        return _list(inside, limits)
    if origin is not None and issubclass(origin, Mapping):
        return f"table of ({in_words(inside[1])})"
    if isinstance(hint, type) and issubclass(hint, BaseModel):
        return "table"
    if hint in _PLAIN and isinstance(hint, type):
        return _PLAIN[hint] + _limits(limits)
    return "table"


def _list(inside: tuple[object, ...], limits: tuple[object, ...]) -> str:
    """Return a list type in words, with the number of its members if that is fixed."""
    members = [one for one in inside if one is not Ellipsis]
    element = in_words(members[0])
    # If a validator makes a tuple of a single value, this value may be written without a list.
    alone = any(type(limit).__name__ == "BeforeValidator" for limit in limits)
    counted = len(members) > 1 and Ellipsis not in inside
    many = f"{len(members)} " if counted else _length_text(limits)
    listed = f"list of {many}({element})" if " " in element else f"list of {many}{element}s"
    return f"{element} or {listed}" if alone else listed


def _length_text(limits: tuple[object, ...]) -> str:
    least = next((one.min_length for one in _unpacked(limits) if isinstance(one, MinLen)), 0)
    most = next((one.max_length for one in _unpacked(limits) if isinstance(one, MaxLen)), None)
    if least == most:
        return f"{least} "
    return f"at least {least} " if least > 1 else ""


def _limits(limits: tuple[object, ...]) -> str:
    signs = {Gt: (">", "gt"), Ge: (">=", "ge"), Lt: ("<", "lt"), Le: ("<=", "le")}
    unpacked = _unpacked(limits)
    if within := next((one for one in unpacked if isinstance(one, Bounds)), None):
        return f" {within}"
    bounds = {
        f"{sign} {getattr(one, attribute):g}"
        for one in unpacked
        for kind, (sign, attribute) in signs.items()
        if isinstance(one, kind)
    }
    return f" {' and '.join(sorted(bounds, reverse=True))}" if bounds else ""


def _unpacked(limits: tuple[object, ...]) -> list[object]:
    """Return all limits of a type, those inside `Field(...)` included."""
    return [m for one in limits for m in (one.metadata if isinstance(one, FieldInfo) else [one])]


def _default(kind: type, name: str) -> str:
    """Return the default of a key in words, or "required" if there is none."""
    if issubclass(kind, BaseModel):
        field = kind.model_fields[name]
        value = field.get_default(call_default_factory=True)
        return "required" if value is PydanticUndefined else _toml_text(value)
    assert is_dataclass(kind)
    one = next(f for f in fields(kind) if f.name == name)
    if one.default_factory is not MISSING:
        return _toml_text(one.default_factory())
    return "required" if one.default is MISSING else _toml_text(one.default)


def _toml_text(value: object) -> str:
    """Return a value as a config spells it."""
    if value is None or value in ({}, [], ()) or isinstance(value, BaseModel):
        return "none"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list | tuple):
        parts = [_toml_text(one) for one in value]
        return parts[0] if isinstance(value, tuple) and len(parts) == 1 else f"[{', '.join(parts)}]"
    return f'"{value}"' if isinstance(value, str) else f"{value:g}" if value != "" else '""'
