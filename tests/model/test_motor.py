"""The DC motor against its equations, limits and a simulated winding."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.infer.bench.motor import BenchMotor
from slipid.model.motor import REST, Motor, sign_of_motion, signed

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


BRUSHES = replace(
    MOTOR,
    brush_drop=jnp.asarray(0.4),
    brush_current=jnp.asarray(0.2),
    brush_shape=jnp.asarray(0.5),
    brush_tail=jnp.asarray(0.2),
)


def test_a_robot_has_the_brush_drop_of_a_bench():
    names = ("brush_drop", "brush_current", "brush_shape", "brush_tail")
    bench = BenchMotor(**{name: getattr(BRUSHES, name) for name in names})
    size = jnp.asarray([0.0, 0.01, 0.2, 3.0])
    drop, slope = bench.contact_voltage(size, jnp.asarray(0.0))
    rest = jnp.zeros(4)
    for sign in (1.0, -1.0):
        found = BRUSHES.voltage(sign * size, rest) - MOTOR.voltage(sign * size, rest)
        np.testing.assert_allclose(found, sign * drop, rtol=1e-12, atol=1e-15)
    slopes = jax.vmap(jax.grad(lambda i: BRUSHES.voltage(i[None], rest[:1])[0]))(size)
    np.testing.assert_allclose(slopes, 5.95 + slope, rtol=1e-12)


INVERTED = (
    *(
        (r, drop, scale, k)
        for r in (0.05, 5.95)
        for drop in (0.05, 1.5)
        for scale in (0.01, 5.0)
        for k in (0.0, 1.0)
    ),
    (5.95, -0.02, 1.0, 0.5),
)
"""Resistances, drops, their currents and shapes; noise can make a fitted drop negative."""


@pytest.mark.parametrize(("resistance", "drop", "scale", "shape"), INVERTED)
def test_the_current_at_a_voltage_is_the_inverse_of_the_voltage(resistance, drop, scale, shape):
    motor = replace(
        BRUSHES,
        resistance=jnp.asarray(resistance),
        brush_drop=jnp.asarray(drop),
        brush_current=jnp.asarray(scale),
        brush_shape=jnp.asarray(shape),
    )
    current = jnp.asarray([0.0, 1e-3, -0.02, 0.3, -2.0, 30.0])
    for direction in (None, jnp.full(6, 0.4)):
        volts = motor.voltage(current, jnp.full(6, 2.0), direction)
        back = motor.current_at(volts, jnp.full(6, 2.0), direction)
        np.testing.assert_allclose(back, current, rtol=1e-5, atol=1e-8)


def test_without_a_brush_drop_the_current_at_a_voltage_is_that_of_the_winding():
    volts = jnp.linspace(-24.0, 24.0, 41)
    emf = MOTOR.back_emf * (MOTOR.gear_ratio * SPEEDS)
    found = MOTOR.current_at(volts, SPEEDS)
    np.testing.assert_allclose(found, (volts - emf) / MOTOR.resistance, rtol=4e-16)


@pytest.mark.parametrize("forward", [1.0, 0.7, 0.5])
def test_the_drop_of_a_row_is_the_mean_over_its_directions(forward):
    """A wheel turns forward for a part of the row, and then backward."""
    sign = jnp.asarray([1.0, -1.0])
    part = jnp.asarray([forward, 1 - forward])
    speed, current = 5.0 * sign, 0.6 * sign
    mean = BRUSHES.voltage(current, speed) @ part
    direction = sign_of_motion(speed) @ part
    found = BRUSHES.voltage((current @ part)[None], (speed @ part)[None], direction[None])
    np.testing.assert_allclose(found[0], mean, rtol=1e-3, atol=1e-12)


def test_a_slow_wheel_that_keeps_its_direction_has_the_whole_drop():
    speed, current = jnp.asarray([0.05]), jnp.asarray([0.6])
    found = BRUSHES.voltage(current, speed, sign_of_motion(speed))
    np.testing.assert_allclose(found, BRUSHES.voltage(current, speed), rtol=1e-12)


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
