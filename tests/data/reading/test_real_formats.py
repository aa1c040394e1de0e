"""Published logs: each file reads with its preset; axes, signs and scales are as claimed."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from slipid.data.reading.presets import preset
from slipid.data.reading.reader import find_logs, read_logs
from slipid.data.reading.table import read_table
from slipid.data.wheel_signals import (
    bridge_stalls,
    first_moved,
    integral,
    interpolate,
    swapped_order,
)
from tests.helpers.one_log import read_log

RADIUS = 0.04


def rim_matrix(azimuths, base):
    a = np.radians(azimuths)
    return np.stack([-np.sin(a), np.cos(a), np.full(len(a), base)], axis=1)


ROBOTINO = rim_matrix([60.0, 180.0, 300.0], 0.125)
TO_TWIST = RADIUS * np.linalg.pinv(ROBOTINO)


@pytest.fixture(scope="module")
def robotino2022(real_data: Path):
    folders = {
        **{s: f"one_surface/{s}/*.csv" for s in ("table", "brown", "gray", "green")},
        "moved": "wheel_load/gray_surface/*.csv",
        "two": "two_surfaces/green_table/*.csv",
    }
    root, layout = real_data / "robotino2022", preset("robotino2022")
    return {
        name: [read_log(path, layout, root=root) for path in find_logs(root, pattern)]
        for name, pattern in folders.items()
    }


@pytest.mark.slow
def test_every_run_of_2022_reads(robotino2022):
    counts = {name: len(logs) for name, logs in robotino2022.items()}
    assert counts == {"table": 50, "brown": 50, "gray": 150, "green": 150, "moved": 72, "two": 36}
    for log in (log for logs in robotino2022.values() for log in logs):
        assert 150 < log.samples < 600
        assert 0.028 < np.median(np.diff(log.time)) < 0.035
        assert log.notes == ()
        edges = np.linspace(log.time[0], log.time[-1], int(log.duration / 0.5) + 1)
        turned = np.diff(interpolate(log.time, log.wheel_angle, edges), axis=0)
        commanded = np.diff(
            interpolate(log.time, integral(log.time, log.twist_command), edges), axis=0
        )
        commanded = commanded @ ROBOTINO.T / RADIUS
        assert swapped_order(turned, commanded) is None


@pytest.mark.slow
def test_frames_repeat_as_a_29_hz_camera_does(robotino2022):
    logs = [log for logs in robotino2022.values() for log in logs]
    repeated = np.concatenate([~log.pose_fresh[1:] for log in logs])
    assert repeated.mean() == pytest.approx(0.086, abs=0.005)


@pytest.mark.slow
def test_axes_and_scale_of_the_camera_on_the_table(robotino2022):
    """Pose and wheels agree but for the scale where wheels grip, which fixes every sign."""
    ratios, turns = [], []
    for log in robotino2022["table"]:
        start = first_moved(log.wheel_angle, RADIUS)
        steps = np.diff(log.wheel_angle, axis=0) @ TO_TWIST.T
        heading = 0.5 * (log.pose[1:, 2] + log.pose[:-1, 2])
        towards = np.exp(1j * heading) * (steps[:, 0] + 1j * steps[:, 1])
        wheels = towards[start:].sum()
        camera = complex(*(log.pose[-1, :2] - log.pose[start, :2]))
        ratios.append(abs(wheels / camera))
        turns.append(np.degrees(np.angle(wheels / camera)))
    assert np.median(ratios) == pytest.approx(1.117, rel=0.02)
    assert np.std(ratios) < 0.01
    assert abs(np.median(turns)) < 2.0  # the marker is glued on a little askew
    assert np.std(turns) < 1.0


def test_logged_steps_have_the_nominal_scale_and_lose_large_ones(robotino2022):
    pixels, steps = [], []
    for log in robotino2022["gray"]:
        table = read_table(log.path, preset("robotino2022"), all_columns=True)
        pixels.append(np.hypot(np.diff(table["xpos"]), np.diff(table["ypos"])))
        steps.append(np.hypot(table["dx"], table["dy"])[1:])
    pixel, step = np.concatenate(pixels), np.concatenate(steps)
    small, large = (pixel > 1) & (pixel < 4), pixel > 6
    assert np.median(step[small] / pixel[small]) == pytest.approx(1.8378, abs=0.001)
    assert (step[large] / pixel[large]).max() < 1.5


def test_currents_are_magnitudes_in_steps_of_the_converter(robotino2022):
    log = robotino2022["gray"][0]
    np.testing.assert_allclose(log.current * 39, np.round(log.current * 39), atol=0.02)
    assert log.current.min() >= 0


def test_reported_speed_reads_high(robotino2022):
    ratios = []
    for log in robotino2022["table"]:
        turned = log.wheel_angle[-1] - log.wheel_angle[0]
        reported = np.trapezoid(log.wheel_speed, log.time, axis=0)
        long = np.abs(turned) > 20
        ratios += list((reported / turned)[long])
    assert np.median(ratios) == pytest.approx(1.013, abs=0.005)


def test_stalls_freeze_speeds_and_currents_too(robotino2022):
    """All reported values are constant in a stall, on brown in most runs, on green in none."""
    stalls, frozen = 0, []
    for log in robotino2022["brown"]:
        _, stalled = bridge_stalls(log.time, log.wheel_angle)
        stalls += stalled.any()
        frozen.append(np.all(np.diff(log.current, axis=0) == 0, axis=1)[stalled[1:]])
    assert stalls > 30
    assert np.concatenate(frozen).mean() > 0.9
    for log in robotino2022["green"]:
        assert not bridge_stalls(log.time, log.wheel_angle)[1].any()


def test_stalls_of_the_telemetry_are_found_and_bridged(robotino2022):
    """In brown/exp05 ticks are constant for six rows, then 3022 come at once; the camera ran on."""
    log = next(log for log in robotino2022["brown"] if log.name.endswith("exp05.csv"))
    bridged, stalled = bridge_stalls(log.time, log.wheel_angle)
    assert set(range(61, 67)) <= set(np.flatnonzero(stalled) + 4)  # lines of the file
    step, raw = (np.abs(np.diff(angle[:, 2])) for angle in (bridged, log.wheel_angle))
    row = int(np.argmax(raw))
    usual = np.median(step[row - 30 : row + 30])
    assert raw[row] > 2.0 * usual
    assert step[row - 2 : row + 3].max() < 2.0 * usual


@pytest.mark.parametrize(
    ("pattern", "name", "runs", "rows", "wheels"),
    [
        ("robotino2022/motor/gray_*.csv", "robotino2022", 1, 577, 3),
        ("robotino2022/motor/green_gray*.csv", "robotino2022_blind", 1, 661, 3),
        ("robotino2022/motor/data_*.csv", "robotino2022_motor", 2, 4585, 3),
        ("robotino2021/experimental_data_gray.csv", "robotino2021", 204, 1343, 3),
        ("robotino2021/experimental_data_blue.csv", "robotino2021", 204, 1266, 3),
        ("robotino2021/experimental_data_red.csv", "robotino2021", 204, 1362, 3),
        ("robotino2021/*whole_field.csv", "robotino2021_field", 69, 1452, 3),
        ("robotino2021/motor_*.csv", "robotino2021_motor", 1, 9001, 3),
        ("robotino2021/figure7/*.csv", "robotino2021_camera", 3, 2801, 0),
        ("omni3_optitrack/*/*/*run*.csv", "omni3_optitrack", 11, 18081, 3),
    ],
)
@pytest.mark.slow
def test_every_other_file_reads(real_data, pattern, name, runs, rows, wheels):
    layout = preset(name)
    logs = [
        log
        for path in find_logs(real_data, pattern)
        for log in read_logs(path, layout, real_data, None, "as_built").logs
    ]
    assert (len(logs), sum(log.samples for log in logs)) == (runs, rows)
    assert {log.wheels for log in logs} == {wheels}
    assert len({log.name for log in logs}) == runs


def test_ticks_of_the_motor_logs_do_not_accumulate(real_data):
    for path in find_logs(real_data, "robotino2022/motor/data_*.csv"):
        table = read_table(path, preset("robotino2022_motor"), all_columns=True)
        log = read_log(path, preset("robotino2022_motor"))
        ticks = log.wheel_angle[:, 0] * 16 * 2000 / (2 * np.pi)
        assert np.abs(table["m1pos"]).max() < 0.01 * np.abs(ticks).max()


@pytest.mark.slow
def test_rows_of_2021_are_0_45_s_apart(real_data):
    """Ticks between rows over the reported speed, which reads 1.3 % high."""
    periods = []
    for path in find_logs(real_data, "robotino2021/experimental_data_[gbr]*[yed].csv"):
        for log in read_logs(path, preset("robotino2021"), real_data, None, "as_built").logs:
            turned, speed = np.diff(log.wheel_angle, axis=0), log.wheel_speed[1:]
            fast = np.abs(speed) > 0.5 * np.abs(speed).max() + 0.5
            periods += list(1.013 * turned[fast] / speed[fast])
    assert np.median(periods) == pytest.approx(0.45, abs=0.01)


def test_axes_of_2021_on_gray(real_data):
    """Translation with little slip: wheels and camera agree but for the same scale as in 2022."""
    path = real_data / "robotino2021" / "experimental_data_gray.csv"
    ratios, turns = [], []
    for log in read_logs(path, preset("robotino2021"), real_data, None, "as_built").logs:
        if np.any(log.twist_command[:, 2]) or log.samples < 4:
            continue
        steps = np.diff(log.wheel_angle, axis=0) @ TO_TWIST.T
        heading = 0.5 * (log.pose[1:, 2] + log.pose[:-1, 2])
        wheels = (np.exp(1j * heading) * (steps[:, 0] + 1j * steps[:, 1])).sum()
        camera = complex(*(log.pose[-1, :2] - log.pose[0, :2]))
        if abs(camera) > 0.05:
            ratios.append(abs(wheels / camera))
            turns.append(np.degrees(np.angle(wheels / camera)))
    assert len(ratios) > 100
    assert np.median(ratios) == pytest.approx(1.117, rel=0.02)
    assert abs(np.median(turns)) < 2.0


def test_gyro_of_the_field_is_in_degrees_with_the_sign_of_the_heading(real_data):
    path = real_data / "robotino2021" / "experimental_data_on_whole_field.csv"
    gyro, rate = [], []
    for log in read_logs(path, preset("robotino2021_field"), real_data, None, "as_built").logs:
        gyro += list(log.gyro[1:])
        rate += list(np.diff(log.pose[:, 2]) / np.diff(log.time))
    gyro, rate = np.array(gyro), np.array(rate)
    assert np.polyfit(gyro, rate, 1)[0] == pytest.approx(1.0, abs=0.03)
    assert np.corrcoef(gyro, rate)[0, 1] > 0.98


def test_wheels_of_omni3_stand_at_300_60_and_180_degrees(real_data):
    """Joystick runs excite all three axes: w = J xi / r fitted freely must have that shape."""
    layout = preset("omni3_optitrack")
    wheels, twists = [], []
    for path in find_logs(real_data, "omni3_optitrack/joystick/221220202235/*run*.csv"):
        log = read_log(path, layout)
        at = np.arange(log.time[0], log.time[-1], 0.4)
        pose, angle = (interpolate(log.time, v, at) for v in (log.pose, log.wheel_angle))
        step = np.exp(-0.5j * (pose[1:, 2] + pose[:-1, 2])) * np.diff(pose[:, 0] + 1j * pose[:, 1])
        twists.append(np.stack([step.real, step.imag, np.diff(pose[:, 2])], axis=1))
        wheels.append(np.diff(angle, axis=0))
    fitted = np.linalg.lstsq(np.concatenate(twists), np.concatenate(wheels), rcond=None)[0].T
    azimuth = np.degrees(np.arctan2(-fitted[:, 0], fitted[:, 1])) % 360
    np.testing.assert_allclose(azimuth, [300.0, 60.0, 180.0], atol=3.0)
    radius = 1.0 / np.hypot(fitted[:, 0], fitted[:, 1])
    np.testing.assert_allclose(radius, 0.051, rtol=0.05)
    assert np.mean(fitted[:, 2] * radius) == pytest.approx(0.195, rel=0.03)


def test_omni3_metadata_is_what_the_preset_says(real_data):
    layout = preset("omni3_optitrack")
    for path in find_logs(real_data, "omni3_optitrack/*/*/*_metadata.csv"):
        with path.open(encoding="utf-8") as file:
            settings = {row[0]: row[1:] for row in csv.reader(file) if row}
        assert float(settings["ngear"][0]) == layout.gear_ratio
        assert float(settings["encRes"][0]) == layout.ticks_per_revolution
