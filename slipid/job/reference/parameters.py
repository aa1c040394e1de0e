"""Every parameter of a robot: its unit, what it means, and what is believed of it beforehand."""

import math
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from slipid.identify.bench.motor import Bench, BenchMotor
from slipid.job.config import Config, Motor, Setting, geometry
from slipid.model.geometry import omni
from slipid.model.robot import Robot
from slipid.parameter import Declaration, Entry, entries

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
        bench = Bench(BenchMotor())
        return [_row(entry, bench, content.parameters) for entry in entries(bench)]
    floors = [FLOOR if s.surface == "folder" else s.surface for s in content.logs if s.map is None]
    loads = tuple(dict.fromkeys(section.load for section in content.logs))
    shape, mass = geometry(content.robot), content.robot.mass_kg
    robot = Robot.of(shape) if mass is None else Robot.of(shape, mass)
    whole = robot.on(tuple(dict.fromkeys(floors)), loads, (SESSION,))
    return [_row(entry, whole, content.parameters) for entry in entries(whole)]


def _row(entry: Entry, robot: Robot | Bench, settings: dict[str, Setting]) -> ParameterRow:
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
