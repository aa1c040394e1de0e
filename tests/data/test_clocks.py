"""The clock of a camera is found from the motion that the robot measured as well."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.stats import norm

from slipid.data.align.clock import SUFFICIENT_STD_S, Clock, best_clock, clock_of_poses
from slipid.data.align.regression import MotionPair, StepNoise
from slipid.data.reading.presets import declared_layout
from slipid.data.reading.reader import read_logs, read_runs
from slipid.support.errors import DataError

OFFSET = 1.2345
"""Offset of the robot's clock ahead of the camera's [s]."""


class Drive:
    """A robot with three wheels that starts, turns and stops now and then, and slips a little."""

    def __init__(self, seed=0, seconds=12.0, steady=False, drift=0.0):
        rng = np.random.default_rng(seed)
        fine = np.arange(-3.0, seconds + 3.0, 0.002)
        knots = np.arange(0.5, seconds - 0.5, 1.0)
        rates = np.stack([rng.uniform(-a, a, len(knots)) for a in (0.2, 0.2, 0.6)], axis=1)
        twist = np.stack([np.interp(fine, knots, r, 0.0, 0.0) for r in rates.T], axis=1)
        twist[(fine < 0.5) | (fine > seconds - 0.5)] = 0.0
        if steady:
            twist[:] = [0.15, 0.0, 0.0]
        heading = np.cumsum(twist[:, 2]) * 0.002
        c, s = np.cos(heading), np.sin(heading)
        world = np.stack([c * twist[:, 0] - s * twist[:, 1], s * twist[:, 0] + c * twist[:, 1]], 1)
        place = np.cumsum(world, axis=0) * 0.002
        azimuth = np.radians([60.0, 180.0, 300.0])
        into = np.stack([-np.sin(azimuth), np.cos(azimuth), np.full(3, 0.125)], 1) / 0.04
        angle = np.cumsum(twist @ into.T * 1.05, axis=0) * 0.002
        self.time = np.arange(0.0, seconds, 0.031)
        self.angle = np.stack([np.interp(self.time, fine, a) for a in angle.T], 1)
        gyro = np.interp(self.time, fine, twist[:, 2])
        self.gyro = gyro + 0.01 + rng.normal(0.0, 0.004, len(gyro))
        times = np.arange(-1.0, seconds + 1.0, 1 / 29)
        pose = np.stack([np.interp(times, fine, p) for p in (*place.T, heading)], 1)
        self.pose = pose + rng.normal(0.0, 1.0, pose.shape) * [2e-4, 2e-4, 0.0015]
        self.pose_time = (times - OFFSET) / (1.0 + drift)

    def by_wheels(self):
        return MotionPair.of_wheels(self.time, self.angle, self.pose_time, self.pose)

    def by_gyro(self):
        return MotionPair.of_gyro(self.time, self.gyro, self.pose_time, self.pose)


@pytest.mark.slow
def test_a_gyro_gives_the_offset_to_milliseconds_with_its_uncertainty():
    clocks = [clock_of_poses(Drive(seed).by_gyro()) for seed in range(8)]
    assert all(clock is not None for clock in clocks)
    error = np.array([clock.offset - OFFSET for clock in clocks])
    std = np.array([clock.offset_std for clock in clocks])
    assert np.sqrt(np.mean(error**2)) < 0.003
    assert std.max() < 0.004
    assert 0.3 < np.sqrt(np.mean((error / std) ** 2)) < 2.0


def test_wheels_give_it_with_a_wider_interval():
    clock = clock_of_poses(Drive(3).by_wheels())
    assert clock is not None
    assert clock.source == "wheels"
    assert clock.offset == pytest.approx(OFFSET, abs=0.01)
    assert 0.015 <= clock.offset_std < 0.02


@pytest.mark.slow
def test_the_gyro_comes_first_and_wheels_only_where_it_determines_no_clock():
    drive = Drive(1)

    def views():
        yield drive.by_gyro()
        raise AssertionError("a sure clock needs no other view")

    clock = best_clock(views())
    assert clock is not None
    assert clock.source == "gyro"
    assert clock.offset_std <= SUFFICIENT_STD_S
    drive.gyro = np.zeros_like(drive.gyro)
    other = best_clock([drive.by_gyro(), drive.by_wheels()])
    assert other is not None
    assert other.source == "wheels"


def test_times_of_poses_come_out_on_the_clock_of_the_robot():
    drive = Drive(2)
    clock = clock_of_poses(drive.by_gyro())
    assert clock is not None
    times = clock.robot_time(drive.pose_time)
    np.testing.assert_allclose(times, np.arange(-1.0, 13.0, 1 / 29)[: len(times)], atol=0.005)
    moved = clock.robot_time(np.array([clock.middle, clock.middle + 10.0]))
    assert moved[0] == pytest.approx(clock.middle + clock.offset)
    assert moved[1] - moved[0] == pytest.approx(10.0 * (1.0 + clock.drift))


def test_intervals_of_a_clock_hold_nine_truths_in_ten():
    clock = Clock(1.2, 0.01, 3e-5, 2e-5, 5.0, 0.1, "gyro")
    low, high = clock.offset_interval90
    assert norm.cdf([low, high], 1.2, 0.01) == pytest.approx([0.05, 0.95], abs=1e-4)
    assert clock.offset_interval90 == pytest.approx((1.2 - 0.01645, 1.2 + 0.01645), abs=1e-4)


@pytest.mark.slow
def test_a_long_run_tells_the_drift():
    drift = 2e-4
    clock = clock_of_poses(Drive(5, seconds=120.0, drift=drift).by_gyro())
    assert clock is not None
    assert clock.drift == pytest.approx(drift, abs=5e-5)
    assert clock.drift_std < 3e-5
    wrong = clock_of_poses(Drive(5, seconds=120.0, drift=1e-3).by_gyro())
    assert wrong is not None
    assert wrong.drift == pytest.approx(1e-3, abs=5e-5)  # 29.97 frames a second taken for 30
    other = clock_of_poses(Drive(5, seconds=40.0, drift=3e-3).by_gyro())
    assert other is not None
    assert abs(other.drift - 3e-3) < 3 * other.drift_std < 6e-4
    short = clock_of_poses(Drive(5).by_gyro())
    assert short is not None
    assert short.drift_std > 8e-5  # what quartz does: a short run tells no more


@pytest.mark.parametrize("shift", [-40.0, 1.7e9])
def test_clocks_that_count_from_elsewhere_are_put_together(shift):
    drive = Drive(4)
    drive.pose_time = drive.pose_time + shift
    clock = clock_of_poses(drive.by_gyro())
    assert clock is not None
    assert clock.offset + shift == pytest.approx(OFFSET, abs=0.003)


def test_steady_motion_tells_nothing():
    drive = Drive(0, steady=True)
    assert clock_of_poses(drive.by_wheels()) is None
    assert clock_of_poses(drive.by_gyro()) is None


def test_the_same_again_and_again_tells_nothing():
    drive = Drive(0, seconds=30.0)
    period = 2.0
    drive.angle = np.sin(2 * np.pi * drive.time / period)[:, None] * np.ones(3)
    turned = 0.05 * np.sin(2 * np.pi * drive.pose_time / period)
    drive.pose = np.stack([turned, 0 * turned, 0 * turned], axis=1)
    assert clock_of_poses(drive.by_wheels()) is None


def test_a_gyro_tells_nothing_of_a_robot_that_does_not_turn():
    drive = Drive(2)
    rng = np.random.default_rng(0)
    drive.gyro = 0.01 + rng.normal(0.0, 0.004, len(drive.time))
    drive.pose[:, 2] = rng.normal(0.0, 0.0015, len(drive.pose))
    assert clock_of_poses(drive.by_gyro()) is None


@pytest.mark.slow
def test_parts_of_a_run_that_disagree_make_the_interval_wider():
    one = clock_of_poses(Drive(0, seconds=30.0).by_gyro())
    drive = Drive(0, seconds=30.0)
    middle = slice(len(drive.pose_time) // 3, 2 * len(drive.pose_time) // 3)
    drive.pose_time[middle] += 0.03
    two = clock_of_poses(drive.by_gyro())
    assert one is not None
    assert two is not None
    assert two.offset_std > 2.0 * one.offset_std


def test_no_step_goes_across_a_gap_of_the_poses():
    drive = Drive(2)
    there = np.abs(drive.pose_time - 4.0) > 0.7
    motion = MotionPair.of_gyro(drive.time, drive.gyro, drive.pose_time[there], drive.pose[there])
    steps = motion.increments(0.1)
    assert (steps.last - steps.first).max() < 0.25
    assert len(steps.first) > 90


def test_a_short_record_tells_nothing():
    drive = Drive(0)
    few = slice(0, 15)
    short = MotionPair.of_wheels(drive.time, drive.angle, drive.pose_time[few], drive.pose[few])
    assert clock_of_poses(short) is None
    short = MotionPair.of_wheels(drive.time[few], drive.angle[few], drive.pose_time, drive.pose)
    assert clock_of_poses(short) is None


def test_noise_of_poses_is_told_from_that_of_steps():
    rng = np.random.default_rng(0)
    times, own = rng.normal(0.0, 2.0, 20001), rng.normal(0.0, 1.0, 20000)
    joined = np.arange(20000) > 0
    noise = StepNoise.of(np.diff(times) + own, joined)
    assert noise.shared == pytest.approx(4.0, rel=0.05)
    assert noise.separate == pytest.approx(1.0, rel=0.15)


def test_whitened_noise_has_the_identity_for_its_covariance():
    noise, joined = StepNoise(0.7, 0.4), np.array([False, True, True, False, True])
    covariance = np.diag(np.full(5, 2 * 0.7 + 0.4))
    for k in np.flatnonzero(joined):
        covariance[k, k - 1] = covariance[k - 1, k] = -0.7
    root = noise.whitened(np.eye(5), joined)
    np.testing.assert_allclose(root @ covariance @ root.T, np.eye(5), atol=1e-12)


# reading ----------------------------------------------------------------------------------------


def layout(**more):
    columns = {
        "time": {"column": "t", "unit": "s"},
        "wheel_angle": {"columns": ["a", "b", "c"], "unit": "rad"},
        "gyro": {"column": "w", "unit": "rad/s"},
    }
    beside = {"{stem}.poses.csv": {"format": "tracked"}}
    return {"columns": columns, "beside": beside} | more


def write(folder, drive):
    rows = np.column_stack([drive.time, drive.angle, drive.gyro])
    np.savetxt(folder / "run.csv", rows, delimiter=",", header="t,a,b,c,w", comments="")
    head = "frame,time,x,y,heading,flag"
    lines = [head]
    for k, (t, p) in enumerate(zip(drive.pose_time, drive.pose, strict=True)):
        cells = ",,,missing" if k % 20 == 7 else f"{p[0]:.6f},{p[1]:.6f},{p[2]:.6f},ok"
        lines.append(f"{k},{t:.6f},{cells}")
    (folder / "run.poses.csv").write_text("\n".join(lines) + "\n")


def read(folder, table):
    known = declared_layout(table, "test")
    return read_logs(folder / "run.csv", known, folder, "floor", "as_built").logs[0]


def test_tracked_poses_beside_a_log_are_read_on_its_clock(tmp_path):
    drive = Drive(6)
    write(tmp_path, drive)
    log = read(tmp_path, layout())
    assert log.pose_clock is not None
    assert log.pose_clock.offset == pytest.approx(OFFSET, abs=0.003)
    assert log.pose is not None
    assert log.pose_fresh is not None
    fresh = log.pose_fresh & (log.time > 1.0)
    inside = np.interp(log.time[fresh], drive.pose_time + OFFSET, drive.pose[:, 0])
    np.testing.assert_allclose(log.pose[fresh, 0], inside, atol=2e-3)
    # frames without a pose are no poses: none is filled in
    assert fresh.sum() < 0.97 * 11 * 29


def test_positions_without_headings_have_a_clock_of_their_own_too(tmp_path):
    write(tmp_path, Drive(6, seconds=24.0))
    tracked = {"format": "tracked", "columns": {"pose_heading": False}}
    log = read(tmp_path, layout(beside={"{stem}.poses.csv": tracked}))
    assert np.isnan(log.pose[:, 2]).all()
    assert log.pose_clock.source == "wheels"
    assert log.pose_clock.offset == pytest.approx(OFFSET, abs=0.03)
    assert abs(log.pose_clock.offset - OFFSET) < 3 * log.pose_clock.offset_std


def test_poses_of_another_run_are_refused_with_what_to_do(tmp_path):
    write(tmp_path, Drive(6))
    still = Drive(7)
    still.pose[:] = still.pose[0]
    (tmp_path / "other").mkdir()
    write(tmp_path / "other", still)
    (tmp_path / "other" / "run.poses.csv").replace(tmp_path / "run.poses.csv")
    found = read_logs(
        tmp_path / "run.csv", declared_layout(layout(), "test"), tmp_path, "f", "as_built"
    )
    assert found.logs == ()
    (line,) = found.aside
    assert re.search(
        r"set aside: .*run.poses.csv: .*not determine the offset of its clock.*starts, stops",
        line,
    )


def test_a_log_that_counts_from_1970_has_its_poses_where_they_belong(tmp_path):
    drive = Drive(6)
    shift = 1.7e9
    drive.time = drive.time + shift
    write(tmp_path, drive)
    log = read(tmp_path, layout())
    assert log.pose_clock is not None
    assert log.pose_clock.offset == pytest.approx(OFFSET + shift, abs=0.003)
    assert log.pose is not None
    assert log.pose_fresh is not None
    fresh = log.pose_fresh & (log.time > 1.0)
    inside = np.interp(log.time[fresh], drive.pose_time + OFFSET, drive.pose[:, 0])
    np.testing.assert_allclose(log.pose[fresh, 0], inside, atol=2e-3)


def test_headings_that_wrap_around_are_as_good(tmp_path):
    drive = Drive(6)
    turned = drive.pose[:, 2] + 3.0
    c, s = np.cos(3.0), np.sin(3.0)
    x, y = drive.pose[:, :2].T
    drive.pose = np.column_stack([c * x - s * y, s * x + c * y, np.angle(np.exp(1j * turned))])
    assert np.abs(np.diff(drive.pose[:, 2])).max() > 6.0
    write(tmp_path, drive)
    log = read(tmp_path, layout())
    assert log.pose_clock is not None
    assert log.pose_clock.offset == pytest.approx(OFFSET, abs=0.003)


def test_a_glob_that_finds_the_poses_too_reads_the_logs_alone(tmp_path):
    write(tmp_path, Drive(6))
    runs = read_runs(tmp_path, "*.csv", declared_layout(layout(), "test"), surface=None)
    assert [log.name for log in runs.logs] == ["run.csv"]
    alone = read_runs(tmp_path, "*.poses.csv", "tracked", surface=None)
    assert [log.name for log in alone.logs] == ["run.poses.csv"]


def test_poses_alone_are_read_as_well(tmp_path):
    write(tmp_path, Drive(6, seconds=4.0))
    known = declared_layout({"format": "tracked"}, "test")
    log = read_logs(tmp_path / "run.poses.csv", known, tmp_path, None, "as_built").logs[0]
    assert log.pose is not None
    assert log.wheels == 0
    assert log.pose_clock is None


def test_the_clock_of_the_robots_own_file_is_the_robots():
    with pytest.raises(DataError, match="the robot's own file: clock = 'own'"):
        declared_layout(layout(clock="own"), "test")


def test_only_poses_may_have_a_clock_of_their_own():
    table = layout()
    columns = {"current": {"columns": ["i", "j", "k"], "unit": "A"}}
    table["beside"] = {"{stem}.poses.csv": {"format": "tracked", "columns": columns}}
    with pytest.raises(DataError, match=r"poses\.csv: clock = 'own'; allowed only for a file"):
        declared_layout(table, "test")
