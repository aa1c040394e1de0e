"""Runs are laid end to end and cut into windows without loss, doubling or invention."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from slipid.data.log import Log
from slipid.data.runs import MOVED_M, collect, first_row
from slipid.data.wheel_signals import integral
from slipid.data.windows import ammeter_variance, windows
from slipid.support.errors import DataError
from tests.helpers.slow_meters import held

RADIUS = 0.04


def run(
    name="one/exp01.csv",
    seconds=8.0,
    wheels=3,
    start=1.0,
    command=(0.1, 0.0, 0.0),
    seed=0,
    **changes,
):
    """Return a run whose wheels swing after `start`; its camera repeats a tenth of its frames."""
    rng = np.random.default_rng(seed)
    time = 5.0 + np.cumsum(rng.normal(0.031, 0.002, int(seconds / 0.031)).clip(0.02))
    since = np.maximum(time - time[0] - start, 0.0)
    rate = np.array([3.0, -2.0, 1.5, 2.5])[:wheels]
    angle = since[:, None] * rate + 0.2 * np.sin(1.3 * since)[:, None]
    pose = np.stack([0.1 * since, 0.02 * since, 0.05 * since], axis=1)
    values = {
        "name": name,
        "path": Path(name),
        "sha256": "0" * 64,
        "time": time,
        "wheel_angle": angle,
        "wheel_speed": None,
        "wheel_speed_command": None,
        "twist_command": np.tile(command, (len(time), 1)),
        "current": rng.normal(0.4, 0.1, (len(time), wheels)),
        "current_is_signed": True,
        "voltage": rng.normal(6.0, 0.5, (len(time), wheels)),
        "duty": None,
        "bus_voltage": None,
        "gyro": None,
        "pose": pose,
        "pose_fresh": rng.random(len(time)) > 0.1,
        "surface": "gray",
        "load": "as_built",
    }
    return Log(**(values | changes))


@pytest.fixture
def logs():
    return [run("a.csv"), run("b.csv", seconds=12.0, seed=1), run("c.csv", seconds=6.0, seed=2)]


# laid end to end


def test_there_is_one_copy_of_the_samples(logs):
    data = collect(logs)
    for k, log in enumerate(data.logs):
        for name in ("time", "wheel_angle", "pose", "current", "voltage"):
            whole, part = getattr(data, name), getattr(log, name)
            assert np.shares_memory(part, whole), name
            np.testing.assert_array_equal(part, whole[data.rows(k)])
            np.testing.assert_array_equal(part, getattr(logs[k], name))
        assert np.shares_memory(log.pose_fresh, data.fresh)
    assert [data.rows(k).stop - data.rows(k).start for k in range(3)] == [x.samples for x in logs]
    assert len(data.time) == sum(log.samples for log in logs)


def test_a_bridged_stall_leaves_the_log_as_it_was():
    whole = run()
    angle = whole.wheel_angle.copy()
    angle[100:120] = angle[100]
    stalled = run(wheel_angle=angle)
    data = collect([stalled, whole])
    np.testing.assert_array_equal(data.logs[0].wheel_angle, angle)
    assert not data.live[data.rows(0)][101:120].any()
    assert data.live[data.rows(1)].all()
    np.testing.assert_allclose(data.wheel_angle[data.rows(0)], whole.wheel_angle, atol=0.05)
    again = data.subset([0])
    np.testing.assert_array_equal(again.live, data.live[data.rows(0)])
    np.testing.assert_array_equal(again.wheel_angle, data.wheel_angle[data.rows(0)])


def test_currents_of_a_stall_are_left_out_of_the_mean():
    whole = run()
    angle, current = whole.wheel_angle.copy(), np.full_like(whole.current, 0.5)
    angle[100:120] = angle[100]
    current[101:120] = 9.0
    w = windows(collect([run(wheel_angle=angle, current=current)]), RADIUS)
    np.testing.assert_allclose(w.current, 0.5, atol=1e-12)


def test_a_subset_keeps_the_order_and_the_sessions(logs):
    data = collect(logs, [log.name.upper() for log in logs])
    part = data.subset([2, 0])
    assert [log.name for log in part.logs] == ["c.csv", "a.csv"]
    assert part.session == ("C.CSV", "A.CSV")
    np.testing.assert_array_equal(part.pose, np.concatenate([logs[2].pose, logs[0].pose]))


def test_heading_and_speed_are_those_of_the_command():
    data = collect(
        [run(command=(0.0, -0.2, 0.0)), run(command=(0.0, 0.0, 0.5)), run(twist_command=None)]
    )
    assert data.heading[0] == pytest.approx(-np.pi / 2)
    assert data.speed[0] == pytest.approx(0.2)
    assert np.isnan(data.heading[1:]).all()
    assert np.isnan(data.speed[2])
    assert data.session[0] == "gray/as_built/0.20"
    assert data.session[2] == "gray/as_built"


def test_a_channel_that_one_run_lacks_is_missing():
    data = collect([run(), run(voltage=None)])
    assert data.voltage is None
    assert data.current is not None
    w = windows(data, RADIUS)
    assert w.has_current
    assert not w.has_voltage
    assert (w.voltage == 0).all()


# windows


@pytest.mark.parametrize("per_segment", [1, 4, 7])
@pytest.mark.parametrize("longest", [0.4, 1.3, 6.0, np.inf])
def test_windows_partition_every_run_from_where_it_moves(logs, per_segment, longest):
    data = collect(logs)
    w = windows(data, RADIUS, per_segment=per_segment, longest=longest)
    assert w.dt.shape == (len(w), per_segment)
    assert (w.dt > 0).all()
    for k, log in enumerate(data.logs):
        mine = np.flatnonzero(w.run == k)
        fresh = np.flatnonzero(log.pose_fresh)
        first = fresh[fresh >= first_row(data, k, RADIUS)][0]
        assert w.dt[mine].sum() == pytest.approx(log.time[fresh[-1]] - log.time[first], abs=1e-9)
        turned = log.wheel_angle[fresh[-1]] - log.wheel_angle[first]
        np.testing.assert_allclose(w.turn[mine].sum(axis=(0, 1)), turned, atol=1e-9)
        np.testing.assert_array_equal(w.pose[mine[0], 0], log.pose[first])
        np.testing.assert_array_equal(w.pose[mine[-1], -1], log.pose[fresh[-1]])
        np.testing.assert_array_equal(w.pose[mine[:-1], -1], w.pose[mine[1:], 0])
        assert w.dt[mine].max() <= longest + 0.2  # edges lie on camera frames


def test_edges_lie_on_new_camera_frames(logs):
    data = collect(logs)
    w = windows(data, RADIUS)
    for piece, edges in zip(w.run, w.pose, strict=True):
        log = data.logs[piece]
        for pose in edges:
            row = np.flatnonzero((log.pose == pose).all(axis=1))
            assert log.pose_fresh[row].all()


def test_only_long_runs_are_cut_into_segments():
    w = windows(collect([run("short", seconds=10.0), run("long", seconds=60.0)]), RADIUS)
    assert (w.run == 0).sum() == 1
    assert (w.run == 1).sum() == 3  # 59 s in pieces of at most 4 times 6 s
    assert w.surface == ("gray",) * 4
    assert w.session == ("gray/as_built/0.10",) * 4


def turn_per_lag(data, lag, small):
    less, more = (windows(data, RADIUS, lag=lag + d).turn for d in (-small, small))
    return (more - less) / (2 * small)


@pytest.mark.parametrize("lag", [0.1, 0.156])
def test_speed_change_is_the_derivative_by_the_lag(logs, lag):
    data = collect(logs)
    w = windows(data, RADIUS, lag=lag)
    # a secant over the 0.16 s in which speeds are taken, but for the end of the run
    secant = turn_per_lag(data, lag, 0.08)[:, :-1]
    np.testing.assert_allclose(-w.speed_change[:, :-1], secant, atol=1e-9)
    assert np.abs(secant).max() > 0.05
    # the derivative itself where the wheels swing smoothly, away from start and end
    slope = turn_per_lag(data, lag, 0.02)[:, 1:-1]
    np.testing.assert_allclose(-w.speed_change[:, 1:-1], slope, atol=0.02 * np.abs(slope).max())
    assert np.abs(slope).max() > 0.05


def test_windows_know_what_another_lag_makes_of_them(logs):
    data = collect(logs)
    w, other = (windows(data, RADIUS, lag=lag) for lag in (0.1, 0.13))
    moved = w.at_lag(0.13)
    assert moved.lag == 0.13
    inside = np.s_[:, 1:-1]  # away from start and end
    change = np.abs(other.turn - w.turn)[inside].max()
    assert change > 1e-3
    np.testing.assert_allclose(moved.turn[inside], other.turn[inside], atol=0.1 * change)


def test_lag_shifts_the_wheels_and_not_the_poses(logs):
    data = collect(logs)
    w = windows(data, RADIUS, lag=0.1)
    log = data.logs[0]
    at = np.array([log.time[(log.pose == p).all(axis=1)][0] for p in w.pose[0]]) - 0.1
    phi = np.stack([np.interp(at, log.time, log.wheel_angle[:, k]) for k in range(3)], axis=1)
    np.testing.assert_allclose(w.turn[0], np.diff(phi, axis=0), atol=1e-12)


def test_means_are_over_time_and_their_variance_the_ammeters_over_their_count():
    data = collect([run(pose_fresh=None)])
    log = data.logs[0]
    w = windows(data, RADIUS, per_segment=2)
    edges = [np.flatnonzero((log.pose == p).all(axis=1))[0] for p in w.pose[0]]
    for k, (a, b) in enumerate(pairwise(edges)):
        rows, seconds = slice(a, b + 1), log.time[b] - log.time[a]
        for mean, of_rows in ((w.current, log.current), (w.voltage, log.voltage)):
            expected = integral(log.time[rows], of_rows[rows])[-1] / seconds
            np.testing.assert_allclose(mean[0, k], expected, rtol=1e-9)
        # the edges cut the first and the last reading of uneven rows not quite in half
        expected = ammeter_variance(data)[0] / (b - a)
        np.testing.assert_allclose(w.current_var[0, k], expected, rtol=0.01)


@pytest.mark.parametrize("lag", [0.0, 0.011, 0.05])
def test_means_of_what_grows_are_those_of_the_middle_of_the_window(lag):
    """The mean of a rising voltage is not late, whichever rows lie in a window."""
    blank = run()
    log = replace(blank, voltage=2.0 + 3.0 * blank.time[:, None] * np.ones(3))
    data = collect([log])
    w = windows(data, RADIUS, lag=lag, per_segment=2)
    at = np.array([log.time[(log.pose == p).all(axis=1)][0] for p in w.pose[0]]) - lag
    middle = 2.0 + 3.0 * 0.5 * (at[1:] + at[:-1])
    step = np.diff(log.time).max()
    np.testing.assert_allclose(w.voltage[0], middle[:, None] * np.ones(3), atol=step**2)


@pytest.mark.parametrize("n", [3, 5])
def test_a_slow_meter_is_even_between_its_readings(n):
    """A linear signal has the same mean, however rarely it is read; readings count once."""
    blank = run()
    grows = 2.0 + 3.0 * blank.time[:, None] * np.ones(3)
    log = replace(blank, current=grows, voltage=grows, current_is_signed=True)
    often, seldom = (windows(collect([one]), RADIUS, per_segment=2) for one in (log, held(log, n)))
    gap = log.time[n] - log.time[0]  # the last reading of a log has no next one
    np.testing.assert_allclose(seldom.voltage, often.voltage, atol=3.0 * gap**2)
    np.testing.assert_allclose(seldom.current, often.current, atol=3.0 * gap**2)
    assert (often.voltage_var == 0.0).all()
    # T / gap gaps, and a jump of 3 gap anywhere in each
    expected = (3.0 * gap) ** 2 / 12 * gap / seldom.dt[..., None]
    np.testing.assert_allclose(seldom.voltage_var / expected, 1.0, atol=0.5)


@pytest.mark.slow
def test_a_meter_that_is_read_in_every_row_misses_nothing():
    """A log may state it or leave it out."""
    log = run(pose_fresh=None)
    often, stated = (windows(collect([one]), RADIUS, per_segment=2) for one in (log, held(log, 1)))
    for name in ("current", "voltage", "current_var", "voltage_var"):
        np.testing.assert_array_equal(getattr(stated, name), getattr(often, name))


def test_what_a_slow_meter_missed_is_covered_by_its_variance():
    """A voltage jumps once, anywhere between two readings: errors match the variance."""
    off = []
    for k in range(60):
        blank = run(seconds=6.0)
        jumps = blank.time[:, None] > 7.0 + 0.05 * k
        log = replace(blank, voltage=np.where(jumps, 5.0, 1.0) * np.ones(3))
        often, seldom = (windows(collect([x]), RADIUS, per_segment=2) for x in (log, held(log, 15)))
        known = seldom.voltage_var > 1e-9
        gap = seldom.voltage - often.voltage
        np.testing.assert_allclose(gap[~known], 0.0, atol=1e-9)
        off += (gap[known] / np.sqrt(seldom.voltage_var[known])).tolist()
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("ripple", [0.0, 0.3])
def test_ripple_is_no_noise_of_the_ammeter(ripple):
    """White noise of 0.1 A under a ripple of ten readings a period, in four runs of 30 s."""
    logs = []
    for seed in range(4):
        blank = run(f"{seed}.csv", seconds=30.0, seed=seed)
        wave = ripple * np.sin(2 * np.pi * np.arange(blank.samples) / 10 + seed)
        logs.append(replace(blank, current=blank.current + wave[:, None]))
    found = ammeter_variance(collect(logs)).mean(axis=0)
    # 3870 readings; what is left of the ripple is (2 - 2 cos 36 deg)^2 / 6 of its 0.045 A^2
    np.testing.assert_allclose(found, 0.01 + 0.0243 * ripple**2 / 2, rtol=0.08)


def test_readings_in_steps_are_at_least_as_noisy_as_their_rounding():
    """Steps of 0.5 A on noise of 0.02 A: most second differences are zero."""
    quiet = run("a.csv", seconds=30.0)
    smooth = 2.0 + np.linspace(0, 1, quiet.samples)[:, None] * np.ones(3)
    noise = 0.02 * np.random.default_rng(0).standard_normal(smooth.shape)
    stepped = 0.5 * np.round((smooth + noise) / 0.5)
    found = ammeter_variance(collect([replace(quiet, current=stepped)]))
    np.testing.assert_allclose(found, 0.5**2 / 12, rtol=1e-9)


def test_jumps_and_other_runs_do_not_make_an_ammeter_noisy():
    quiet = run("a.csv", seconds=30.0)
    jumps = quiet.current.copy()
    jumps[[100, 200, 300]] = 50.0
    noisy = run("b.csv", seconds=30.0, seed=1, current=4 * run(seconds=30.0, seed=1).current)
    data = collect([replace(quiet, current=jumps), noisy])
    found = ammeter_variance(data)
    np.testing.assert_allclose(found[0], 0.01, rtol=0.15)
    np.testing.assert_allclose(found[1], 0.16, rtol=0.15)


def test_unsigned_currents_are_averaged_as_magnitudes():
    signed = run()
    flipped = run(
        current=signed.current * np.where(np.arange(3) == 1, -1.0, 1.0), current_is_signed=False
    )
    w, v = windows(collect([signed]), RADIUS), windows(collect([flipped]), RADIUS)
    assert w.current_is_signed
    assert not v.current_is_signed
    both = windows(collect([run(current=np.abs(signed.current), current_is_signed=False)]), RADIUS)
    np.testing.assert_allclose(v.current, both.current, rtol=1e-12)


def test_motion_starts_where_the_fastest_rim_has_moved():
    data = collect([run(start=2.0)])
    row = first_row(data, 0, RADIUS)
    moved = RADIUS * np.abs(data.wheel_angle - data.wheel_angle[0]).max(axis=1)
    assert moved[row] >= MOVED_M > moved[row - 1]
    assert data.time[row] - data.time[0] > 2.0


# refusals


def test_no_runs_are_refused():
    with pytest.raises(DataError, match="no runs; expected at least one log"):
        collect([])


def test_different_robots_are_refused():
    with pytest.raises(DataError, match=r"b\.csv: 4 wheels; expected 3, as in a\.csv"):
        collect([run("a.csv"), run("b.csv", wheels=4)])


def test_runs_without_poses_are_refused():
    with pytest.raises(DataError, match=r"b\.csv: no pose; expected columns of x and y, of a"):
        collect([run("a.csv"), run("b.csv", pose=None, pose_fresh=None)])


def test_a_robot_that_stands_is_refused():
    data = collect([run("a.csv"), run("still.csv", start=100.0)])
    with pytest.raises(DataError, match=r"still\.csv: no wheel rim moves by 10 mm; expected a run"):
        windows(data, RADIUS)


def test_a_run_with_too_few_frames_is_refused():
    few = run("blind.csv")
    fresh = np.zeros(few.samples, bool)
    fresh[-4:] = True
    data = collect([run(pose_fresh=None), run("blind.csv", pose_fresh=fresh)])
    with pytest.raises(DataError, match=r"blind\.csv: 4 poses .*; expected at least 5"):
        windows(data, RADIUS)


@pytest.mark.parametrize(
    ("lacking", "what"), [([2], "without headings"), ([0, 1], "without positions")]
)
def test_runs_without_whole_poses_are_refused_with_what_they_are_good_for(lacking, what):
    part = run("part.csv")
    part.pose[:, lacking] = np.nan
    with pytest.raises(DataError, match=rf"part\.csv: poses {what}.*identify --only calibration"):
        windows(collect([run(), part]), RADIUS)


def test_poses_of_the_ends_alone_are_no_windows():
    ends = run("ends.csv")
    fresh = np.zeros(ends.samples, bool)
    fresh[[0, -1]] = True
    with pytest.raises(DataError, match=r"ends\.csv: poses in 2 rows only; expected x, y and"):
        windows(collect([run("ends.csv", pose_fresh=fresh)]), RADIUS)


# the direction of motion, which friction follows


def swing(rate, seconds=8.0, tick=1e-4, **changes):
    """Return a run whose wheels turn at rates that are a function of the time [rad/s]."""
    one = run(seconds=seconds)
    rates = np.broadcast_to(rate(one.time - one.time[0])[:, None], one.wheel_angle.shape)
    angle = integral(one.time, rates)
    return run(seconds=seconds, wheel_angle=np.round(angle / tick) * tick, **changes)


def share(speed=3.0, tick=1e-4, **changes):
    """Return the directions in a window that spans a stop, and the share of it before the stop."""
    log = swing(lambda t: speed * (t < 4.0), tick=tick, **changes)
    w = windows(collect([log]), RADIUS, per_segment=1, longest=60.0)
    return w.direction[0, 0], (4.0 + log.time[0] - w.start[0]) / w.dt[0, 0]


def test_direction_is_the_share_of_the_time_in_motion():
    for speed in (3.0, -3.0, 20.0):
        found, part = share(speed)
        np.testing.assert_allclose(found, np.sign(speed) * part, atol=0.01)


def test_direction_does_not_take_steps_of_a_coarse_encoder_for_rests():
    found, part = share(1.0, tick=0.15)
    np.testing.assert_allclose(found, part, atol=0.06)


def test_direction_at_a_steady_speed_is_that_of_the_motor():
    from slipid.model.motor import sign_of_motion

    for speed in (0.1, -0.3, 2.0):
        w = windows(collect([swing(lambda t, v=speed: np.full_like(t, v))]), RADIUS)
        np.testing.assert_allclose(
            w.direction, sign_of_motion(jnp.array([speed])).item(), atol=2e-3
        )


def test_directions_of_a_reversal_cancel_in_signed_currents_alone():
    for signed, expected in ((True, 0.0), (False, 1.0)):
        log = swing(lambda t: np.where(t < 4.0, 3.0, -3.01), current_is_signed=signed)
        w = windows(collect([log]), RADIUS, per_segment=1, longest=60.0)
        np.testing.assert_allclose(np.abs(w.direction), expected, atol=0.08)


def test_wheels_that_tremble_at_rest_do_not_move():
    log = swing(lambda t: 3.0 * (t < 2.0))
    noise = 1e-3 * np.random.default_rng(0).normal(size=log.wheel_angle.shape)
    w = windows(collect([replace(log, wheel_angle=log.wheel_angle + noise)]), RADIUS)
    assert (np.abs(w.direction[:, -1]) < 0.01).all()


def test_wheels_that_turn_evenly_change_no_speed():
    """Neither at the first pose, which the log does not begin long before, nor at the last one."""
    log = run(start=0.0)
    turned = np.outer(log.time - log.time[0], [3.0, -2.0, 1.5])
    w = windows(collect([replace(log, wheel_angle=turned)]), RADIUS)
    np.testing.assert_allclose(w.speed_change, 0.0, atol=1e-9)
