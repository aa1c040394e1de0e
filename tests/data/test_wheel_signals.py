"""Signals against their definitions, and estimates against known truth."""

from __future__ import annotations

import numpy as np
import pytest

from slipid.data.wheel_signals import (
    STALL_STEPS,
    body_steps,
    bridge_stalls,
    first_moved,
    integral,
    swapped_order,
)

AZIMUTH = np.radians([60.0, 180.0, 300.0])
RIM = np.stack([-np.sin(AZIMUTH), np.cos(AZIMUTH), np.full(3, 0.125)], axis=1)
RADIUS = 0.04


@pytest.fixture
def rng():
    return np.random.default_rng(7)


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


@pytest.mark.parametrize(("rows", "stalls"), [(STALL_STEPS - 1, False), (STALL_STEPS, True)])
def test_so_many_steps_without_change_are_a_stall_and_fewer_are_none(rng, rows, stalls):
    time, angle, frozen = stalled_run(rng, rows=rows)
    bridged, stalled = bridge_stalls(time, frozen)
    assert np.flatnonzero(stalled).tolist() == (list(range(101, 101 + rows)) if stalls else [])
    np.testing.assert_allclose(bridged, angle if stalls else frozen, atol=1e-12)


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
    assert first_moved(angle, radius=0.11) == 1
    assert first_moved(angle, radius=0.001) is None


def test_wheel_order_is_found(rng):
    reference = rng.normal(size=(200, 4)).cumsum(axis=0)
    order, signs = (2, 0, 3, 1), (1, -1, 1, -1)
    measured = np.empty_like(reference)
    for wheel, (position, sign) in enumerate(zip(order, signs, strict=True)):
        measured[:, position] = sign * reference[:, wheel]
    found = swapped_order(measured + 0.01 * rng.normal(size=(200, 4)), reference)
    assert found == (3, -1, 4, -2)


def test_sound_wheels_pass_and_slip_is_no_swap(rng):
    reference = rng.normal(size=(200, 3))
    assert swapped_order(0.6 * reference, reference) is None
    assert swapped_order(rng.normal(size=(200, 3)), reference) is None
    assert swapped_order(0 * reference, reference) is None


# steps


def test_integrals_of_rates_are_those_of_scipy(rng):
    from scipy.integrate import cumulative_trapezoid

    time, rate = np.cumsum(rng.uniform(0.02, 0.04, 50)), rng.normal(size=(50, 3))
    whole = integral(time, rate)
    np.testing.assert_allclose(whole, cumulative_trapezoid(rate, time, axis=0, initial=0.0))


def test_steps_of_a_body_that_drives_ahead_on_a_circle():
    """On a circle of radius 2 m every chord points along the mean heading of its ends."""
    heading = np.linspace(0.0, 4.0, 9)
    pose = np.stack([2.0 * np.sin(heading), -2.0 * np.cos(heading), heading], axis=1)
    chord = 2.0 * 2.0 * np.sin(0.25)
    np.testing.assert_allclose(body_steps(pose), np.tile([chord, 0.0, 0.5], (8, 1)), atol=1e-12)
