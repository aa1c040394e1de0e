"""Limits and noise of sensors that logs show: what was put into made logs comes out again."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slipid.data.check.own_settings import own_settings
from slipid.data.log import Log
from slipid.model.geometry import differential, omni

RADIUS, HALF_TRACK = 0.1, 0.25
SHAPE = differential(HALF_TRACK, RADIUS, 20.0)
AMPS, VOLTS, GYRO, BIAS = 0.12, 0.3, 0.02, 0.05
DT = 0.02


def run(seed: int, speed: float = 0.8, yaw: float = 1.5, rising: float = 0.4) -> Log:
    """Rest, drive straight ahead, rest, turn on the spot, rest; speeds rise at 0.8 / 0.4 m/s^2."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 12.0, DT)

    def ramp(begin: float, end: float) -> np.ndarray:
        return np.interp(time, [begin, begin + rising, end, end + rising], [0.0, 1.0, 1.0, 0.0])

    ahead, turn = speed * ramp(2.0, 4.5), yaw * ramp(6.5, 9.0)
    rates = (ahead[:, None] + HALF_TRACK * turn[:, None] * np.array([-1.0, 1.0])) / RADIUS
    angle = np.cumsum(rates, axis=0) * DT
    shape = rates.shape
    return Log(
        name=f"{seed}.csv",
        path=Path(f"{seed}.csv"),
        sha256=str(seed),
        time=time,
        wheel_angle=np.round(angle * 8000 / (2 * np.pi)) * (2 * np.pi / 8000),
        current=0.2 * np.sign(rates) + AMPS * rng.standard_normal(shape),
        current_is_signed=True,
        voltage=rates + VOLTS * rng.standard_normal(shape) * (np.abs(rates) < 1e-9),
        gyro=turn + BIAS * rng.standard_normal() + GYRO * rng.standard_normal(len(time)),
        surface="floor",
        load="as_built",
    )


LOGS = [run(seed) for seed in range(12)]


def test_noise_and_limits_that_were_put_into_logs_are_recovered():
    found = own_settings(LOGS, SHAPE)
    assert found["sensors.ammeter_std_a"] == pytest.approx(AMPS, rel=0.2)
    assert found["sensors.voltmeter_std_v"] == pytest.approx(VOLTS, rel=0.2)
    assert found["sensors.gyro_std"] == pytest.approx(GYRO, rel=0.2)
    drawn = [np.random.default_rng(k) for k in range(12)]
    for rng in drawn:
        rng.standard_normal((len(LOGS[0].time), 2)), rng.standard_normal((len(LOGS[0].time), 2))
    bias = BIAS * np.array([rng.standard_normal() for rng in drawn])
    assert found["sensors.gyro_bias_std"] == pytest.approx(np.sqrt(np.mean(bias**2)), rel=0.2)
    assert found["limits.speed"] == pytest.approx(0.8, rel=0.02)
    assert found["limits.yaw_rate"] == pytest.approx(1.5, rel=0.1)
    assert found["limits.wheel_speed"] == pytest.approx(1.2 * 8.0, rel=0.02)
    assert found["limits.acceleration"] == pytest.approx(0.8 / 0.4, rel=0.2)
    assert found["limits.voltage"] == pytest.approx(1.2 * 8.0, rel=0.02)
    assert found["sensors.stale_s"] == 0.2


def test_the_supply_is_known_where_its_voltage_is_logged():
    battery = [replace(log, bus_voltage=np.full(log.samples, 24.0)) for log in LOGS]
    assert own_settings(battery, SHAPE)["limits.voltage"] == 24.0


def test_a_spike_of_one_row_is_no_limit():
    bad = LOGS[0].wheel_angle.copy()
    bad[300] += 5.0
    found = own_settings([replace(LOGS[0], wheel_angle=bad), *LOGS[1:]], SHAPE)
    assert found["limits.wheel_speed"] == pytest.approx(1.2 * 8.0, rel=0.02)
    assert found["limits.acceleration"] == pytest.approx(0.8 / 0.4, rel=0.2)


def test_a_log_that_was_cut_while_driving_shows_no_sudden_stop():
    cut = [
        replace(
            log,
            **{
                name: getattr(log, name)[150:200]
                for name in ("time", "wheel_angle", "current", "voltage", "gyro")
            },
        )
        for log in LOGS
    ]
    assert own_settings(cut, SHAPE).get("limits.acceleration", 0.0) < 0.3


def test_magnitudes_of_noise_around_0_show_all_of_it():
    unsigned = [replace(log, current=np.abs(log.current), current_is_signed=False) for log in LOGS]
    found = own_settings(unsigned, SHAPE)
    assert found["sensors.ammeter_std_a"] == pytest.approx(AMPS, rel=0.2)


def test_only_new_readings_of_a_slow_ammeter_count():
    slow = []
    for log in LOGS:
        fresh = np.zeros_like(log.current, bool)
        fresh[::10] = True
        held = np.repeat(log.current[::10], 10, axis=0)[: log.samples]
        slow.append(replace(log, current=held, current_fresh=fresh))
    assert own_settings(slow[:1], SHAPE).keys() == own_settings(LOGS[:1], SHAPE).keys()
    got = own_settings(slow, SHAPE)["sensors.ammeter_std_a"]
    assert got == pytest.approx(AMPS, rel=0.2)


def test_what_logs_do_not_show_is_left_out():
    plain = [replace(log, current=None, voltage=None, gyro=None) for log in LOGS]
    found = own_settings(plain, SHAPE)
    assert found.keys() == {
        "limits.speed",
        "limits.yaw_rate",
        "limits.acceleration",
        "limits.wheel_speed",
        "sensors.stale_s",
    }
    straight = own_settings([replace(run(0, yaw=0.0), gyro=None)], SHAPE)
    assert "limits.yaw_rate" not in straight
    # a run that never moves has one rest, which tells nothing about the spread of the bias
    assert "sensors.gyro_bias_std" not in own_settings([run(0, speed=0.0, yaw=0.0)], SHAPE)
    assert own_settings([], SHAPE) == {}


def test_the_body_turns_less_than_its_scrubbing_wheels_say():
    turned = [replace(log, gyro=0.5 * log.gyro) for log in LOGS]
    assert own_settings(turned, SHAPE)["limits.yaw_rate"] == pytest.approx(0.75, rel=0.2)
    # without a gyro the headings tell
    poses = []
    for log in LOGS:
        heading = 0.6 * RADIUS * (log.wheel_angle @ np.array([-0.5, 0.5])) / HALF_TRACK
        pose = np.stack([0 * heading, 0 * heading, heading], axis=1)
        fresh = np.arange(log.samples) % 5 == 0
        poses.append(replace(log, gyro=None, pose=pose, pose_fresh=fresh))
    assert own_settings(poses, SHAPE)["limits.yaw_rate"] == pytest.approx(0.9, rel=0.05)


def test_limits_of_two_robots_that_drove_alike_differ_by_their_wheels():
    three = omni([60.0, 180.0, 300.0], 0.2, 0.05)
    angle = np.concatenate([LOGS[0].wheel_angle, LOGS[0].wheel_angle[:, :1]], axis=1)
    other = own_settings([replace(LOGS[0], wheel_angle=angle, current=None, voltage=None)], three)
    assert other["limits.wheel_speed"] == pytest.approx(1.2 * 8.0, rel=0.02)
    assert other["limits.acceleration"] == pytest.approx(1.0, rel=0.2)
