"""Priors of the parameters of a robot's motor, from a fit of that motor on a test bench."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slipid.app.config import Config
from slipid.search_space import Choice
from slipid.support.errors import DataError
from slipid.support.files import read_json

SCHEMA = "slipid.identified/1"
COPY_NAME = "motor_bench.json"
"""Name of the copy of the bench file in the folder of a robot's results."""
GEAR_STD = 0.3
"""Std of the change of friction by the robot's gear, relative to the friction on the bench [1]."""
NAMES = ("resistance", "back_emf", "brush_drop", "coulomb_friction", "viscous_friction")
"""Names of the parameters taken from a bench. Sensor offsets are not, since they belong to the
meters of the bench."""
_EXPECTED = "what `slipid identify` of a motor, or `slipid motor --out`, wrote"


@dataclass(frozen=True)
class BenchEstimate:
    """Estimate of one parameter of one motor on a bench: value, std and verdict."""

    value: float
    std: float
    verdict: str


@dataclass(frozen=True)
class BenchFile:
    """Content of a bench file.

    Attributes:
        path: path of the file.
        numbers: estimates of each parameter, one for each motor, by the parameter's name.
    """

    path: Path
    numbers: Mapping[str, list[BenchEstimate]]


def bench_of(config: Config) -> BenchFile | None:
    """Return the bench file that a config names, or None if it names none.

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
    return BenchFile(path, _read(path, f"{config.path}: robot.motor"))


def bench_priors(config: Config, gear_ratio: float) -> tuple[list[Choice], list[str]]:
    """Return priors of `motor.*` from a config's bench file, and lines about what was taken.

    With a gear ratio n, a friction torque at the shaft is n times as large at the wheel, and a
    friction torque per speed n^2 times.

    Raises:
        DataError: the file is missing, damaged, or not the result of a bench.
    """
    bench = bench_of(config)
    if bench is None:
        return [], []
    path = bench.path
    choices, left_out = [], []
    for name in NAMES:
        sure = [t for t in bench.numbers.get(name, []) if t.verdict == "identified"]
        if not sure:
            left_out.append(name)
            continue
        power = {"coulomb_friction": 1, "viscous_friction": 2}.get(name, 0)
        mean, std = _pooled(sure)
        if power and gear_ratio > 1:
            std = float(np.hypot(std, GEAR_STD * mean))
        times = gear_ratio**power
        choices.append(Choice(f"motor.{name}", prior_mean=times * mean, prior_std=times * std))
    lines = [f"motor from {path}: {', '.join(c.pattern for c in choices) or 'nothing'}"]
    if left_out:
        lines.append(f"not taken from {path}, not identified there: {', '.join(left_out)}")
    return choices, lines


def _pooled(sure: list[BenchEstimate]) -> tuple[float, float]:
    """Return the mean of the estimates of several motors, and the std of a single motor's value.

    The std combines the std of the estimates with their spread between motors.
    """
    values = [t.value for t in sure]
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
    return float(np.mean(values)), float(np.hypot(spread, np.mean([t.std for t in sure])))


def _read(path: Path, where: str) -> Mapping[str, list[BenchEstimate]]:
    """Return the estimates in a bench file by the parameter's name, one for each motor.

    `where` is the config and key that name the file, for messages.
    """
    content = read_json(path, _EXPECTED)
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA or content.get("drive") != "motor":
        found = "a robot's numbers" if schema == SCHEMA else f"schema {schema}"
        raise DataError(f"{where}: {path}: {found}; expected {_EXPECTED}")
    estimates: dict[str, list[BenchEstimate]] = {}
    try:
        for full, number in content["parameters"].items():
            if number["std"] is not None:
                name = full.partition("@")[0].removeprefix("motor.")
                known = float(number["value"]), float(number["std"]), str(number["verdict"])
                estimates.setdefault(name, []).append(BenchEstimate(*known))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(f"{where}: {path}: damaged ({error}); expected {_EXPECTED}") from error
    return estimates
