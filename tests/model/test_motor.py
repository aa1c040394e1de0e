"""The DC motor against its equations, limits and a simulated winding."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model.motor import REST, Motor, signed

MOTOR = Motor(
    resistance=jnp.asarray(5.95),
    back_emf=jnp.asarray(0.0514),
    inductance=jnp.asarray(8.9e-3),
    efficiency=jnp.asarray(0.8),
    gear_ratio=16.0,
)
SPEEDS = jnp.linspace(-12.0, 12.0, 41)  # at the wheel [rad/s]


def test_steady_voltage_is_the_drop_and_the_back_emf():
    current = jnp.asarray([0.0, 0.5, -0.5, 1.0])
    wheel_speed = jnp.asarray([2.0, 2.0, 2.0, 0.0])
    expected = [0.0514 * 32, 5.95 * 0.5 + 0.0514 * 32, -5.95 * 0.5 + 0.0514 * 32, 5.95]
    np.testing.assert_allclose(MOTOR.voltage(current, wheel_speed), expected, rtol=1e-12)


def test_torque_and_current_are_inverses():
    current = jnp.linspace(-2.0, 2.0, 41)
    back = MOTOR.current(MOTOR.torque(current, SPEEDS), SPEEDS)
    np.testing.assert_allclose(back, current, atol=1e-12)


def test_torque_constant_is_the_back_emf_constant():
    """Without friction and losses mechanical power is U I less the heat of the winding."""
    ideal = Motor(
        resistance=jnp.asarray(5.95),
        back_emf=jnp.asarray(0.0514),
        efficiency=jnp.asarray(1.0),
        coulomb_friction=jnp.asarray(0.0),
        viscous_friction=jnp.asarray(0.0),
        gear_ratio=16.0,
    )
    current = jnp.linspace(-2.0, 2.0, 41)
    mechanical = ideal.torque(current, SPEEDS) * SPEEDS
    electrical = ideal.voltage(current, SPEEDS) * current - 5.95 * current**2
    np.testing.assert_allclose(mechanical, electrical, atol=1e-12)


def test_a_gear_loses_a_part_of_what_the_motor_turns_with():
    current = jnp.linspace(-2.0, 2.0, 41)
    kept = MOTOR.torque(current, SPEEDS) + MOTOR.friction(SPEEDS)
    np.testing.assert_allclose(kept, 16.0 * 0.8 * 0.0514 * current, atol=1e-14)


def test_friction_opposes_the_motion():
    friction = np.asarray(MOTOR.friction(SPEEDS))
    moves = np.abs(np.asarray(SPEEDS)) > 1e-9
    assert (friction[moves] * np.asarray(SPEEDS)[moves] > 0).all()
    np.testing.assert_allclose(MOTOR.friction(-SPEEDS), -friction, atol=1e-15)
    idle = MOTOR.torque(jnp.zeros(41), SPEEDS)
    np.testing.assert_allclose(idle, -friction, atol=1e-15)


def test_brush_drop_is_a_voltage_with_the_sign_of_the_current():
    drops = Motor(resistance=jnp.asarray(2.0), brush_drop=jnp.asarray(0.7), gear_ratio=16.0)
    plain = Motor(resistance=jnp.asarray(2.0), gear_ratio=16.0)
    current = jnp.asarray([-1.0, 0.0, 1.0])
    extra = drops.voltage(current, jnp.ones(3)) - plain.voltage(current, jnp.ones(3))
    np.testing.assert_allclose(extra, [-0.7, 0.0, 0.7], atol=1e-12)


# the paper's torque characterising variable


def test_characteristic_is_power_over_speed_far_from_standstill():
    wheel_speed = jnp.asarray([5.0, 8.0, 12.0, -9.0])
    current = jnp.asarray([0.4, 0.9, 0.2, -0.6])
    wm = 16.0 * wheel_speed
    power = MOTOR.voltage(current, wheel_speed) * current
    # regularisation is a share (w0 / wm)^2 of the R I^2 term
    tolerance = np.max(5.95 * current**2 / jnp.abs(wm) * (REST / wm) ** 2)
    np.testing.assert_allclose(
        MOTOR.characteristic(current, wheel_speed), power / wm, atol=float(tolerance)
    )


def test_characteristic_is_the_plain_torque_at_standstill():
    current = jnp.linspace(-2.0, 2.0, 41)
    np.testing.assert_allclose(
        MOTOR.characteristic(current, jnp.zeros(41)), 0.0514 * current, atol=1e-15
    )
    slope = jax.vmap(jax.grad(lambda i, w: MOTOR.characteristic(i[None], w[None])[0], argnums=1))
    at_rest = slope(current, jnp.zeros(41))
    np.testing.assert_allclose(at_rest, 5.95 * current**2 * 16.0 / REST**2, rtol=1e-9)


def test_characteristic_mirrors_with_the_direction():
    current = jnp.linspace(-2.0, 2.0, 41)
    forth = MOTOR.characteristic(current, SPEEDS)
    np.testing.assert_allclose(MOTOR.characteristic(-current, -SPEEDS), -forth, atol=1e-15)


def test_rpm_would_make_the_heat_term_9_55_times_too_small():
    current, wheel_speed = jnp.asarray([0.8]), jnp.asarray([10.0])
    heat = MOTOR.characteristic(current, wheel_speed) - 0.0514 * current
    rpm = 60 / (2 * np.pi)
    wrong = MOTOR.characteristic(current, wheel_speed * rpm) - 0.0514 * current
    assert float(heat[0] / wrong[0]) == pytest.approx(9.55, rel=2e-3)


# unsigned currents


def test_an_unsigned_current_gets_the_sign_of_the_speed():
    current = jnp.full(41, 0.7)
    got = np.asarray(signed(current, SPEEDS, 16.0))
    fast = np.abs(np.asarray(SPEEDS)) * 16 > 10 * REST
    np.testing.assert_allclose(got[fast], (0.7 * np.sign(SPEEDS))[fast], rtol=6e-3)
    assert got[20] == pytest.approx(0.0, abs=1e-12)
    assert (np.diff(got) > 0).all()


def test_braking_looks_like_driving():
    braking = jnp.asarray([-0.7])
    np.testing.assert_allclose(signed(braking, jnp.asarray([5.0]), 16.0)[0], 0.7, rtol=1e-3)


def test_a_motor_bears_drag_along_the_drive_beside_traction():
    motor_force = jnp.asarray([[0.2, 0.1], [-0.3, -0.05]])
    np.testing.assert_array_equal(MOTOR.opposing_force(motor_force), [0.2, -0.3])
    dragged = replace(MOTOR, rolling_drag=jnp.asarray(1.2))
    np.testing.assert_allclose(dragged.opposing_force(motor_force), [0.32, -0.36], rtol=1e-12)
