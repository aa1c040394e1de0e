"""Robots to be exported: odd names, several loads, verdicts of every kind, wheels of every kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp

from slipid.model.geometry import Geometry, mecanum, omni
from slipid.model.robot import build
from slipid.robot.deployed import DeployedRobot
from tests.helpers.known_robot import deploy_known

ODD = ('wet | "sand" -->', "class", "Wet sand", "2nd")
"""Names of floors that no parameter can have, two of them alike in letters and digits but one."""
LOADS = ("as built", "moved")
AXES = ("along", "across", "yaw")


def known(shape: Geometry, floors: Sequence[str] = ("firm", "soft")) -> DeployedRobot:
    """A robot without any doubt, on floors that differ."""
    made = build(shape, floors, LOADS)
    some = jnp.linspace(1.0, 2.0, len(floors))
    share = jnp.arange(1.0, shape.wheels + 1)
    share = jnp.stack([jnp.full(shape.wheels, 1 / shape.wheels), share / share.sum()])
    made = eqx.tree_at(
        lambda r: (
            r.surfaces.friction,
            r.surfaces.creep,
            r.body.load_share,
            r.body.mass_ratio,
            r.motor.rotor_inertia,
        ),
        made,
        (0.3 * some, 0.1 * some**2, share, jnp.asarray([1.0, 1.3]), jnp.asarray(1e-5 / 3)),
    )
    std = {
        f"process.{f}.{a}": 0.003 * (k + n + 1)
        for n, f in enumerate(floors)
        for k, a in enumerate(AXES)
    }
    std |= {
        f"run.{f}.{a}": 0.01 * (k + n + 1) for n, f in enumerate(floors) for k, a in enumerate(AXES)
    }
    return deploy_known(made, LOADS[0], std=std, highest_speed=8.1)


def doubtful() -> DeployedRobot:
    """An omni robot with odd names, messages and numbers of every verdict."""
    shape = omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0)
    robot = known(shape, ODD)
    numbers = dict(robot.record.parameters)
    pair, three = (4.1, 1e6 / 3), ((-1e-5, 0.01), (0.0, 0.02), (-0.1, 1 / 3))
    doubts = {
        "motor.resistance": ("not_identified", "borrowed", pair),
        "motor.back_emf": ("at_bound", "borrowed", pair),
        "robot.load_share@moved": ("disputed", "measured", three),
        "robot.mass": ("weak", "measured", pair),
        "robot.drive_offset": ("identified", "measured", three),
    }
    for path, (verdict, provenance, ends) in doubts.items():
        more = {"verdict": verdict, "provenance": provenance, "interval90": ends}
        numbers[path] = replace(numbers[path], **more)
    numbers["robot.drive_offset"] = replace(
        numbers["robot.drive_offset"], value=(0.001, -0.002, 1 / 3000)
    )
    said = ('say "aloud",\n"x\x07 --> | and*/ more',)
    record = replace(robot.record, parameters=numbers, messages=said)
    return DeployedRobot.of(record, LOADS[0])


def mecanum_robot() -> DeployedRobot:
    """Four mecanum wheels at corners."""
    return known(mecanum(0.2, 0.15, 0.05, 20.0))
