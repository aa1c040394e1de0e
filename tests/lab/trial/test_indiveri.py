"""Indiveri's kinematics of any wheels, and limits that keep the direction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slipid.lab.trial.published_laws import Indiveri, inverse_kinematics, pose_loop, within_limit
from slipid.model.geometry import Geometry, general, mecanum, omni

SHAPES = {
    "omni3": omni([60.0, 180.0, 300.0], 0.125, 0.04),
    "omni4": omni([45.0, 135.0, 225.0, 315.0], 0.2, 0.05),
    "mecanum": mecanum(0.2, 0.15, 0.05),
    "odd": general(
        [(0.1, 0.2), (-0.2, 0.1), (0.05, -0.25)], [10.0, 100.0, 250.0], [90.0, 60.0, 130.0], 0.03
    ),
}


def matrix_of(shape: Geometry) -> np.ndarray:
    return inverse_kinematics(
        np.asarray(shape.place) * float(shape.base_radius),
        np.asarray(shape.drive_angle),
        np.asarray(shape.roller_angle),
        np.full(shape.wheels, float(shape.wheel_radius)),
    )


@pytest.mark.parametrize("name", SHAPES)
def test_wheel_speeds_are_those_of_the_model_of_wheels(name):
    shape = SHAPES[name]
    known = np.asarray(shape.forward()) / float(shape.wheel_radius)
    np.testing.assert_allclose(matrix_of(shape), known, atol=1e-12)


def test_wheels_of_their_own_radius_turn_by_their_own():
    shape = SHAPES["mecanum"]
    place = np.asarray(shape.place) * float(shape.base_radius)
    angles = np.asarray(shape.drive_angle), np.asarray(shape.roller_angle)
    larger = inverse_kinematics(place, *angles, 0.05 * np.array([1.0, 1.1, 1.0, 1.0]))
    expected = matrix_of(shape) / np.array([1.0, 1.1, 1.0, 1.0])[:, None]
    np.testing.assert_allclose(larger, expected, rtol=1e-12)


def test_the_mecanum_matrix_is_that_of_the_textbook():
    """w = (vx -+ vy -+ (a + b) W) / r, front left, front right, rear left, rear right."""
    expected = np.array([[1, -1, -0.35], [1, 1, 0.35], [1, 1, -0.35], [1, -1, 0.35]]) / 0.05
    np.testing.assert_allclose(matrix_of(SHAPES["mecanum"]), expected, atol=1e-9)


def test_wheels_that_cannot_drive_and_robots_that_cannot_be_steered_are_refused():
    place = np.array([[0.1, 0.0], [-0.1, 0.1], [-0.1, -0.1]])
    ways, radius = np.radians([90.0, 210.0, 330.0]), np.full(3, 0.04)
    with pytest.raises(ValueError, match="wheel 2: rollers at 181 deg"):
        inverse_kinematics(place, ways, np.radians([90.0, 181.0, 90.0]), radius)
    with pytest.raises(ValueError, match="do not determine the motion of the body"):
        inverse_kinematics(place, np.zeros(3), np.full(3, 0.5 * np.pi), radius)


twists = st.tuples(*[st.floats(-3.0, 3.0, allow_subnormal=False)] * 3)


@settings(deadline=None, max_examples=50)
@given(st.sampled_from(list(SHAPES)), twists, st.floats(0.1, 200.0))
def test_a_limit_keeps_the_direction_of_the_twist_and_changes_none_below_it(name, twist, limit):
    matrix, asked = matrix_of(SHAPES[name]), np.array(twist)
    out = np.asarray(within_limit(jnp.asarray(asked), jnp.asarray(matrix), jnp.asarray(limit)))
    before, after = np.abs(matrix @ asked).max(), np.abs(matrix @ out).max()
    if before <= limit:
        np.testing.assert_array_equal(out, asked)
    else:
        assert after == pytest.approx(limit, rel=1e-12)
        np.testing.assert_allclose(out, asked * limit / before, rtol=1e-12, atol=1e-300)


def test_the_loop_asks_for_rates_and_errors_as_the_body_sees_them():
    pose = jnp.array([1.0, -2.0, 0.5 * np.pi])
    reference = jnp.array([1.3, -1.8, 0.5 * np.pi + 0.1, 0.2, 0.1, 0.3])
    found = pose_loop(jnp.array([2.0, 3.0]), reference, pose)
    # along x of the world, which is on its right: 0.2 + 2 * 0.3
    np.testing.assert_allclose(found, [0.1 + 2 * 0.2, -0.8, 0.3 + 3 * 0.1], atol=1e-12)


def test_it_turns_the_shorter_direction_with_undiminished_rate():
    still = jnp.zeros(6)
    for heading, turn in ((6.0, 2 * np.pi - 6.0), (2.0, -2.0), (-2.0, 2.0)):
        found = pose_loop(jnp.array([1.0, 1.0]), still, jnp.array([0.0, 0.0, heading]))
        assert float(found[2]) == pytest.approx(turn)


def straightness(wheels_of):
    """Distance from the line to its goal of a turning robot that drives exactly [m]."""
    matrix = jnp.asarray(matrix_of(SHAPES["omni3"]))
    law = Indiveri(matrix, jnp.array([2.0, 2.0]), jnp.asarray(1e9))
    back, h = jnp.linalg.inv(matrix), 0.01

    def step(pose, _):
        x, y, w = back @ wheels_of(matrix, law(jnp.zeros(6), pose))
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        pose = pose + h * jnp.stack([c * x - s * y, s * x + c * y, w])
        return pose, pose

    poses = np.asarray(jax.lax.scan(step, jnp.array([0.8, 0.5, 1.5]), length=800)[1])
    assert np.hypot(*poses[-1, :2]) < 0.02
    return float(np.abs(poses[:, :2] @ [-0.5, 0.8]).max() / np.hypot(0.8, 0.5))


def test_a_robot_with_slow_wheels_goes_straight_unless_each_is_clipped_alone():
    limit = 4.0

    def together(matrix, asked):
        return matrix @ within_limit(asked, matrix, jnp.asarray(limit))

    def alone(matrix, asked):
        return jnp.clip(matrix @ asked, -limit, limit)

    assert straightness(together) < 1e-12
    assert straightness(alone) > 0.05
