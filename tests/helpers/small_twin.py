"""A small deployed robot on two floors, for tests of the twin."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp

from slipid.model.geometry import omni
from slipid.model.robot import build
from slipid.robot.deployed import DeployedRobot
from slipid.robot.filter.floor import Floor
from tests.helpers.known_robot import deploy_known

AXES = ("along", "across", "yaw")


@cache
def deployed(process: float = 0.0, run: float = 0.0, current: float = 0.0) -> DeployedRobot:
    """Firm and soft floor; stds of what the model misses in units of the defaults of a fit."""
    robot = build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ["firm", "soft"])
    robot = eqx.tree_at(
        lambda r: (r.surfaces.friction, r.surfaces.creep),
        robot,
        (jnp.array([0.6, 0.3]), jnp.array([0.05, 0.4])),
    )
    std = {}
    for f in ("firm", "soft"):
        for axis, p, e in zip(AXES, (0.005, 0.002, 0.01), (0.01, 0.01, 0.03), strict=True):
            std |= {f"process.{f}.{axis}": p * process, f"run.{f}.{axis}": e * run}
        std |= {f"current.{f}.{k}": 0.05 * current for k in ("window", "run")}
    return deploy_known(robot, std=std, highest_speed=8.0)


def floor(cells: list[list[int]]) -> Floor:
    """Two metres square about the origin."""
    return Floor(jnp.asarray(cells), jnp.array([-1.0, -1.0]), jnp.asarray(2.0 / len(cells)))


def stacked(trees: list) -> object:
    """Trees as one with a leading axis."""
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)
