"""The currents that the estimator expects are those of the fitted robot."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from slipid.control.floor_filter import FloorFilter
from slipid.control.interface import Settings
from slipid.model.geometry import omni
from slipid.model.robot import build, twist, wheel_current
from tests.helpers.known_robot import deploy_known


def test_drag_along_the_drive_is_in_the_currents_that_tell_floors():
    robot = build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ["firm", "soft"])
    robot = eqx.tree_at(
        lambda r: (r.surfaces.roller_drag, r.motor.rolling_drag),
        robot,
        (jnp.array([0.05, 0.4]), jnp.asarray(1.2)),
    )
    known, frame, w = deploy_known(robot), robot.geometry.frame(), jnp.array([3.0, 0.5, -4.0])
    floors = FloorFilter(known, Settings())
    near = jnp.zeros((8, 3))
    for _ in range(10):
        near, amps = eqx.filter_jit(floors.solve)(near, w)
    for k in range(2):
        place = jnp.asarray(k), jnp.asarray(0)
        xi = twist(robot, frame, w, *place)
        alike = int(np.flatnonzero((floors.hypotheses == k).all(axis=1))[0])
        np.testing.assert_allclose(
            amps[alike], wheel_current(robot, frame, xi, w, *place), rtol=1e-6
        )
