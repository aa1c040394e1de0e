"""What a key means: the line about it in the docstring of the class that declares it.

Every parameter of a robot: its unit, what it means, and what is believed of it beforehand.
"""

import inspect
import math
import re
from dataclasses import dataclass, fields, is_dataclass
from fnmatch import fnmatchcase
from functools import lru_cache

import numpy as np
from pydantic import BaseModel

from slipid.app.config import Config, Motor, Setting, geometry
from slipid.infer.bench.motor import BenchMotor, BenchRoot
from slipid.model.geometry import omni
from slipid.model.robot import Robot
from slipid.parameter import Declaration, Entry, entries

_STARTS = re.compile(r"^([a-z_0-9]+(?:, [a-z_0-9]+)*): (.+)$")
_MORE = re.compile(r"; (?=[a-z_0-9]+: )")


@lru_cache(maxsize=64)
def meanings(kind: type) -> dict[str, str]:
    """Meaning of each key of a model or a dataclass, also those that it inherits."""
    found: dict[str, str] = {}
    for one in reversed(kind.__mro__):
        if one.__doc__ and (issubclass(one, BaseModel) or is_dataclass(one)):
            found |= _attributes(one.__doc__)
    return found


def meaning(kind: type, key: str) -> str:
    """Meaning of one key; KeyError where its class does not say it."""
    found = meanings(kind)
    if key not in found:
        raise KeyError(f"the docstring of {kind.__name__} has no attribute line for '{key}'")
    return found[key]


def in_short(kind: type, key: str) -> str:
    """The same up to its first full stop, colon or semicolon, for a comment beside a value."""
    return re.split(r"[.:;](?= |$)", meaning(kind, key))[0]


def purpose(kind: type) -> str:
    """What the class says of itself before it comes to its attributes."""
    text = inspect.cleandoc(kind.__doc__ or "").split("\n\nAttributes:")[0]
    return " ".join(text.split())


def keys(kind: type) -> tuple[str, ...]:
    """Keys in the order of declaration, as a config spells them."""
    if issubclass(kind, BaseModel):
        return tuple(field.alias or name for name, field in kind.model_fields.items())
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else ()


def _attributes(docstring: str) -> dict[str, str]:
    """Lines `key: text` below `Attributes:`, continued by lines that stand further in."""
    _, _, block = inspect.cleandoc(docstring).partition("Attributes:\n")
    found: dict[str, str] = {}
    names: tuple[str, ...] = ()
    for line in block.splitlines():
        if line.strip() and not line.startswith("    "):
            break
        started = _STARTS.match(line[4:])
        if started:
            names = tuple(started[1].split(", "))
            text = started[2]
        elif line.strip() and names:
            text = f"{found[names[0]]} {line.strip()}"
        else:
            continue
        found |= dict.fromkeys(names, text)
    return {name: part for key, text in found.items() for name, part in _several(key, text)}


def _several(key: str, text: str) -> list[tuple[str, str]]:
    """Attributes that share a line: `mean: its centre; std: its width`."""
    first, *others = _MORE.split(text)
    pairs = [(key, first)]
    for other in others:
        name, _, said = other.partition(": ")
        pairs.append((name, said))
    return pairs


FLOOR, SESSION = "FLOOR", "SESSION"
"""What stands for names that only the logs tell."""


@dataclass(frozen=True)
class ParameterRow:
    """A parameter in words.

    Attributes:
        path: its name; size: how many numbers it has.
        symbol: in the equations.
        unit: of it.
        means: what it is.
        start: what it is where nothing else is known.
        prior: what is believed of it by default, or that it is not fitted.
        here: what the config says instead.
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
    """The parameters of a config's robot, or of one with three omni wheels."""
    if config is None:
        whole = Robot.of(omni([60.0, 180.0, 300.0], 0.125, 0.04)).on((FLOOR,), sessions=(SESSION,))
        return [_row(entry, whole, {}) for entry in entries(whole)]
    content = config.content
    if isinstance(content.robot, Motor):
        bench = BenchRoot(BenchMotor())
        return [_row(entry, bench, content.parameters) for entry in entries(bench)]
    floors = [FLOOR if s.surface == "folder" else s.surface for s in content.logs if s.map is None]
    loads = tuple(dict.fromkeys(section.load for section in content.logs))
    shape, mass = geometry(content.robot), content.robot.mass_kg
    robot = Robot.of(shape) if mass is None else Robot.of(shape, mass)
    whole = robot.on(tuple(dict.fromkeys(floors)), loads, (SESSION,))
    return [_row(entry, whole, content.parameters) for entry in entries(whole)]


def _row(entry: Entry, robot: Robot | BenchRoot, settings: dict[str, Setting]) -> ParameterRow:
    one = entry.declaration
    value = np.atleast_1d(np.asarray(entry.get(robot), float))
    start = f"{value[0]:.4g}" if np.ptp(value) == 0 else ", ".join(f"{v:.4g}" for v in value)
    said = [
        _said(choice) for pattern, choice in settings.items() if fnmatchcase(entry.path, pattern)
    ]
    return ParameterRow(
        *(entry.path, entry.size, one.symbol, one.unit, one.doc, start, prior(one)),
        here="; ".join(said),
    )


def prior(one: Declaration) -> str:
    """The default prior in words: its width where it is fitted, else what it would be."""
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


def _said(choice: Setting) -> str:
    """What a config wants of a parameter."""
    if choice.fixed is not None:
        return f"fixed = {choice.fixed}"
    said = [] if choice.start is None else [f"start = {choice.start}"]
    if choice.free is not None:
        said.append("fitted" if choice.free else "not fitted")
    if choice.prior is not None:
        said.append(f"prior {choice.prior.mean} +- {choice.prior.std}")
    return ", ".join(said)
