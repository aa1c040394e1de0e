"""Robots whose motors were fitted, so that they have feed-forward gains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slipid.robot.deployed import DeployedRobot
from slipid.robot.record import RecordedNumber
from tests.helpers.kinds import deployed

STDS = {
    "motor.resistance": 0.1,
    "motor.back_emf": 0.08,
    "motor.coulomb_friction": 0.1,
    "motor.viscous_friction": 0.2,
}
"""Std of each fitted number of the motor, relative to its value."""
CORRELATION = 0.8
"""Correlation of the logarithms of resistance and friction."""


def fitted_motors(kind: str = "differential", draws: int = 4000, **more: object) -> DeployedRobot:
    """A robot with motors as from a fit; `more` are fields of its numbers, keyed by last name."""
    record = deployed(kind).record
    numbers = dict(record.parameters)
    for path, std in STDS.items():
        value = numbers[path].value
        assert isinstance(value, float)
        measured = {"verdict": "identified", "provenance": "measured", "source": "laplace"}
        numbers[path] = replace(numbers[path], std=std * value, **measured)
    for path in ("robot.mass", "robot.yaw_inertia", "motor.rotor_inertia", "motor.efficiency"):
        numbers[path] = replace(numbers[path], provenance="borrowed")
    for name, fields in more.items():
        (path,) = (p for p in numbers if p.endswith(f".{name}"))
        numbers[path] = replace(numbers[path], **fields)
    return DeployedRobot.of(
        replace(record, source="laplace", parameters=numbers, draws=drawn(numbers, draws))
    )


def drawn(numbers: dict[str, RecordedNumber], count: int) -> dict[str, tuple[float, ...]]:
    """Log-normal draws of the motor's numbers."""
    whole = np.eye(len(STDS))
    whole[0, 2] = whole[2, 0] = CORRELATION
    stds = np.array(list(STDS.values()))
    rows = np.random.default_rng(0).multivariate_normal(np.zeros(len(STDS)), whole, size=count)
    logs = (rows * stds).T
    return {p: tuple(numbers[p].value * np.exp(x)) for p, x in zip(STDS, logs, strict=True)}
