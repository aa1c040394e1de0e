"""Signals against their definitions, and estimates against known truth."""

from __future__ import annotations

import numpy as np
import pytest

from slipid.data.signals.lag import camera_lag
from slipid.data.signals.wheel_order import best_wheel_order, describe
from slipid.data.signals.wheel_signals import (
    body_steps,
    bridge_stalls,
    first_moved,
    integral,
    integrated_steps,
    interpolate,
    quantum,
    wheel_speed,
)

AZIMUTH = np.radians([60.0, 180.0, 300.0])
RIM = np.stack([-np.sin(AZIMUTH), np.cos(AZIMUTH), np.full(3, 0.125)], axis=1)
RADIUS = 0.04
RIM_TO_TWIST = RADIUS * np.linalg.pinv(RIM)


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def uneven(rng, seconds=10.0, period=0.031):
    return np.cumsum(rng.normal(period, 0.002, int(seconds / period)).clip(0.02))


# interpolation and speed


def test_interpolation_is_numpys(rng):
    time, at = uneven(rng), np.linspace(-1.0, 12.0, 500)
    values = rng.normal(size=(len(time), 3))
    expected = np.stack([np.interp(at, time, column) for column in values.T], axis=1)
    np.testing.assert_allclose(interpolate(time, values, at), expected, atol=1e-12)
    np.testing.assert_allclose(interpolate(time, values[:, 0], at), expected[:, 0], atol=1e-12)


def test_wheel_speed_is_exact_for_constant_speeds(rng):
    time = uneven(rng) + 1e5
    angle = np.outer(time, [2.0, -3.0]) + 4e3
    np.testing.assert_allclose(wheel_speed(time, angle), [[2.0, -3.0]] * len(time), rtol=1e-6)


def test_wheel_speed_is_the_slope_of_a_fitted_line(rng):
    time = uneven(rng)
    angle = rng.normal(size=(len(time), 2)).cumsum(axis=0)
    speed = wheel_speed(time, angle, half_window=0.1)
    for i in (0, 1, 57, len(time) - 1):
        inside = np.abs(time - time[i]) <= 0.1
        expected = np.polyfit(time[inside] - time[i], angle[inside], 1)[0]
        np.testing.assert_allclose(speed[i], expected, rtol=1e-8)


def test_wheel_speed_of_three_rows_at_least():
    time = np.array([0.0, 1.0, 2.0, 3.0])
    speed = wheel_speed(time, np.array([[0.0], [1.0], [4.0], [9.0]]), half_window=0.01)
    np.testing.assert_allclose(speed[1:3, 0], [2.0, 4.0])
    assert np.isfinite(speed).all()


def test_wheel_speed_is_blind_to_counters_updated_at_their_own_pace():
    time = 0.031 * np.arange(300)
    updated = np.floor(time / 0.018) * 0.018  # 31 ms rows hold one or two updates of 18 ms each
    angle = 2.5 * updated[:, None]
    naive = np.diff(angle, axis=0) / 0.031
    assert naive.std() > 0.5
    assert wheel_speed(time, angle)[10:-10].std() < 0.12


# stalls


def stalled_run(rng, at=100, rows=7):
    time = 0.031 * np.arange(300)
    angle = np.outer(np.maximum(time - 0.12, 0.0), [2.5, -1.0, 0.0])
    frozen = angle.copy()
    frozen[at + 1 : at + 1 + rows] = frozen[at]
    return time, angle, frozen


def test_stalls_are_bridged(rng):
    time, angle, frozen = stalled_run(rng)
    bridged, stalled = bridge_stalls(time, frozen)
    np.testing.assert_allclose(bridged, angle, atol=1e-12)
    assert np.flatnonzero(stalled).tolist() == list(range(101, 108))


def test_wheels_that_stop_are_no_stall(rng):
    time = 0.031 * np.arange(300)
    driving = (time < 3.0) | (time > 4.0)
    angle = np.cumsum(0.08 * driving)[:, None] * [[1.0, -1.0]]
    bridged, stalled = bridge_stalls(time, angle)
    assert not stalled.any()
    assert bridged is angle
    still = np.zeros((300, 2))
    assert bridge_stalls(time, still)[0] is still


# where a run starts, steps of a converter


def test_first_moved():
    angle = np.array([[1.0, 0.0], [1.1, 0.0], [1.2, -0.3], [1.3, -0.6]])
    assert first_moved(angle, radius=0.04) == 2
    assert first_moved(angle, radius=0.04, distance=0.004) == 1
    assert first_moved(angle, radius=0.04, distance=1.0) is None


def test_quantum(rng):
    step = 1 / 39
    current = np.round(rng.normal(1.0, 0.3, 2000) / step) * step
    printed = np.array([float(f"{c:.6g}") for c in current])
    assert quantum(printed) == pytest.approx(step, rel=1e-5)
    # gaps between the levels seen do not hide the step between them
    assert quantum(np.repeat([0.0, 2.0, 5.0, 9.0], 10)) == pytest.approx(1.0)
    assert quantum(rng.normal(size=500)) is None
    assert quantum(np.ones(50)) is None


# lag of the camera


def made_drive(rng, lag):
    """Encoders of jittery age, a late camera that repeats frames, stops and turns in between."""
    time = np.cumsum(rng.normal(0.031, 0.001, 390))
    fine = np.arange(-1.0, 14.0, 0.001)
    legs = np.array([0.0, 0.4, 1.3, 2.2, 0.0, 0.9])  # direction of travel [rad]
    leg = np.clip((fine / 2.0).astype(int), 0, 5)
    speed = np.where((fine > 0.15) & (fine % 2.0 < 1.7) & (fine < 12.0), 0.1, 0.0)
    velocity = speed * np.stack([np.cos(legs[leg]), np.sin(legs[leg])])
    smooth = np.ones(150) / 150
    path = np.cumsum([np.convolve(v, smooth, "same") for v in velocity], axis=1).T * 0.001
    updated = (np.floor(time / 0.018) + 0.5) * 0.018
    wheels = interpolate(fine, path, updated) @ RIM[:, :2].T / RADIUS
    fresh = rng.uniform(size=len(time)) > 0.086
    fresh[0] = True
    frame = np.maximum.accumulate(np.where(fresh, np.arange(len(time)), 0))
    seen = interpolate(fine, path, time - lag) / 1.117
    heading = 0.3 + 0.02 * time
    cos, sin = np.cos(heading), np.sin(heading)
    dx, dy = np.diff(seen, axis=0, prepend=seen[:1]).T
    world = np.cumsum(np.stack([cos * dx - sin * dy, sin * dx + cos * dy], axis=1), axis=0)
    world += rng.normal(0.0, 3e-4, world.shape)
    return time, wheels, np.column_stack([world, heading])[frame], fresh


def test_the_lag_of_the_camera_is_found():
    errors, stds = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        truth = float(rng.uniform(-0.05, 0.15))
        lag = camera_lag(*made_drive(rng, truth), RIM_TO_TWIST)
        errors.append(lag.value - truth)
        stds.append(lag.std)
    errors, z = np.array(errors), np.array(errors) / np.array(stds)
    assert np.abs(errors.mean()) < 0.0005
    assert errors.std() < 0.0015
    assert 0.5 < z.std() < 1.5


def test_a_lag_that_cannot_be_seen_is_not_claimed():
    rng = np.random.default_rng(1)
    time = 0.031 * np.arange(400)
    wheels = np.outer(0.1 * time, RIM[:, 0] / RADIUS)  # already at speed when the log begins
    pose = np.column_stack([0.09 * time, 0.0 * time, 0.0 * time]) + rng.normal(0, 3e-4, (400, 3))
    lag = camera_lag(time, wheels, pose, np.ones(400, dtype=bool), RIM_TO_TWIST)
    assert lag.std == np.inf
    with pytest.raises(ValueError, match="nothing moves"):
        camera_lag(time, 0 * wheels, pose, np.ones(400, dtype=bool), RIM_TO_TWIST)
    with pytest.raises(ValueError, match="expected at least 10"):
        camera_lag(time, wheels, pose, np.arange(400) < 3, RIM_TO_TWIST)


# order of the wheels


def test_wheel_order_is_found(rng):
    reference = rng.normal(size=(200, 4)).cumsum(axis=0)
    order, signs = (2, 0, 3, 1), (1, -1, 1, -1)
    measured = np.empty_like(reference)
    for wheel, (position, sign) in enumerate(zip(order, signs, strict=True)):
        measured[:, position] = sign * reference[:, wheel]
    found = best_wheel_order(measured + 0.01 * rng.normal(size=(200, 4)), reference)
    assert (found.order, found.signs) == (order, signs)
    assert found.is_swapped
    assert found.misfit < 1e-3
    assert describe(found) == "3, -1, 4, -2"


def test_sound_wheels_pass_and_slip_is_no_swap(rng):
    reference = rng.normal(size=(200, 3))
    assert not best_wheel_order(0.6 * reference, reference).is_swapped
    assert not best_wheel_order(rng.normal(size=(200, 3)), reference).is_swapped
    assert not best_wheel_order(0 * reference, reference).is_swapped


# steps


def test_integrals_of_rates_are_those_of_scipy(rng):
    from scipy.integrate import cumulative_trapezoid

    time, rate = np.cumsum(rng.uniform(0.02, 0.04, 50)), rng.normal(size=(50, 3))
    whole = integral(time, rate)
    np.testing.assert_allclose(whole, cumulative_trapezoid(rate, time, axis=0, initial=0.0))
    steps = integrated_steps(time, rate, time[[0, 20, 49]])
    np.testing.assert_allclose(steps, np.diff(whole[[0, 20, 49]], axis=0), atol=1e-12)


def test_steps_of_a_body_that_drives_ahead_on_a_circle():
    """On a circle of radius 2 m every chord points along the mean heading of its ends."""
    heading = np.linspace(0.0, 4.0, 9)
    pose = np.stack([2.0 * np.sin(heading), -2.0 * np.cos(heading), heading], axis=1)
    chord = 2.0 * 2.0 * np.sin(0.25)
    np.testing.assert_allclose(body_steps(pose), np.tile([chord, 0.0, 0.5], (8, 1)), atol=1e-12)
