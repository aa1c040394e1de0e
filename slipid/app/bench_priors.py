"""Priors of the parameters of a robot's motor, from a fit of that motor on a test bench."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slipid.app.config import Config
from slipid.infer.verdicts.draws import Z95
from slipid.model.motor import Motor
from slipid.parameter import Declaration, entries
from slipid.search_space import Choice
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.files import read_json
from slipid.support.quantities import Number, limits_of

SCHEMA = "slipid.identified/1"
COPY_NAME = "motor_bench.json"
"""Name of the copy of the bench file in the folder of a robot's results."""
GEAR_STD = 0.3
"""Std of the change of friction by the robot's gear, relative to the friction on the bench [1]."""
CURVE = ("brush_current", "brush_shape", "brush_tail")
"""Names of the parameters that shape the drop of the brushes, which are taken with it."""
NAMES = ("resistance", "back_emf", "brush_drop", *CURVE, "coulomb_friction", "viscous_friction")
"""Names of the parameters taken from a bench. Sensor offsets are not taken, since they belong to
the meters of the bench."""
NO_DROP_V = 1e-6
"""Fixed drop of the brushes below which a motor has none [V]."""
WEAK_STD = 0.1
"""Least std of the logarithm of a weak number: a misfit may be larger than its interval [1]."""
KNOWN = ("identified", "weak")
"""Verdicts with which a parameter is taken from a bench."""
_SIZE = limits_of(Number)
_EXPECTED = "the identified.json that `slipid identify` of a motor, or `slipid motor --out`, wrote"


class _Found(NamedTuple):
    """A parameter of one motor in a bench file.

    Attributes:
        value: estimate, or the fixed value.
        ends: 90 % interval, None if it is fixed.
        verdict: verdict.
    """

    value: float
    ends: tuple[float, float] | None
    verdict: str


FoundNumbers = dict[str, list[_Found]]
"""A parameter of each motor of a bench file, keyed by the parameter's name."""


class _Prior(NamedTuple):
    """Mean and std of a prior [unit of the parameter]."""

    mean: float
    std: float


def bench_of(config: Config) -> tuple[Path, FoundNumbers] | None:
    """Return the bench file that a config names and its numbers, or None if it names none.

    Raises:
        DataError: the file is missing, damaged, or not the result of a bench.
    """
    named = config.content.wheels.motor
    if named is None:
        return None
    # The folder of a robot's results has a copy of the file, so that later commands do not need
    # the bench's folder.
    kept = config.path.parent / COPY_NAME
    path = kept if kept.is_file() else config.path.parent / named
    return path, _read(path, f"{config.path}: robot.motor")


def bench_priors(config: Config, gear_ratio: float) -> tuple[list[Choice], list[str]]:
    """Return priors of `motor.*` from a config's bench file, and lines about the used parameters.

    With a gear ratio n, a friction torque at the shaft is n times as large at the wheel, and a
    friction torque per speed is n^2 times as large.

    Raises:
        DataError: the file is missing, damaged, or not the result of a bench.
    """
    bench = bench_of(config)
    if bench is None:
        return [], []
    path, found = bench
    taken = _taken(found)
    declared = _declared()
    choices = []
    for name, numbers in taken.items():
        power = {"coulomb_friction": 1, "viscous_friction": 2}.get(name, 0)
        times, free = gear_ratio**power, [one for one in numbers if one.ends is not None]
        if not free:
            value = float(np.mean([one.value for one in numbers]))
            choices.append(Choice(f"motor.{name}", fixed=value))
            continue
        prior = _prior(declared[name], free, GEAR_STD if power and gear_ratio > 1 else 0.0)
        choices.append(
            Choice(f"motor.{name}", prior_mean=times * prior.mean, prior_std=times * prior.std)
        )
    lines = [f"motor from {path}: {', '.join(c.pattern for c in choices) or 'nothing'}"]
    if left_out := [name for name in NAMES if name not in taken]:
        lines.append(f"not taken from {path}, since not identified there: {', '.join(left_out)}")
    return choices, lines


def _declared() -> dict[str, Declaration]:
    """Return the declaration of each parameter of a robot's motor, keyed by name."""
    return {e.path: e.declaration for e in entries(Motor())}


def _taken(found: FoundNumbers) -> FoundNumbers:
    """Return the numbers that a robot takes, in the order of `NAMES`.

    A drop of the brushes that was fixed is taken, too, since the resistance was fitted with it. A
    drop has the curve with which it was fitted, whatever the log says about that curve.
    """
    out = {
        name: [one for one in numbers if one.verdict in KNOWN] for name, numbers in found.items()
    }
    if not out.get("brush_drop"):
        out["brush_drop"] = [
            one
            for one in found.get("brush_drop", [])
            if one.verdict == "fixed" and one.value > NO_DROP_V
        ]
    for name in CURVE:
        out[name] = found.get(name, []) if out["brush_drop"] else []
    return {name: out[name] for name in NAMES if out.get(name)}


def _prior(d: Declaration, numbers: list[_Found], wider: float) -> _Prior:
    """Return the prior of a single motor of which several were measured.

    Each interval counts as that of a normal distribution of the logarithm, or of the log-odds for a
    parameter with two bounds, with a std of at least `WEAK_STD` unless it is identified. The std
    combines the width of the intervals with the spread of their centres.

    Args:
        d: declaration of the parameter.
        numbers: parameter of each motor, with an interval.
        wider: further std of the logarithm.
    """
    positive = replace(d, lower=0.0) if np.isinf(d.lower) else d
    ends = np.array([positive.to_search(np.array(one.ends)) for one in numbers])
    least = [0.0 if one.verdict == "identified" else WEAK_STD for one in numbers]
    centres, stds = ends.mean(axis=1), np.maximum(np.diff(ends)[:, 0] / (2 * Z95), least)
    spread = np.std(centres, ddof=1) if len(centres) > 1 else 0.0
    z, std = centres.mean(), np.linalg.norm([spread, stds.mean(), wider])
    low, mean, high = positive.to_si(z + Z95 * std * np.array([-1.0, 0.0, 1.0])).tolist()
    if d is positive:
        return _Prior(mean, float(d.slope(mean) * std))
    # The brush drop of a robot has any sign, and a normal prior with the same interval.
    return _Prior((low + high) / 2, (high - low) / (2 * Z95))


def _read(path: Path, where: str) -> FoundNumbers:
    """Return the parameters of `NAMES` in a bench file.

    `where` is the config and key that name the file, for messages.
    """
    content = read_json(path, _EXPECTED)
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA or content.get("drive") != "motor":
        what = (
            "the parameters of a robot, not of a motor" if schema == SCHEMA else f"schema {schema}"
        )
        raise DataError(f"{where}: {path}: {what}; expected {_EXPECTED}")
    found: FoundNumbers = {}
    declared, at = _declared(), ""
    try:
        for full, number in content["parameters"].items():
            name = full.partition("@")[0].removeprefix("motor.")
            if name in NAMES:
                at = full
                found.setdefault(name, []).append(_number(number, declared[name]))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        damage = f"{at}: {error}" if at else f"{error}"
        raise DataError(f"{where}: {path}: damaged ({damage}); expected {_EXPECTED}") from error
    return found


def _number(number: Content, declared: Declaration) -> _Found:
    """Return a parameter from its entry in a bench file.

    Args:
        number: the entry.
        declared: declaration of the parameter of a robot's motor.

    Raises:
        KeyError, TypeError, ValueError: the entry is damaged.
    """
    verdict, ends = number["verdict"], number["interval90"]
    value = _SIZE.checked(number["value"])
    if verdict in KNOWN and ends is None:
        raise ValueError("no interval")
    if ends is None:
        return _Found(value, None, verdict)
    low, high = map(_SIZE.checked, ends)
    if 0 < low < high < declared.upper:
        return _Found(value, (low, high), verdict)
    if verdict in KNOWN:
        raise ValueError(f"interval from {low} to {high}")
    return _Found(value, None, verdict)
