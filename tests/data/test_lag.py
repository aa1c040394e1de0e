"""The lag of poses is found from the motion itself, whatever signs and sizes are."""

from pathlib import Path

import numpy as np
import pytest

from slipid.data.align.lag import pose_lag
from slipid.data.log import Log
from slipid.data.runs import collect

RATE = 50.0


def run(lag, seed, wheels=2, steady=False, rolling=0.05, noise=0.0005):
    """Return a run of a robot that changes its speed and turns, with poses `lag` seconds late."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 6.0, 1 / RATE)
    knots = np.linspace(-4.0, 10.0, 15)
    speeds = rng.uniform(-6.0, 6.0, (15, wheels)) * (knots > 0.2)[:, None]
    if steady:
        speeds[:] = speeds[-1]

    def angle(t):
        fine = np.linspace(-4.0, 10.0, 1401)
        rate = np.stack([np.interp(fine, knots, column) for column in speeds.T], axis=1)
        whole = np.concatenate([np.zeros((1, wheels)), np.cumsum(rate[1:] * 0.01, axis=0)])
        return np.stack([np.interp(t, fine, column) for column in whole.T], axis=1)

    shown = angle(time - lag)
    ahead = rolling * shown.mean(axis=1)
    yaw = 0.3 * rolling * (shown[:, -1] - shown[:, 0])
    step = np.diff(ahead, prepend=ahead[0])
    x, y = np.cumsum(step * np.cos(yaw)), np.cumsum(step * np.sin(yaw))
    pose = np.stack([x, y, yaw], axis=1) + rng.normal(0.0, noise, (len(time), 3))
    turned = angle(time)
    return Log(
        name=f"run{seed}.csv",
        path=Path(f"run{seed}.csv"),
        sha256="0" * 64,
        time=time,
        wheel_angle=turned - turned[0],
        current_is_signed=True,
        pose=pose,
        pose_fresh=np.arange(len(time)) % 2 == 0,
        surface="floor",
        load="as_built",
    )


@pytest.mark.parametrize("lag", [-1.3, -0.2, 0.0, 0.08, 0.6, 2.1])
def test_a_lag_of_seconds_is_found(lag):
    found = pose_lag(collect([run(lag, seed) for seed in range(6)]))
    assert found is not None
    assert found.seconds == pytest.approx(lag, abs=0.02)
    if lag:
        assert found.unexplained < found.unexplained_at_zero


@pytest.mark.parametrize("rolling", [-0.05, 50.0])
def test_signs_and_units_do_not_matter(rolling):
    found = pose_lag(collect([run(0.4, seed, rolling=rolling, noise=0.0) for seed in range(4)]))
    assert found is not None
    assert found.seconds == pytest.approx(0.4, abs=0.02)


def test_slow_poses_of_a_robot_with_three_wheels_give_it_too():
    logs = [run(0.3, seed, wheels=3) for seed in range(4)]
    found = pose_lag(collect(logs))
    assert found is not None
    assert found.seconds == pytest.approx(0.3, abs=0.03)


@pytest.mark.parametrize("lacking", [[2], [0, 1]], ids=["positions", "headings"])
def test_positions_or_headings_alone_give_it_too(lacking):
    """Positions show only speed, which must therefore change; poses of the ends do not disturb."""
    logs = [run(0.4, seed) for seed in range(6)]
    for log in logs[:5]:
        log.pose[:, lacking] = np.nan
    logs[5].pose_fresh[1:-1] = False
    found = pose_lag(collect(logs))
    assert found is not None
    assert found.decisive
    assert found.seconds == pytest.approx(0.4, abs=0.02)


def test_steady_motion_gives_no_lag():
    assert pose_lag(collect([run(0.4, seed, steady=True) for seed in range(3)])) is None


def test_it_is_searched_once_for_a_set_of_runs():
    data = collect([run(0.4, seed) for seed in range(4)])
    assert pose_lag(data) is pose_lag(data)


@pytest.mark.slow
def test_real_robots_have_the_lag_of_each_day(real_data):
    from slipid.app.config import read_config
    from slipid.app.logs import read_dataset
    from slipid.support.progress import Reporter

    config = read_config(Path("configs/warthog.toml"))
    with Reporter(quiet=True) as report:
        data, _ = read_dataset(config, config.content.logs, real_data / "drive_skid", report)
    for day in ("2024_7_18", "2024_7_29"):
        found = pose_lag(data.subset(k for k, log in enumerate(data.logs) if day in log.name))
        assert found is not None
        assert 0.2 < found.seconds < 0.4
