"""Sensors at different rates: no pose is invented between two others, no reading counts twice."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slipid.data.reading.presets import declared_layout
from slipid.data.reading.reader import read_logs, read_runs
from slipid.data.reading.signal import Signal, SignalSource, heading
from slipid.data.wheel_signals import readings, refresh_period
from slipid.data.windows import UNREAD_VARIANCE, windows
from slipid.support.errors import DataError

RADIUS = 0.1
WHEELS = {"columns": ["left", "right"], "unit": "rad"}
POSE = {
    "pose_x": {"column": "x", "unit": "m"},
    "pose_y": {"column": "y", "unit": "m"},
    "pose_heading": {"column": "yaw", "unit": "rad"},
}
ONE_FILE = {"columns": {"time": {"column": "t", "unit": "s"}, "wheel_angle": WHEELS, **POSE}}


def angle(t):
    """Return turns of both wheels, which start after half a second [rad]."""
    on = np.maximum(np.asarray(t) - 0.5, 0.0)
    return np.stack([3.0 * on + 0.2 * np.sin(on), 2.0 * on], axis=-1)


def pose(t):
    turned = angle(t)
    yaw = 0.2 * (turned[..., 1] - turned[..., 0])
    return np.stack([0.1 * turned.mean(axis=-1), 0.02 * np.asarray(t), yaw], axis=-1)


def csv(path, names, rows):
    lines = [",".join("" if x is None else f"{x:.9g}" for x in row) for row in rows]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([",".join(names), *lines]) + "\n")


def sparse(path, rate=50.0, poses=30.0, seconds=6.0):
    """Write a file with a row for every time at which wheels or camera were read."""
    fast, slow = np.arange(0, seconds, 1 / rate), np.arange(0.007, seconds, 1 / poses)
    rows = [(t, *angle(t), None, None, None) for t in fast]
    rows += [(t, None, None, *pose(t)) for t in slow]
    csv(path, ["t", "left", "right", "x", "y", "yaw"], sorted(rows, key=lambda row: row[0]))
    return fast, slow


def one(root, layout, pattern="*.csv"):
    return read_runs(root, pattern, declared_layout(layout, "test"), surface="floor")


def test_poses_between_rows_are_read_as_they_are(tmp_path):
    _, slow = sparse(tmp_path / "run.csv")
    data = one(tmp_path, ONE_FILE)
    fresh = data.time[data.fresh]
    inside = slow[slow <= data.time[-1]]
    np.testing.assert_allclose(fresh, inside, atol=1e-9)
    np.testing.assert_allclose(data.pose[data.fresh], pose(inside), atol=1e-8)
    # between two readings of the encoders the angle is even
    np.testing.assert_allclose(data.wheel_angle, angle(data.time) - angle(0.0), atol=2e-4)


def test_windows_are_cut_at_poses_and_turns_taken_there(tmp_path):
    sparse(tmp_path / "run.csv")
    w = windows(one(tmp_path, ONE_FILE), RADIUS, longest=1.0)
    edges = w.pose[:, :, 1] / 0.02  # the time, as y shows it
    np.testing.assert_allclose(np.diff(edges, axis=1), w.dt, atol=1e-7)
    np.testing.assert_allclose(w.turn, np.diff(angle(edges), axis=1), atol=5e-4)


@pytest.mark.parametrize("lag", [0.9, -1.3])
def test_windows_keep_to_poses_whose_time_the_wheels_were_measured_at(tmp_path, lag):
    """A pose that is late shows what was before the log begins, one that is early what comes after.

    Beyond the log's ends wheels would count as standing still.
    """
    fast = np.arange(0.0, 6.0, 0.02)
    rows = [(t, *angle(t + 1.0), *pose(t + 1.0 - lag)) for t in fast.tolist()]
    csv(tmp_path / "run.csv", ["t", "left", "right", "x", "y", "yaw"], rows)
    w = windows(one(tmp_path, ONE_FILE), RADIUS, lag, longest=0.5)
    edges = w.pose[:, :, 1] / 0.02  # the time that each pose shows, as y shows it
    assert edges.min() >= 1.0 - 1e-6
    assert edges.max() <= 1.0 + fast[-1] + 1e-6
    np.testing.assert_allclose(w.turn, np.diff(angle(edges), axis=1), atol=5e-4)


def test_what_was_not_read_again_is_what_was_read_last(tmp_path):
    sparse(tmp_path / "run.csv")
    path = tmp_path / "run.csv"
    header, *lines = path.read_text().splitlines()
    given = [f"{line},{k / 1000 if k % 5 == 0 else ''}" for k, line in enumerate(lines)]
    path.write_text("\n".join([f"{header},gyro", *given]))
    layout = {"columns": {**ONE_FILE["columns"], "gyro": {"column": "gyro", "unit": "rad/s"}}}
    (log,) = one(tmp_path, layout).logs
    rows = np.arange(log.samples)
    np.testing.assert_allclose(log.gyro, (rows - rows % 5) / 1000, atol=1e-12)


def test_a_camera_that_sees_nothing_for_a_while_leaves_a_long_window(tmp_path):
    fast = np.arange(0, 6, 0.02)
    rows = [
        (t, *angle(t), *(pose(t) if t < 2.0 or t > 4.0 else (None,) * 3)) for t in fast.tolist()
    ]
    csv(tmp_path / "run.csv", ["t", "left", "right", "x", "y", "yaw"], rows)
    w = windows(one(tmp_path, ONE_FILE), RADIUS, longest=0.5)
    edges = w.pose[:, :, 1] / 0.02
    assert not ((edges > 2.0) & (edges < 4.0)).any()
    np.testing.assert_allclose(w.turn, np.diff(angle(edges), axis=1), atol=5e-4)


def beside(root, epoch=0.0, quaternion=False):
    """Write a folder a run: joint states at 100 Hz, poses at 30 Hz, currents at 10 Hz."""
    t = np.arange(0, 6, 0.01)
    csv(root / "joint_states.csv", ["stamp", "l", "r"], [((epoch + s) * 1e9, *angle(s)) for s in t])
    # printing nanoseconds since 1970 with nine digits would round them
    lines = (root / "joint_states.csv").read_text().splitlines()
    stamps = [f"{round((epoch + s) * 1e9):d}" for s in t]
    lines[1:] = [
        ",".join([n, *line.split(",")[1:]]) for n, line in zip(stamps, lines[1:], strict=True)
    ]
    (root / "joint_states.csv").write_text("\n".join(lines))
    t = np.arange(0.003, 6, 1 / 30)
    p = pose(t)
    half = p[:, 2] / 2
    turned = [np.zeros_like(t), np.zeros_like(t), np.sin(half), np.cos(half)]
    columns = [p[:, 0] * 1000, p[:, 1] * 1000, *(turned if quaternion else [np.degrees(p[:, 2])])]
    names = ["x", "y", *(["qx", "qy", "qz", "qw"] if quaternion else ["yaw"])]
    rows = [(s, *row) for s, row in zip(t, np.stack(columns, 1), strict=True)]
    csv(root / "mocap.csv", ["t", *names], rows)
    if epoch:
        text = (root / "mocap.csv").read_text().splitlines()
        text[1:] = [
            f"{epoch + s:.6f}," + row.partition(",")[2] for s, row in zip(t, text[1:], strict=True)
        ]
        (root / "mocap.csv").write_text("\n".join(text))


def layout_beside(quaternion=False):
    turned = (
        {"pose_quaternion": {"columns": ["qx", "qy", "qz", "qw"], "unit": "1"}}
        if quaternion
        else {"pose_heading": {"column": "yaw", "unit": "deg"}}
    )
    return {
        "columns": {
            "time": {"column": "stamp", "unit": "ns"},
            "wheel_angle": {"columns": ["l", "r"], "unit": "rad"},
        },
        "beside": {
            "mocap.csv": {
                "columns": {
                    "time": {"column": "t", "unit": "s"},
                    "pose_x": {"column": "x", "unit": "mm"},
                    "pose_y": {"column": "y", "unit": "mm"},
                    **turned,
                }
            }
        },
    }


@pytest.mark.parametrize("epoch", [0.0, 1_721_300_000.0])
@pytest.mark.parametrize("quaternion", [False, True])
def test_files_beside_each_other_are_one_run(tmp_path, epoch, quaternion):
    beside(tmp_path / "run1", epoch, quaternion)
    data = one(tmp_path, layout_beside(quaternion), "*/joint_states.csv")
    assert data.time[0] == 0.0
    np.testing.assert_allclose(data.pose[data.fresh], pose(data.time[data.fresh]), atol=2e-6)
    np.testing.assert_allclose(data.wheel_angle, angle(data.time) - angle(0.0), atol=2e-4)


def test_a_file_that_should_lie_beside_is_named_with_what_does(tmp_path):
    beside(tmp_path / "run1")
    (tmp_path / "run1" / "mocap.csv").rename(tmp_path / "run1" / "camera.csv")
    with pytest.raises(DataError, match=r"mocap.csv: missing.*the folder has camera.csv"):
        one(tmp_path, layout_beside(), "*/joint_states.csv")


def test_clocks_that_do_not_overlap_are_refused(tmp_path):
    beside(tmp_path / "run1", 0.0)
    beside(tmp_path / "run2", 1_721_300_000.0)
    (tmp_path / "run2" / "mocap.csv").replace(tmp_path / "run1" / "mocap.csv")
    with pytest.raises(
        DataError, match=r"no pose while the wheels were measured.*times of both counted"
    ):
        one(tmp_path, layout_beside(), "run1/joint_states.csv")


def test_a_channel_in_two_files_is_refused():
    layout = layout_beside()
    layout["beside"]["mocap.csv"]["columns"]["wheel_angle"] = WHEELS
    with pytest.raises(DataError, match="channel 'wheel_angle' is in two files"):
        declared_layout(layout, "test")


@pytest.mark.parametrize("order", [["qx", "qy", "qz"], ["qx", "qy", "qz", "qw", "x"]])
def test_a_quaternion_has_four_columns(order):
    layout = layout_beside(quaternion=True)
    channel = {"columns": order, "unit": "1"}
    layout["beside"]["mocap.csv"]["columns"]["pose_quaternion"] = channel
    with pytest.raises(DataError, match="expected four: x, y, z and w"):
        declared_layout(layout, "test")


def test_the_heading_of_a_tilted_body_is_where_it_points():
    tilt = np.random.default_rng(0).uniform(-0.4, 0.4, (12, 2))
    turned = Rotation.from_euler("ZYX", np.column_stack([np.linspace(-3.0, 3.0, 12), tilt]))
    source = SignalSource(Path("mocap.csv"), ("qx", "qy", "qz", "qw"), np.arange(12))
    found = heading(Signal(np.arange(12.0), turned.as_quat(), source))
    ahead = turned.apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(found.values[:, 0], np.arctan2(*ahead.T[1::-1]), atol=1e-12)


def test_numbers_that_are_no_quaternion_are_refused(tmp_path):
    beside(tmp_path / "run1", quaternion=True)
    layout = layout_beside(quaternion=True)
    channel = {"columns": ["x", "y", "qz", "qw"], "unit": "1"}
    layout["beside"]["mocap.csv"]["columns"]["pose_quaternion"] = channel
    with pytest.raises(DataError, match="a quaternion of length"):
        one(tmp_path, layout, "*/joint_states.csv")


# sensors that are slower than the rows they are logged in -------------------------------------


def held(period_rows, rows=600, seed=0, change=1.0):
    """Return values that are read anew every few rows and repeated between."""
    rng = np.random.default_rng(seed)
    fresh = np.cumsum(change * rng.normal(size=rows // period_rows + 1))
    return np.repeat(fresh, period_rows)[:rows]


def test_a_slow_sensor_is_told_from_one_that_repeats_itself_by_chance():
    time, rng = 0.05 * np.arange(600), np.random.default_rng(0)
    assert refresh_period([(time, held(5))]) == pytest.approx(0.25)
    assert readings(time, held(5)).sum() == 120
    quantised = np.round(rng.normal(0.4, 0.03, 600) * 39) / 39  # repeats two times in three
    assert refresh_period([(time, quantised)]) is None
    assert readings(time, quantised).all()
    assert refresh_period([(time, np.ones(600))]) is None


def test_a_slow_sensor_that_reads_the_same_again_was_read_again():
    time, value = 0.05 * np.arange(600), held(5)
    value[100:200] = value[100]
    assert readings(time, value).sum() == pytest.approx(120, abs=1)


def test_a_slow_ammeter_counts_once_a_reading(tmp_path):
    """At 1 Hz in rows of 20 Hz the noise averages over one reading a second and not over twenty."""
    rng = np.random.default_rng(1)
    columns = {**ONE_FILE["columns"], "current": {"columns": ["i1", "i2"], "unit": "A"}}
    names = ["t", "left", "right", "i1", "i2", "x", "y", "yaw"]
    for k in range(12):
        t = 0.05 * np.arange(120)
        amps = np.repeat(rng.normal(1.0, 0.1, (6, 2)), 20, axis=0)
        rows = np.concatenate([t[:, None], angle(t), amps, pose(t)], axis=1)
        csv(tmp_path / f"run{k:02d}.csv", names, rows.tolist())
    data = one(tmp_path, {"columns": columns})
    assert data.current_fresh.sum(axis=0) == pytest.approx([72, 72], abs=2)
    assert "current is refreshed every 1 s" in " ".join(data.logs[0].notes)
    w = windows(data, RADIUS, per_segment=2, longest=3.0)
    read = w.current_var < UNREAD_VARIANCE
    assert np.median(w.current_var[read]) == pytest.approx(0.01 / 2.5, rel=0.5)
    short = windows(data, RADIUS, longest=0.25)
    assert (short.current_var == UNREAD_VARIANCE).mean() == pytest.approx(0.75, abs=0.1)


# poses that jump ------------------------------------------------------------------------------


def test_a_run_whose_pose_jumps_is_set_aside_by_name(tmp_path):
    for k in range(3):
        sparse(tmp_path / f"run{k}.csv")
    path = tmp_path / "run1.csv"
    lines = path.read_text().splitlines()
    at = next(n for n, line in enumerate(lines[200:], start=200) if not line.endswith(",,"))
    cells = lines[at].split(",")
    cells[3] = f"{float(cells[3]) + 0.8}"
    lines[at] = ",".join(cells)
    path.write_text("\n".join(lines))
    data = one(tmp_path, ONE_FILE)
    assert [log.name for log in data.logs] == ["run0.csv", "run2.csv"]
    assert len(data.aside) == 1
    assert f"run1.csv row {at + 1}, column 'x': the pose jumps by 0.8" in data.aside[0]
    with pytest.raises(DataError, match=r"set aside: .*run1.csv.*the pose jumps"):
        one(tmp_path, ONE_FILE, "run1.csv")


def test_runs_of_two_sets_keep_what_was_set_aside(tmp_path):
    sparse(tmp_path / "a" / "run.csv")
    sparse(tmp_path / "b" / "run.csv")
    both = one(tmp_path, ONE_FILE, "a/*.csv") + one(tmp_path, ONE_FILE, "b/*.csv")
    assert both.aside == ()
    assert len(both) == 2


def test_real_skid_steer_logs_are_read_and_wild_poses_set_aside(real_data):
    from slipid.app.config import read_config
    from slipid.app.logs import read_dataset
    from slipid.support.progress import Reporter

    config = read_config(Path("configs/husky.toml"))
    with Reporter(quiet=True) as report:
        data, skipped = read_dataset(config, config.content.logs, real_data / "drive_skid", report)
    assert len(data) + len(data.aside) == 40
    assert len(data.aside) == 21
    assert all("the pose jumps by" in line for line in skipped)
    layout = declared_layout(config.content.layouts["skid"], "husky")
    path = real_data / "drive_skid" / "husky_wetgrass" / "step_01.csv"
    found = read_logs(path, layout, real_data, "wet_grass", "as_built")
    assert not found.logs
    assert "husky_wetgrass/step_01.csv row" in found.aside[0]


def test_a_missing_reading_is_the_last_one(tmp_path):
    """Also where all other readings come with those of the encoders."""
    t = np.arange(0, 2.0, 0.05)
    rows = [[x, *angle(x), *pose(x), x, 2 * x] for x in t]
    rows[7][-1] = None
    csv(tmp_path / "run.csv", ["t", "left", "right", "x", "y", "yaw", "u1", "u2"], rows)
    columns = {**ONE_FILE["columns"], "voltage": {"columns": ["u1", "u2"], "unit": "V"}}
    data = one(tmp_path, {"columns": columns})
    expected = np.stack([t, 2 * t], axis=1)
    expected[7, 1] = expected[6, 1]
    np.testing.assert_allclose(data.voltage, expected, atol=1e-8)
    assert not data.voltage_fresh[7, 1]
