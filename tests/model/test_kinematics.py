"""Kinematics of a robot that steers, against the geometry of rolling wheels."""

import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model.geometry import steered
from slipid.model.kinematics import Steering, nominal_base, rolled

RADIUS, WHEELBASE, SECONDS = 0.1, 0.5, 0.02


def moved(driven: str, angle: float, turn: list[float], **more: float) -> np.ndarray:
    """Body increment for wheel turns in one short step at a steering angle."""
    shape = steered(WHEELBASE, RADIUS, 1.0, driven, encoders=len(turn))
    matrix = RADIUS * np.asarray(shape.pseudo_inverse())
    front = float(driven == "front")
    numbers = {"zero": 0.0, "gain": 1.0, "understeer": 0.0, "front": front} | more
    columns = np.array([*turn, angle * np.mean(turn), SECONDS])
    return rolled(matrix, columns, Steering(nominal_base(shape), **numbers))


@pytest.mark.parametrize("angle", [0.0, 0.4, -0.6])
def test_a_driven_front_wheel_rolls_in_its_own_direction(angle):
    ahead, left, yaw = moved("front", angle, [0.3])
    wheel = np.array([ahead, left + WHEELBASE * yaw])  # motion of the middle of the front axle
    expected = 0.3 * RADIUS * np.array([np.cos(angle), np.sin(angle)])
    np.testing.assert_allclose(wheel, expected, atol=1e-12)


def test_rear_wheels_move_by_their_mean_on_a_circle():
    ahead, left, yaw = moved("rear", 0.3, [0.25, 0.35])
    assert (ahead, left) == (pytest.approx(0.3 * RADIUS), 0.0)
    assert ahead / yaw == pytest.approx(WHEELBASE / np.tan(0.3))


def test_zero_gain_and_understeer():
    speed = 0.3 * RADIUS / SECONDS
    ahead, _, yaw = moved("rear", 0.3, [0.3], zero=0.1, gain=0.9, understeer=0.04)
    assert yaw / ahead == pytest.approx(np.tan(0.18) / (WHEELBASE + 0.04 * speed**2))


def test_steps_without_duration_do_not_move():
    nothing = Steering(WHEELBASE, 0.1, 1.0, 0.02, 0.0)
    matrix = np.array([[RADIUS], [0.0], [0.0]])
    np.testing.assert_array_equal(rolled(matrix, np.zeros((2, 3)), nothing), np.zeros((2, 3)))


def test_wheels_that_turn_to_and_fro_in_a_step_do_not_steer_at_any_angle():
    numbers = Steering(WHEELBASE, 0.0, 1.0, 0.0, 0.0)
    matrix = np.array([[RADIUS], [0.0], [0.0]])
    _, _, yaw = rolled(matrix, np.array([1e-3, 0.5 * np.pi * 1e-3, SECONDS]), numbers)
    assert abs(yaw) < 1e-3


def test_numpy_and_jax_agree():
    rng = np.random.default_rng(0)
    matrix, turn = rng.normal(size=(3, 2)), rng.uniform(0.1, 0.4, size=(5, 4))
    numbers = Steering(0.4, 0.02, 1.1, 0.03, 1.0)
    for steering in (None, numbers):
        columns = turn if steering is not None else turn[:, :2]
        found = rolled(jnp.asarray(matrix), jnp.asarray(columns), steering)
        np.testing.assert_allclose(found, rolled(matrix, columns, steering), rtol=1e-12)
