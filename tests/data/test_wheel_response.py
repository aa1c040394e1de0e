"""Delay and lag of the wheels are found from commands and encoders, or refused."""

from pathlib import Path

import numpy as np
import pytest

from slipid.data.log import Log
from slipid.data.wheel_response import _pair, wheel_response
from slipid.model.geometry import omni

SHAPE = omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0)
FINE_S = 1e-3


def run(seed, delay=0.12, lag=0.08, rim=50.0, noise=0.0, slow=1.0, smooth=0.0, by_twist=True):
    """Return a run whose wheels follow commands as the equations say, integrated in fine steps.

    Args:
        seed: seed of the commands.
        delay, lag: response of the wheels [s].
        rim: largest acceleration of a wheel's rim [m/s^2].
        noise: std of the wheel angles [rad].
        slow: actual over commanded speed.
        smooth: time constant of a filter of the commands before they are sent [s].
        by_twist: True to log the commanded twist instead of the commanded wheel speeds.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 4.0, 0.03)
    twists = rng.uniform(-0.3, 0.3, (5, 3)) * [1.0, 1.0, 2.0]
    twist = twists[np.minimum((time / 1.0).astype(int), 4)]
    if smooth:
        for k in range(1, len(twist)):
            twist[k] = twist[k - 1] + 0.03 / smooth * (twist[k] - twist[k - 1])
    command = twist @ np.asarray(SHAPE.forward()).T / 0.04
    fine = FINE_S * np.arange(4000)
    row = np.floor((fine - delay + 1e-9) / 0.03).astype(int)
    sent = np.where(row[:, None] < 0, 0.0, command[np.clip(row, 0, len(time) - 1)])
    aim, speed, angle = np.zeros(3), np.zeros(3), np.zeros((4001, 3))
    for k, wanted in enumerate(slow * sent):
        most = rim / 0.04 * FINE_S
        aim = aim + np.clip(wanted - aim, -most, most)
        speed = speed + (1 - np.exp(-FINE_S / lag)) * (aim - speed) if lag else aim
        angle[k + 1] = angle[k] + FINE_S * speed
    shown = angle[np.round(time / FINE_S).astype(int)] + rng.normal(0.0, noise, (len(time), 3))
    return Log(
        name=f"run{seed}.csv",
        path=Path(f"run{seed}.csv"),
        sha256="0" * 64,
        time=time,
        wheel_angle=shown - shown[0],
        twist_command=twist if by_twist else None,
        wheel_speed_command=None if by_twist else command,
        current_is_signed=True,
        pose=np.zeros((len(time), 3)),
        pose_fresh=np.ones(len(time), bool),
        surface="floor",
        load="as_built",
    )


def found(count=6, **how):
    return wheel_response([run(seed, **how) for seed in range(count)], SHAPE)


@pytest.mark.parametrize(
    ("delay", "lag", "rim"),
    [(0.12, 0.08, 50.0), (0.05, 0.3, 50.0), (0.2, 0.0, 50.0), (0.0, 0.1, 50.0), (0.12, 0.05, 1.0)],
)
def test_delay_and_lag_are_found(delay, lag, rim):
    response = found(delay=delay, lag=lag, rim=rim)
    assert response is not None
    assert response.delay_s == pytest.approx(delay, abs=0.006)
    assert response.lag_s == pytest.approx(lag, abs=0.01)
    if rim == 1.0:
        assert response.acceleration == pytest.approx(1.0, rel=0.05)


def test_noise_and_slow_wheels_widen_the_interval_around_the_truth():
    clean, noisy = found(12), found(12, noise=0.01, slow=0.9)
    assert clean is not None
    assert noisy is not None
    for response in (clean, noisy):
        low, high = response.delay_interval90
        assert low - 0.006 < 0.12 < high + 0.006
    assert np.ptp(noisy.delay_interval90) > 2 * np.ptp(clean.delay_interval90)
    assert noisy.delay_s == pytest.approx(0.12, abs=0.015)


def test_commanded_wheel_speeds_say_the_same_as_commanded_twists():
    """The compared speeds are the same; where the search ends depends on their last bits."""
    matrix = np.asarray(SHAPE.forward()) / 0.04
    for seed in range(6):
        one, other = (_pair(run(seed, by_twist=by_twist), matrix) for by_twist in (False, True))
        assert one is not None
        assert other is not None
        np.testing.assert_allclose(one.command, other.command, rtol=1e-12, atol=1e-12)
    response = found(by_twist=False)
    assert response is not None
    assert response.delay_s == pytest.approx(0.12, abs=0.006)
    assert response.lag_s == pytest.approx(0.08, abs=0.01)


def test_logs_without_commands_or_with_unlike_commands_are_refused():
    logs = [run(seed) for seed in range(6)]
    silent = [run(seed, by_twist=False) for seed in range(2)]
    assert wheel_response(silent, SHAPE) is None
    shuffled = [
        Log(**{**vars(log), "twist_command": other.twist_command})
        for log, other in zip(logs, [*logs[1:], logs[0]], strict=True)
    ]
    assert wheel_response(shuffled, SHAPE) is None


def test_commands_that_change_slowly_and_noisy_wheels_are_refused():
    assert found(smooth=3.0, noise=0.1) is None
