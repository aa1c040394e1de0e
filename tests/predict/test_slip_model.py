"""Inputs of slip models: steps, windows, paths, and known or unknown floors."""

import numpy as np
import pytest

from slipid.predict.slip_model import body_increments, groups, path_of
from tests.helpers.made_runs import ROBOTINO, made_run, straight


def test_a_path_is_that_of_its_twists():
    rng = np.random.default_rng(0)
    twist, dt = rng.normal(size=(30, 3)), rng.uniform(0.05, 0.2, 30)
    path = path_of(twist, dt)
    assert np.allclose(body_increments(path) / dt[:, None], twist)
    circle = path_of(np.tile([0.3, 0.0, 0.5], (100, 1)), np.full(100, 2 * np.pi / 50))
    assert np.allclose(circle[-1], [0, 0, 2 * np.pi], atol=1e-12)
    assert np.ptp(circle[:, 1]) == pytest.approx(1.2, rel=1e-3)


def test_windows_keep_the_way_and_the_means():
    run = made_run(straight(0.7), current=np.arange(120.0).reshape(40, 3))
    joined = run.windowed()
    assert len(joined.signals) == 8
    assert np.allclose(joined.signals.dt, 0.5)
    assert np.allclose(joined.signals.turn.sum(axis=0), run.signals.turn.sum(axis=0))
    assert joined.signals.current is not None
    assert joined.signals.current[0, 0] == pytest.approx(6.0)
    assert np.allclose(joined.pose[[0, -1]], run.pose[[0, -1]])
    assert np.allclose(joined.twist, run.twist[:8])


def test_groups_of_a_run_shorter_than_a_window():
    assert groups(np.full(3, 0.1), 0.5).tolist() == [0]
    assert groups(np.full(10, 0.1), 0.5).tolist() == [0, 5]


def test_encoders_without_slip_say_the_twist():
    run = made_run(straight(0.3) + np.array([0.0, 0.0, 0.2]))
    assert np.allclose(run.signals.rolling(ROBOTINO), run.twist)


def test_a_floor_is_told_only_if_asked():
    run = made_run(straight(0.0), floor="green")
    assert run.with_floor(False).signals.floor is None
    assert run.with_floor(True).signals.floor == "green"


def test_the_power_is_that_of_the_torque():
    amps = np.full((40, 3), 0.8)
    signals = made_run(straight(0.5), current=amps).signals
    shaft = np.abs(16 * signals.speed)
    mechanical = (signals.torque(ROBOTINO) * shaft).sum(axis=1)
    assert signals.power(ROBOTINO) == pytest.approx(mechanical, rel=0.05)
