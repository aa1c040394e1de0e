"""Runs as methods get them: signals, and true poses of the body."""

from dataclasses import replace

import numpy as np
import pytest

from slipid.api.runs import simulate_runs, steady_motion
from slipid.data.runs import collect
from slipid.lab.benchmark.slipid_rows import turned_covariance
from slipid.lab.benchmark.steps import run_batches
from slipid.predict.slip_model import relative_to_start


@pytest.fixture(scope="module")
def made():
    return simulate_runs(("firm", "soft"), headings=4, turns=0, seed=3)


def test_every_run_is_there_once_in_equally_many_steps(made):
    batches = run_batches(made.runs, made.robot)
    numbers = [k for one in batches for k in one.numbers]
    assert sorted(numbers) == list(range(len(made.runs)))
    steps = {len(run.signals) for one in batches for run in one.runs}
    assert len(steps) <= 2
    assert all(n & (n - 1) == 0 for n in steps)


def test_it_moves_as_the_robot_that_drove_it(made):
    for one in run_batches(made.runs, made.robot):
        for k, run in zip(one.numbers, one.runs, strict=True):
            log = made.runs.logs[k]
            assert log.surface == run.floor
            assert run.signals.floor is None
            steady = run.signals.speed[len(run.signals) // 2 :].mean(axis=0)
            command = steady * 0.04 @ np.asarray(made.robot.geometry.pseudo_inverse()).T
            expected = steady_motion(made.robot, str(log.surface), command[None]).twist[0]
            found = run.twist[len(run.signals) // 2 :].mean(axis=0)
            assert found[:2] == pytest.approx(expected[:2], abs=0.015)


def test_the_load_is_given_and_gyro_and_command_are_means_over_each_step(made):
    logs = [
        replace(
            log,
            load="heavy",
            gyro=3.0 * log.time,
            twist_command=np.tile([0.1, 0.2, 0.3], (log.samples, 1)),
        )
        for log in made.runs.logs
    ]
    one = run_batches(collect(logs), made.robot)[0]
    signals = one.runs[0].signals
    assert signals.load == one.runs[0].load == "heavy"
    assert signals.command is not None
    assert signals.command == pytest.approx(np.tile([0.1, 0.2, 0.3], (len(signals), 1)))
    # in the time of the wheels, which the camera lags
    lag = float(made.robot.camera.lag)
    middle = one.windows.start[0] + np.cumsum(signals.dt) - 0.5 * signals.dt - lag
    assert signals.gyro is not None
    assert signals.gyro[1:] == pytest.approx(3.0 * middle[1:], abs=0.01)


def test_a_start_anywhere_is_the_origin():
    path = np.array([[1.0, 2.0, np.pi / 2], [1.0, 3.0, np.pi]])
    assert relative_to_start(path) == pytest.approx(np.array([[0, 0, 0], [1, 0, np.pi / 2]]))
    turned = turned_covariance(np.diag([4.0, 1.0]), -np.pi / 2)
    assert turned == pytest.approx(np.diag([1.0, 4.0]))
