"""Priors of the parameters of a robot's motor, from a fit of that motor on a test bench."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slipid.app.config import Config
from slipid.infer.verdicts.estimates import Z95
from slipid.model.motor import Motor
from slipid.parameter import Declaration, entries
from slipid.search_space import Choice
from slipid.support.errors import DataError
from slipid.support.files import read_json

SCHEMA = "slipid.identified/1"
COPY_NAME = "motor_bench.json"
"""Name of the copy of the bench file in the folder of a robot's results."""
GEAR_STD = 0.3
"""Std of the change of friction by the robot's gear, relative to the friction on the bench [1]."""
NAMES = (
    *("resistance", "back_emf", "brush_drop", "brush_current", "brush_shape", "brush_tail"),
    *("coulomb_friction", "viscous_friction"),
)
"""Names of the parameters taken from a bench. Sensor offsets are not taken, since they belong to
the meters of the bench."""
KNOWN = ("identified", "weak")
"""Verdicts with which a parameter is taken from a bench."""
_EXPECTED = "the identified.json that `slipid identify` of a motor, or `slipid motor --out`, wrote"


Intervals = dict[str, list[tuple[float, float]]]
"""90 % intervals of a parameter for each motor whose bench determines it, by the parameter's name.
"""


class _Prior(NamedTuple):
    """Mean and std of a prior [unit of the parameter]."""

    mean: float
    std: float


def bench_of(config: Config) -> tuple[Path, Intervals] | None:
    """Return the bench file that a config names and its intervals, or None if it names none.

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
    path, known = bench
    declared = {e.path: e.declaration for e in entries(Motor())}
    choices = []
    for name in (name for name in NAMES if name in known):
        power = {"coulomb_friction": 1, "viscous_friction": 2}.get(name, 0)
        wider = GEAR_STD if power and gear_ratio > 1 else 0.0
        prior = _prior(declared[name], known[name], wider)
        times = gear_ratio**power
        choices.append(
            Choice(f"motor.{name}", prior_mean=times * prior.mean, prior_std=times * prior.std)
        )
    lines = [f"motor from {path}: {', '.join(c.pattern for c in choices) or 'nothing'}"]
    if left_out := [name for name in NAMES if name not in known]:
        lines.append(f"not taken from {path}, since not identified there: {', '.join(left_out)}")
    return choices, lines


def _prior(d: Declaration, intervals: list[tuple[float, float]], wider: float) -> _Prior:
    """Return the prior of a single motor of which several were measured.

    Each interval counts as that of a normal distribution of the logarithm, or of the log-odds for a
    parameter with two bounds. The std combines the width of the intervals with the spread of their
    centres. So it contains all that an interval does, such as the models that a log does not
    distinguish, or the range of a resistance that changes with current.

    Args:
        d: declaration of the parameter.
        intervals: 90 % interval of each motor.
        wider: further std of the logarithm.
    """
    positive = replace(d, lower=0.0) if np.isinf(d.lower) else d
    ends = np.array([positive.to_search(pair) for pair in intervals])
    centres, stds = ends.mean(axis=1), np.diff(ends)[:, 0] / (2 * Z95)
    spread = np.std(centres, ddof=1) if len(centres) > 1 else 0.0
    z, std = centres.mean(), np.linalg.norm([spread, stds.mean(), wider])
    low, mean, high = positive.to_si(z + Z95 * std * np.array([-1.0, 0.0, 1.0])).tolist()
    # The brush drop of a robot has any sign and a normal prior: its interval has the same width.
    return _Prior(mean, float(d.slope(mean) * std if d is positive else (high - low) / (2 * Z95)))


def _read(path: Path, where: str) -> Intervals:
    """Return the intervals of the parameters that a bench determines, from its file.

    `where` is the config and key that name the file, for messages.
    """
    content = read_json(path, _EXPECTED)
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA or content.get("drive") != "motor":
        found = (
            "the parameters of a robot, not of a motor" if schema == SCHEMA else f"schema {schema}"
        )
        raise DataError(f"{where}: {path}: {found}; expected {_EXPECTED}")
    known: Intervals = {}
    try:
        for full, number in content["parameters"].items():
            if number["verdict"] in KNOWN:
                name = full.partition("@")[0].removeprefix("motor.")
                low, high = map(float, number["interval90"])
                if name in NAMES and not 0 < low < high:
                    raise ValueError(f"{full}: interval from {low} to {high}")
                known.setdefault(name, []).append((low, high))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(f"{where}: {path}: damaged ({error}); expected {_EXPECTED}") from error
    return known
