"""Wheels that share a motor, and wheels whose radii deviate from the config."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model.geometry import differential, general, omni, skid_steer
from slipid.model.robot import build
from slipid.search_space import Choice, Space

OWN = skid_steer(0.2, 0.15, 0.05, 10.0)
SHARED = skid_steer(0.2, 0.15, 0.05, 10.0, drive_of=(0, 1, 0, 1))


def robot(shape):
    made = build(shape, ["floor"])
    return Space(made, [Choice("motor.coulomb_friction", fixed=0.05)]).template


def standing(made):
    """On its only floor, as built."""
    at = jnp.asarray(0)
    return made.standing(made.geometry.frame(), at, at)


def test_a_drive_turns_all_its_wheels():
    assert (OWN.wheels, OWN.drives) == (4, 4)
    assert (SHARED.wheels, SHARED.drives) == (4, 2)
    left_right = jnp.array([3.0, 5.0])
    np.testing.assert_array_equal(SHARED.at_wheels(left_right), [3.0, 5.0, 3.0, 5.0])
    np.testing.assert_array_equal(SHARED.at_drives(jnp.array([1.0, 2.0, 4.0, 8.0])), [5.0, 10.0])
    np.testing.assert_array_equal(OWN.at_drives(jnp.arange(4.0)), jnp.arange(4.0))
    expected = np.asarray(OWN.forward())[:2]  # both wheels of a side roll alike
    np.testing.assert_allclose(SHARED.forward(), expected, atol=1e-12)


@pytest.mark.slow
def test_a_motor_bears_all_wheels_of_its_drive_and_its_own_friction_once():
    drives = jnp.array([3.0, 6.0])
    shared, own = robot(SHARED), robot(OWN)
    wheels = SHARED.at_wheels(drives)
    xi = standing(shared).twist(wheels)
    np.testing.assert_allclose(xi, standing(own).twist(wheels), atol=1e-12)
    both = standing(shared).current(xi, drives)
    each = standing(own).current(xi, wheels)
    friction = own.motor.friction(wheels) / own.motor.gain
    torque = np.asarray(each - friction)
    assert np.abs(torque).max() > 0.1
    np.testing.assert_allclose(both, torque[:2] + torque[2:] + np.asarray(friction)[:2], rtol=1e-9)


def test_the_order_of_drives_is_that_of_the_columns():
    right_first = skid_steer(0.2, 0.15, 0.05, 10.0, drive_of=(1, 0, 1, 0))
    np.testing.assert_array_equal(
        right_first.at_wheels(jnp.array([5.0, 3.0])), [3.0, 5.0, 3.0, 5.0]
    )


@pytest.mark.parametrize("drive_of", [(0, 1), (0, 2, 0, 2), (1, 2, 1, 2)])
def test_drives_that_do_not_go_with_the_wheels_are_refused(drive_of):
    with pytest.raises(ValueError, match="drives of the wheels"):
        skid_steer(0.2, 0.15, 0.05, drive_of=drive_of)


def test_a_larger_left_wheel_bends_what_should_be_straight():
    shape = differential(0.2, 0.1)
    larger = replace(shape, radius_deviation=jnp.array([0.02, 0.0]))
    slick = {"creep": 1e-4, "scrub": 1e-9, "rolling_resistance": 1e-9, "lead": 0.0}
    choices = [Choice(f"surface.floor.{name}", fixed=value) for name, value in slick.items()]
    made = Space(build(larger, ["floor"]), choices).template
    xi = np.asarray(standing(made).twist(jnp.full(2, 5.0)))
    np.testing.assert_allclose(xi[2] / xi[0], -0.02 / (0.4 * 1.01), rtol=1e-3)
    plain = np.asarray(larger.pseudo_inverse()) * 0.1 @ np.full(2, 5.0)
    np.testing.assert_allclose(plain, [0.505, 0.0, -0.025], atol=1e-9)


def test_a_larger_wheel_moves_the_body_as_one_that_turns_faster():
    """Up to how hard it creeps, which counts with the mean radius."""
    shape = omni([60.0, 180.0, 300.0], 0.125, 0.04)
    deviation = jnp.array([0.03, 0.0, -0.03])
    larger = replace(shape, radius_deviation=deviation)
    one, other = build(shape, ["floor"]), build(larger, ["floor"])
    wanted = jnp.array([0.1, 0.05, 0.2])
    speed = larger.forward() @ wanted / 0.04
    faster = speed * (1 + deviation)
    np.testing.assert_allclose(faster, shape.forward() @ wanted / 0.04, rtol=1e-12)
    there = np.asarray(standing(other).twist(speed))
    expected = np.asarray(standing(one).twist(faster))
    np.testing.assert_allclose(there, expected, rtol=0.01)
    neglected = np.asarray(standing(one).twist(speed))
    assert np.abs(neglected / expected - 1).max() > 0.03


def test_wheels_that_all_point_ahead_do_not_tell_motion_sideways():
    for shape in (OWN, SHARED, differential(0.2, 0.1)):
        assert not shape.determines_twist
        back = np.asarray(shape.pseudo_inverse())
        np.testing.assert_allclose(back[1], 0.0, atol=1e-12)
        there = np.asarray(shape.forward()) @ [0.3, 0.0, 0.5]
        np.testing.assert_allclose(back @ there, [0.3, 0.0, 0.5], atol=1e-12)
    assert omni([0.0, 120.0, 240.0], 0.1, 0.04).determines_twist
    four = general(
        [(0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.1, -0.1)],
        [135.0, 225.0, 315.0, 45.0],
        [90.0] * 4,
        0.04,
    )
    assert four.determines_twist
