"""The filter is checked against textbook formulas and by differences."""

from dataclasses import replace

import numpy as np
import pytest

from slipid.lab.systems.motion.ward_iagnemma_dynamics import (
    Dynamics,
    ForceLaw,
    PaddedRuns,
    motor_forces,
)
from slipid.lab.systems.motion.ward_iagnemma_filter import FilterNoise, FilterState, SlipFilter
from slipid.model.robot import GRAVITY
from slipid.predict.slip_model import path_of
from tests.helpers.driven_runs import FLOOR
from tests.helpers.made_runs import ROBOTINO, made_run, straight


def test_linear_traction_makes_it_the_linear_kalman_filter():
    """Turning on the spot without resistance, by the textbook: yaw rate, bias, and yaw."""
    rng = np.random.default_rng(2)
    law = ForceLaw(grip=0.0, viscous=0.2, rolling=0.0, turning=0.0)
    noise = FilterNoise(rolling=0.0, drift=(0.0, 0.0, 0.004), gyro=0.03, bias=0.05)
    wheels, gyro, dt, radius = rng.normal(size=40), rng.normal(size=40), 0.1, 0.125
    rolling = np.outer(wheels, [0.0, 0.0, 1.0])
    measured = made_run(rolling, gyro=gyro, dt=dt).signals
    own = SlipFilter(Dynamics.of(ROBOTINO, law), noise, 10.0, uses_current=False, wander=0.0)
    speeds, covariance = own.track(PaddedRuns.of([measured], ROBOTINO))

    # 2 (N / m) C2 u of three wheels, the 2 by the inertia m L^2 / 2
    slope = 2 * GRAVITY * 0.2
    x, spread = np.array([wheels[0], 0.0, 0.0]), np.diag([0.0, 0.05**2, 0.0])
    kept = 1 / (1 + dt * slope)
    move = np.diag([kept, 1.0, 1.0])
    process = np.diag([(0.004 / radius) ** 2 / dt, 0.0, 0.0])
    measure = np.array([[1.0, 1.0, 0.0]])
    for wheel, rate, filtered in zip(wheels, gyro, speeds[0, :, 2] / radius, strict=True):
        x = move @ x + np.array([(1 - kept) * wheel, 0.0, 0.0])
        spread = move @ spread @ move.T + process
        size = measure @ spread @ measure.T + 0.03**2 * 0.5 / dt
        gain = spread @ measure.T / size * [[1.0], [1.0], [0.0]]
        x = x + (gain * (rate - measure @ x)).ravel()
        left = np.eye(3) - gain @ measure
        spread = left @ spread @ left.T + gain @ gain.T * 0.03**2 * 0.5 / dt
        assert filtered == pytest.approx(x[0], abs=1e-5)
        turn = np.array([[1.0, 0, 0], [0, 1, 0], [dt, 0, 1]])
        spread = turn @ spread @ turn.T
    assert covariance[0, 2, 2] == pytest.approx(spread[2, 2], rel=1e-4)


def test_a_measurement_is_that_of_the_textbook_but_for_the_pose():
    rng = np.random.default_rng(3)
    root, row = rng.normal(size=(8, 8)), rng.normal(size=8)
    row[5:] = 0.0
    spread, mean = root @ root.T, rng.normal(size=5)
    state = FilterState(mean[None], spread[None])
    after = state.corrected(row[None], np.array([0.7]), np.array([0.3]))
    gain = spread @ row / (row @ spread @ row + 0.3)
    assert after.mean[0] == pytest.approx(mean + 0.7 * gain[:5])
    assert after.covariance[0, :5, :5] == pytest.approx(
        (spread - np.outer(gain, row @ spread))[:5, :5]
    )
    assert after.covariance[0, 5:, 5:] == pytest.approx(spread[5:, 5:])
    own = np.append(gain[:5], np.zeros(3))
    left = np.eye(8) - np.outer(own, row)
    joseph = left @ spread @ left.T + 0.3 * np.outer(own, own)
    assert after.covariance[0] == pytest.approx(joseph)
    one = state.corrected(row[None], np.array([0.7]), np.array([0.3]), slice(3, 4))
    assert one.mean[0] == pytest.approx(mean + 0.7 * gain[:5] * [0, 0, 0, 1, 0])
    two = FilterState(np.tile(mean, (2, 1)), np.tile(spread, (2, 1, 1)))
    for news, variance in ((np.nan, 0.3), (0.7, np.nan)):
        measured = two.corrected(
            np.tile(row, (2, 1)), np.array([0.7, news]), np.array([0.3, variance])
        )
        assert measured.mean == pytest.approx(np.stack([after.mean[0], mean]))
        assert measured.covariance == pytest.approx(np.stack([after.covariance[0], spread]))


def test_resistance_that_pushes_or_exceeds_traction_is_pulled_back():
    law, noise = ForceLaw(drag=2.0), FilterNoise(rolling=0.1)
    own = SlipFilter(Dynamics.of(ROBOTINO, law), noise, 10.0, uses_current=False, wander=0.0)
    mean = np.array([[0.3, 0.4, 9.0, rho, 0.0] for rho in (-0.2, 0.1, 0.8)])
    spread = np.tile(np.diag([0.0, 0, 0, 0.01, 0, 0, 0, 0]), (3, 1, 1))
    after = own._bounded(FilterState(mean, spread)).mean[:, 3]
    # a hundredth of the prior's variance: a hundred parts of the bound in a hundred and one
    assert after == pytest.approx([-0.2 / 101, 0.1, 0.3 + (0.8 - 0.3) / 101])


def test_the_force_of_a_current_is_that_of_gear_motor_and_wheel():
    measured = made_run(straight(0.0), current=np.tile([0.5, 0.2, 0.7], (40, 1))).signals
    force = motor_forces(measured, ROBOTINO)[0]
    assert force[[0, 2]] == pytest.approx(np.array([0.5, 0.7]) * 16 * 0.05 / 0.04)
    assert np.isnan(force[1])
    assert np.isnan(motor_forces(replace(measured, current=None), ROBOTINO)).all()


def test_the_spread_of_the_end_is_that_of_paths_with_other_twists():
    """The end covariance of a fast turn is that by differences in the twists of two steps."""
    noise = FilterNoise(rolling=0.0, drift=(0.01, 0.02, 0.03))
    measured = made_run(np.tile([0.3, -0.2, 2.0], (2, 1)), dt=0.2).signals
    dynamics = Dynamics.of(ROBOTINO, FLOOR)
    own = SlipFilter(dynamics, noise, 10.0, uses_current=False, wander=0.0)
    runs = PaddedRuns.of([measured], ROBOTINO)

    def end(shaken):
        q, twist = runs.rolling[:, 0], np.zeros((2, 3))
        for k in range(2):
            rho = np.array([FLOOR.rolling])
            q = dynamics.step(q, rho, runs.rim[:, k], measured.dt[:1]).speeds + shaken[k]
            twist[k] = q[0] / ROBOTINO.size
        return path_of(twist, measured.dt)[-1]

    spread = np.zeros((3, 3))
    for k in range(2):
        for axis in range(3):
            shaken = np.zeros((2, 3))
            shaken[k, axis] = 1e-4
            by = (end(shaken) - end(-shaken)) / 2e-4
            spread += np.outer(by, by) * noise.drift[axis] ** 2 / 0.2
    tracked = own.track(runs)[1][0]
    scale = np.sqrt(np.outer(spread.diagonal(), spread.diagonal()))
    assert tracked / scale == pytest.approx(spread / scale, abs=0.002)
