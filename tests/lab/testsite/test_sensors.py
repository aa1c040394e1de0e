"""Errors of the test site's sensors, and log files that read back as they were."""

from dataclasses import replace

import numpy as np
import pytest

from slipid.data.reading.presets import declared_layout, preset
from slipid.data.write import OPTIONAL, own_columns, own_csv, robotino2022_csv
from slipid.lab.testsite.driving import Trace, straight
from slipid.lab.testsite.omni_build import OmniBuild
from slipid.lab.testsite.simulate import log_of
from slipid.lab.testsite.site import Site, SiteSensors
from tests.helpers.made_logs import LAYOUT
from tests.helpers.one_log import read_log

EXACT = SiteSensors(
    current_noise_a=0.0,
    voltage_noise_v=0.0,
    gyro_noise=0.0,
    gyro_bias=0.0,
    camera_noise_m=0.0,
    camera_noise_rad=0.0,
    dropout=0.0,
    outlier=0.0,
)
EVERYTHING = replace(EXACT, duty=True, bus_voltage=True, gyro=True)


@pytest.fixture(scope="module")
def trace():
    """Ten seconds at a constant twist, with currents of both signs."""
    t = np.arange(0.0, 10.0, 0.001)
    speed = np.broadcast_to([3.0, -1.0, -2.0], (len(t), 3))
    return Trace(
        time=t,
        pose=np.stack([0.1 * t - 0.5, 0.05 * t, 0.2 * t], axis=1),
        yaw_rate=np.full(len(t), 0.2),
        wheel_angle=speed * t[:, None],
        wheel_speed=speed.copy(),
        wheel_command=speed.copy(),
        current=np.broadcast_to([0.9, -0.3, -0.6], (len(t), 3)).copy(),
        voltage=np.broadcast_to([7.0, -2.0, -5.0], (len(t), 3)).copy(),
        bus=np.full(len(t), 23.5),
        sinkage=np.zeros((len(t), 3)),
        twist_command=np.broadcast_to([0.1, 0.05, 0.2], (len(t), 3)).copy(),
    )


def seen(trace, sensors, seed=0):
    site = Site(OmniBuild(marker_yaw_deg=float(np.degrees(-0.02))), sensors=sensors)
    run = straight("soft", "as_built", 0.0, 0.1, 1.0)
    return log_of(trace, site, run, "as_built/soft/run000", seed)


def test_every_channel_is_the_truth_to_its_quantum(trace):
    log = seen(trace, EVERYTHING)
    tick = 2 * np.pi / 32000
    at = np.searchsorted(trace.time, log.time + 1e-9) - 1
    for logged, true, quantum in (
        (log.wheel_angle, trace.wheel_angle[at], tick),
        (log.current, np.abs(trace.current[at]), 1 / 39),
        (log.voltage, trace.voltage[at], 0.1),
        (log.bus_voltage, trace.bus[at], 0.1),
        (log.duty, (trace.voltage / trace.bus[:, None])[at], 0.001),
        (log.gyro, trace.yaw_rate[at], 1e-9),
    ):
        assert np.abs(logged - true).max() <= 1.001 * quantum
    np.testing.assert_allclose(np.diff(log.time).mean(), 0.031, rtol=0.02)
    assert np.ptp(np.diff(log.time)) > 0.003
    reported = log.wheel_speed[10]
    np.testing.assert_allclose(reported, 1.013 * trace.wheel_speed[0], atol=0.5 * 2.83 / 16 + 1e-9)
    signed = seen(trace, replace(EXACT, current_is_signed=True))
    assert (signed.current[:, 1] < 0).all()
    assert signed.voltage is not None
    assert signed.gyro is None


def test_the_camera_lags_shrinks_and_repeats_frames(trace):
    log = seen(trace, EXACT)
    late = log.time > 0.5
    # the x coordinate says when a frame was taken
    taken = (1.117 * log.pose[late, 0] + 0.5) / 0.1
    age = log.time[late] - taken
    assert age.mean() == pytest.approx(0.056, abs=0.003)
    assert age.min() > 0.056 - 0.5 / 29 - 1e-6
    assert age.max() < 0.056 + 0.5 / 29 + 1e-6
    turned = log.pose[late, 2] - 0.2 * taken
    np.testing.assert_allclose(turned, -0.02, atol=1e-6)
    again = ~log.pose_fresh
    assert 0.02 < again.mean() < 0.2  # rows come more often than frames now and then
    np.testing.assert_array_equal(log.pose[1:][again[1:]], log.pose[:-1][again[1:]])


def test_lost_and_wrong_frames_have_the_configured_frequency(trace):
    few = seen(trace, EXACT).pose_fresh.sum()
    lost = seen(trace, replace(EXACT, dropout=0.3)).pose_fresh.sum()
    assert lost == pytest.approx(0.7 * few, rel=0.2)
    wrong = seen(trace, replace(EXACT, outlier=0.2, outlier_m=0.5))
    off = np.abs(1.117 * wrong.pose[:, 1] - (0.05 * wrong.time)) > 0.05
    assert off.mean() == pytest.approx(0.2, abs=0.1)


def test_noise_has_the_configured_size(trace):
    log = seen(trace, replace(EXACT, current_noise_a=0.05, current_step_a=1e-6))
    assert np.std(log.current[:, 0]) == pytest.approx(0.05, rel=0.2)
    log = seen(trace, replace(EXACT, camera_noise_m=0.002, camera_scale=1.0))
    along = log.pose[log.pose_fresh, 1] - np.interp(
        log.time[log.pose_fresh], trace.time, trace.pose[:, 1]
    )
    assert np.std(along) == pytest.approx(0.002, rel=0.25)


@pytest.mark.parametrize("change", [{"row_s": 0.0}, {"dropout": 1.0}, {"lag_s": 0.001}])
def test_sensors_that_cannot_be_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        SiteSensors(**change)


# files


@pytest.mark.parametrize("sensors", [EVERYTHING, EXACT, replace(EXACT, voltage=False)])
def test_own_columns_come_back(trace, sensors, tmp_path):
    log = seen(trace, sensors)
    path = tmp_path / "as_built" / "soft" / "run000.csv"
    path.parent.mkdir(parents=True)
    path.write_text(own_csv(log, 16.0, 2000))
    more = [channel for channel in OPTIONAL if getattr(log, channel) is not None]
    layout = declared_layout(LAYOUT | {"columns": own_columns(3, more)}, "made")
    again = read_log(path, layout, root=tmp_path, surface="soft")
    np.testing.assert_allclose(again.time - again.time[0], log.time - log.time[0], atol=1e-4)
    np.testing.assert_allclose(again.wheel_angle, log.wheel_angle, atol=1e-9)
    np.testing.assert_allclose(again.current, log.current, atol=1e-4)
    np.testing.assert_allclose(again.pose, log.pose, atol=2e-6)
    moving = log.time > 0.2  # before that a repeated frame cannot be told from a new one
    np.testing.assert_array_equal(again.pose_fresh[moving], log.pose_fresh[moving])
    np.testing.assert_allclose(again.twist_command, log.twist_command, atol=1e-4)
    for channel in OPTIONAL:
        assert (getattr(again, channel) is None) == (getattr(log, channel) is None)
        if getattr(log, channel) is not None:
            np.testing.assert_allclose(getattr(again, channel), getattr(log, channel), atol=1e-3)


def test_the_published_layout_comes_back(trace, tmp_path):
    log = seen(trace, EXACT)
    path = tmp_path / "exp000.csv"
    path.write_text(robotino2022_csv(log, 16.0, 2000))
    again = read_log(path, preset("robotino2022"), root=tmp_path, surface="soft")
    np.testing.assert_allclose(again.wheel_angle, log.wheel_angle, atol=1e-9)
    np.testing.assert_allclose(again.wheel_speed, log.wheel_speed, rtol=1e-5)
    np.testing.assert_allclose(again.current, log.current, atol=1e-4)
    # the origin is the middle of the image there
    middle = again.pose[:, :2] - log.pose[:, :2]
    np.testing.assert_allclose(
        middle, np.broadcast_to([-1.7668435, 0.9920685], middle.shape), atol=2e-6
    )
    np.testing.assert_allclose(again.pose[:, 2], log.pose[:, 2], atol=1e-5)
    four = np.zeros((log.samples, 4))
    each = ("wheel_angle", "wheel_speed", "wheel_speed_command", "current", "voltage")
    other = replace(log, **dict.fromkeys(each, four))
    with pytest.raises(ValueError, match="expected three for the 2022 layout"):
        robotino2022_csv(other, 16.0, 2000)
