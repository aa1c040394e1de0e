"""The currents that the estimator expects are those of the fitted robot."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model.geometry import omni
from slipid.model.robot import build
from slipid.robot.estimator import Estimator
from slipid.robot.filter.floor_filter import FloorFilter
from slipid.robot.filter.hypotheses import hypotheses_of
from slipid.robot.filter.wheels import MotorCurrents, read_currents
from slipid.robot.interface import Measurement, Settings
from tests.helpers.known_robot import deploy_known
from tests.helpers.small_twin import deployed


@pytest.mark.slow
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
        near, amps = eqx.filter_jit(floors.solve)(near, w, w)
    for k in range(2):
        standing = robot.standing(frame, jnp.asarray(k), jnp.asarray(0))
        xi = standing.twist(w)
        alike = int(np.flatnonzero((hypotheses_of(known).under == k).all(axis=1))[0])
        np.testing.assert_allclose(amps[alike], standing.current(xi, w), rtol=1e-6)


@pytest.mark.slow
def test_where_frictions_are_open_currents_rule_out_no_mixture_of_floors():
    """The soft floor has thrice the friction it is thought to have, two wheels stand on it."""
    robot, w = deployed(current=1.0), jnp.array([5.0, -1.0, -4.0])
    truth = eqx.tree_at(lambda r: r.floors.friction, robot, jnp.array([0.6, 1.0]))
    near = jnp.zeros((8, 3))
    for _ in range(10):
        near, amps = eqx.filter_jit(FloorFilter(truth, Settings()).solve)(near, w, w)

    def believed(covariance):
        known = eqx.tree_at(lambda r: r.friction_covariance, robot, covariance)
        watched = Estimator(known, Settings(current_is_signed=True, further_floor_penalty=0.0))
        state = watched.init()
        for _ in range(100):
            reading = Measurement(wheel_speed=w, current=amps[3])
            state, _ = watched.step(state, reading, 0.02)
        return float(state.floors.belief[3] / state.floors.belief[0])

    sure, unsure = believed(jnp.zeros((2, 2))), believed(jnp.diag(jnp.array([0.0, 0.5])))
    assert unsure > 2 * sure
    alike = believed(jnp.full((2, 2), 0.5))  # what floors share tells nothing apart
    np.testing.assert_allclose(alike, sure, rtol=1e-6)


@pytest.mark.parametrize("turn", [0.3, np.nan])
def test_evidence_is_that_of_normal_errors_of_the_readings(turn):
    """Up to what is the same under every hypothesis and under none of them."""
    robot, s = deployed(1.0, 1.0, 0.3), Settings()
    floors, rng = FloorFilter(robot, s), np.random.default_rng(0)
    shape = hypotheses_of(robot).under.shape
    xi = 0.2 * rng.normal(size=(shape[0], 3))
    predicted = 0.5 + 0.3 * rng.normal(size=shape)
    amps, heard = np.array([0.4, -0.7, 0.1]), np.array([2, 1, 0])
    currents = MotorCurrents(
        jnp.asarray(amps), jnp.asarray(heard), jnp.full(3, 1e-3), jnp.zeros(())
    )
    w = jnp.array([3.0, 0.1, -2.0])
    told, none = floors._evidence(
        jnp.asarray(xi), jnp.asarray(predicted), currents, w, jnp.asarray(turn)
    )
    std = np.asarray(robot.current_std)[hypotheses_of(robot).under]
    var = std**2 + 1e-3 + np.asarray(floors._stiction(w))
    var = var + np.asarray(floors._of_friction(jnp.asarray(predicted)))
    size = np.hypot(predicted, 0.03)
    gaps = {0: (predicted - amps)[:, 0], 1: (size - abs(amps))[:, 1]}
    parts = [(gaps[k], var[:, k]) for k in gaps]
    if np.isfinite(turn):
        speed = np.maximum(np.linalg.norm(xi[:, :2], axis=1), 0.02)
        yaw = np.mean(np.asarray(robot.effect)[:, 2]) * speed
        parts.append((xi[:, 2] - turn, s.gyro_std**2 + yaw**2))
    worst = (s.unknown_std + 1) ** 2
    wanted = sum(-0.5 * (np.minimum(g**2 / v, worst) + np.log(v)) for g, v in parts)
    of_none = sum(-0.5 * (s.unknown_std**2 + np.log(v.mean())) for _, v in parts)
    np.testing.assert_allclose(told - none, wanted - of_none, rtol=1e-10)


@pytest.mark.parametrize("drop", [0.0, 1.5])
def test_an_ammeter_and_a_voltmeter_count_by_how_sure_each_is(drop):
    robot, w = deployed(), jnp.array([3.0, -2.0, 0.0])
    robot = eqx.tree_at(lambda r: r.motor.brush_drop, robot, jnp.asarray(drop))
    s = Settings(current_is_signed=True, ammeter_std_a=0.2, voltmeter_std_v=0.3, filter_s=1e-9)
    amps, by_volts = np.array([0.2, -0.3, 0.1]), np.array([0.3, -0.1, 0.0])
    zero = amps + float(robot.motor.current_offset)
    volts = robot.motor.voltage(jnp.asarray(by_volts), w)
    whole = Measurement(current=zero, voltage=volts).filled(3)
    found = read_currents(robot, s, jnp.zeros(3), whole, w, jnp.asarray(0.05))
    of_amps, of_volts = 0.2**-2, (0.3 / float(robot.motor.resistance)) ** -2
    mean = (of_amps * amps + of_volts * by_volts) / (of_amps + of_volts)
    np.testing.assert_allclose(found.filtered, mean, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.variance, 1 / (of_amps + of_volts), rtol=1e-12)
    for one, value, sure in (("current", amps, of_amps), ("voltage", by_volts, of_volts)):
        part = Measurement(**{one: zero if one == "current" else volts}).filled(3)
        found = read_currents(robot, s, jnp.zeros(3), part, w, jnp.asarray(0.05))
        np.testing.assert_allclose(found.filtered, value, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.variance, 1 / sure, rtol=1e-12)
