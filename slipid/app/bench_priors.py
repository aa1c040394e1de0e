"""What a bench told of a motor, as priors of the robot that it drives."""

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
"""Copy of the file beside a robot's results."""
GEAR_STD = 0.3
"""Part of a friction that a gear may add to it, or take, as a std: a bench may have run without."""
NAMES = ("resistance", "back_emf", "brush_drop", "coulomb_friction", "viscous_friction")
"""Zeros belong to the bench's meters; what has no part in a robot's fit is not asked for."""
_EXPECTED = "what `slipid identify` of a motor, or `slipid motor --out`, wrote"


@dataclass(frozen=True)
class BenchEstimate:
    """What a bench says of one number of one motor."""

    value: float
    std: float
    verdict: str


@dataclass(frozen=True)
class BenchFile:
    """A bench's file, and its numbers by name, one for each of its motors."""

    path: Path
    numbers: Mapping[str, list[BenchEstimate]]


def bench_of(config: Config) -> BenchFile | None:
    """The bench that the config names, None where it names none.

    Raises:
        DataError: the file is missing, damaged, or of no bench.
    """
    named = config.content.wheels.motor
    if named is None:
        return None
    # a result keeps a copy, so that later commands need no other folder
    kept = config.path.parent / COPY_NAME
    path = kept if kept.is_file() else config.path.parent / named
    return BenchFile(path, _read(path, f"{config.path}: robot.motor"))


def bench_priors(config: Config, gear_ratio: float) -> tuple[list[Choice], list[str]]:
    """Priors of `motor.*` from the file that the config names, and lines about what was not taken.

    At the wheel a friction of the shaft is n times, per wheel speed n^2 times as large.

    Raises:
        DataError: as of `bench_of`.
    """
    bench = bench_of(config)
    if bench is None:
        return [], []
    path, told = bench.path, bench.numbers
    choices, left = [], []
    for name in NAMES:
        sure = [t for t in told.get(name, []) if t.verdict == "identified"]
        if not sure:
            left.append(name)
            continue
        power = {"coulomb_friction": 1, "viscous_friction": 2}.get(name, 0)
        mean, std = _pooled(sure)
        if power and gear_ratio > 1:
            std = float(np.hypot(std, GEAR_STD * mean))
        times = gear_ratio**power
        choices.append(Choice(f"motor.{name}", prior_mean=times * mean, prior_std=times * std))
    lines = [f"motor from {path}: {', '.join(c.pattern for c in choices) or 'nothing'}"]
    if left:
        lines.append(f"not taken from {path}, for it is not identified there: {', '.join(left)}")
    return choices, lines


def _pooled(sure: list[BenchEstimate]) -> tuple[float, float]:
    """Mean of several motors, and std of one of them: its error and how they differ."""
    values = [t.value for t in sure]
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
    return float(np.mean(values)), float(np.hypot(spread, np.mean([t.std for t in sure])))


def _read(path: Path, where: str) -> Mapping[str, list[BenchEstimate]]:
    """Numbers of a bench by name, one for each of its motors."""
    content = read_json(path, _EXPECTED)
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA or content.get("drive") != "motor":
        found = "a robot's numbers" if schema == SCHEMA else f"schema {schema}"
        raise DataError(f"{where}: {path}: {found}; expected {_EXPECTED}")
    told: dict[str, list[BenchEstimate]] = {}
    try:
        for full, number in content["parameters"].items():
            if number["std"] is not None:
                name = full.partition("@")[0].removeprefix("motor.")
                known = float(number["value"]), float(number["std"]), str(number["verdict"])
                told.setdefault(name, []).append(BenchEstimate(*known))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(f"{where}: {path}: damaged ({error}); expected {_EXPECTED}") from error
    return told
