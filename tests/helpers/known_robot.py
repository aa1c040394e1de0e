"""A deployed robot whose numbers are known, without a fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import jax

from slipid.deploy.deploy import given_numbers
from slipid.deploy.robot_record import robot_record
from slipid.model.robot import Robot
from slipid.robot.deployed import DeployedRobot
from slipid.robot.record import (
    EffectRecord,
    LimitsRecord,
    Setting,
)

ROBOTINO = LimitsRecord(
    *(Setting(value, "config") for value in (0.5, 2.0, 1.0, 13.0, 22.0)),
)
"""Limits of a Robotino; those of `slipid.robot.limits.Limits` by default."""


def deploy_known(
    robot: Robot,
    load: str | None = None,
    std: Mapping[str, float] | None = None,
    draws: Robot | None = None,
    highest_speed: float = 20.0,
    current_trend: tuple[float, float] = (0.0, 0.0),
    effects: Mapping[str, EffectRecord] = MappingProxyType({}),
) -> DeployedRobot:
    """Return the robot with a load set-up; arguments are those of `robot_record`.

    Without posterior draws its numbers have no spread.
    """
    several = jax.tree.map(lambda x: x[None], robot) if draws is None else draws
    record = robot_record(
        robot, given_numbers(robot), std or {}, several, highest_speed, current_trend, {}, effects
    )
    return DeployedRobot.of(replace(record, limits=ROBOTINO), load)
