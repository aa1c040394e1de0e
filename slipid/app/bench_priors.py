"""Priors of the parameters of a robot's motor, from a fit of that motor on a test bench."""

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
"""Names of the parameters taken from a bench. Sensor offsets are not taken, since they belong to
the meters of the bench."""
_EXPECTED = "the identified.json that `slipid identify` of a motor, or `slipid motor --out`, wrote"


Identified = dict[str, list[tuple[float, float]]]
"""Value and std of a parameter for each motor in which it is identified, keyed by the parameter's
name."""


def bench_of(config: Config) -> tuple[Path, Identified] | None:
    """Return the bench file that a config names and its estimates, or None if it names none.

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
    choices = []
    for name in (name for name in NAMES if name in known):
        power = {"coulomb_friction": 1, "viscous_friction": 2}.get(name, 0)
        mean, std = _pooled(known[name])
        if power and gear_ratio > 1:
            std = float(np.hypot(std, GEAR_STD * mean))
        times = gear_ratio**power
        choices.append(Choice(f"motor.{name}", prior_mean=times * mean, prior_std=times * std))
    lines = [f"motor from {path}: {', '.join(c.pattern for c in choices) or 'nothing'}"]
    if left_out := [name for name in NAMES if name not in known]:
        lines.append(f"not taken from {path}, since not identified there: {', '.join(left_out)}")
    return choices, lines


def _pooled(known: list[tuple[float, float]]) -> tuple[float, float]:
    """Return the mean of the estimates of several motors, and the std of a single motor's value.

    The std combines the std of the estimates with their spread between motors.
    """
    values, stds = np.transpose(known)
    spread = np.std(values, ddof=1) if len(values) > 1 else 0.0
    return float(np.mean(values)), float(np.hypot(spread, np.mean(stds)))


def _read(path: Path, where: str) -> Identified:
    """Return the identified parameters in a bench file.

    `where` is the config and key that name the file, for messages.
    """
    content = read_json(path, _EXPECTED)
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA or content.get("drive") != "motor":
        found = (
            "the parameters of a robot, not of a motor" if schema == SCHEMA else f"schema {schema}"
        )
        raise DataError(f"{where}: {path}: {found}; expected {_EXPECTED}")
    known: Identified = {}
    try:
        for full, number in content["parameters"].items():
            if number["verdict"] == "identified":
                name = full.partition("@")[0].removeprefix("motor.")
                estimate = float(number["value"]), float(number["std"])
                known.setdefault(name, []).append(estimate)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(f"{where}: {path}: damaged ({error}); expected {_EXPECTED}") from error
    return known
