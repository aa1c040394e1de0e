from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.data.reading.presets import declared_layout
from slipid.data.reading.reader import find_logs
from slipid.data.runs import collect, default_session
from slipid.data.windows import windows
from slipid.fitting.likelihood import batch
from slipid.fitting.noise import noise
from slipid.infer.design.planned_runs import PlannedRun
from slipid.lab.selftest.logs import (
    TRUTH,
    SimulatedSensors,
    heading_grid,
    simulate_logs,
    true_robot,
)
from tests.helpers.made_logs import LAYOUT, write_logs
from tests.helpers.made_windows import electric_noise, residuals
from tests.helpers.one_log import read_log

SETUPS = (("firm", "as_built"), ("soft", "as_built"), ("soft", "moved"))
PLAN = heading_grid(SETUPS, headings=4, turns=2)
ROBOT = true_robot(PLAN)
STILL = dict.fromkeys(SimulatedSensors().std, 0.0)


@jax.jit
def gaps(robot, b):
    return residuals(robot, b, electric_noise(b, jnp.ones(())))


def at_truth(robot, plan, seed, sensors):
    cut = windows(collect(simulate_logs(robot, plan, seed, sensors)), 0.04, float(robot.camera.lag))
    return cut, {k: np.asarray(v) for k, v in gaps(robot, batch(cut, robot)).items()}


@pytest.fixture(scope="module")
def logs():
    return simulate_logs(ROBOT, PLAN, seed=3)


def test_plan_covers_every_setting_once():
    assert len(PLAN) == 3 * 2 * (4 + 2)
    assert len(set(PLAN)) == len(PLAN)
    assert {d.load for d in PLAN} == {"as_built", "moved"}


@pytest.mark.slow
def test_seed_decides_everything(logs):
    again = simulate_logs(ROBOT, PLAN, seed=3)
    other = simulate_logs(ROBOT, PLAN, seed=4)
    for a, b, c in zip(logs, again, other, strict=True):
        assert a.sha256 == b.sha256 != c.sha256
        np.testing.assert_array_equal(a.current, b.current)
        assert np.abs(a.pose[-1] - c.pose[-1]).max() > 1e-4


@pytest.mark.slow
def test_logs_have_the_traps_of_real_ones(logs):
    log = logs[0]
    assert not log.current_is_signed
    assert log.current.min() >= 0
    for steps in (log.current * 39, log.voltage * 10):
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    turn = 2000 * 16 / (2 * np.pi)
    np.testing.assert_allclose(log.wheel_angle * turn, np.round(log.wheel_angle * turn), atol=1e-6)
    stale = ~log.pose_fresh
    assert 0.02 < np.mean([(~x.pose_fresh).mean() for x in logs]) < 0.2
    np.testing.assert_array_equal(np.diff(log.pose, axis=0)[stale[1:]], 0.0)
    assert np.median(np.diff(log.time)) == pytest.approx(0.031, rel=0.02)
    assert np.std(np.diff(log.time)) > 1e-3
    start = log.time[np.argmax(np.abs(log.wheel_angle).max(axis=1) > 0.01)]
    assert 0.12 < start < 0.35


@pytest.mark.slow
def test_sessions_are_those_a_dataset_finds(logs):
    assert [default_session(log) for log in logs] == [d.session for d in PLAN]
    assert set(ROBOT.camera.sessions) == {d.session for d in PLAN}


@pytest.mark.slow
def test_without_noise_the_likelihood_has_no_residual():
    fine = SimulatedSensors(
        std=STILL,
        ripple=0.0,
        voltage_noise=0.0,
        current_step=1e-9,
        voltage_step=1e-9,
        ticks=10**9,
        wobble=0.0,
    )
    cut, gap = at_truth(ROBOT, PLAN, 0, fine)
    straight = np.array([PLAN[k].turn == 0 for k in cut.run])
    n = len(cut)
    motion = np.abs(gap["motion"].reshape(n, 4, 3))
    # the start of a run creeps, so windows after the first are the exact ones
    assert motion[straight][:, 1:].max() < 2e-6
    assert motion[:, 1:].max() < 2e-4  # turning: a window's mean wheel speed hides the shape
    turning = cut.turn != 0
    amps = gap["current"].reshape(n, 4, 3)[:, 1:]
    strong = cut.current[:, 1:] > 0.2
    assert np.abs(amps[strong]).max() < 3e-3  # sqrt(I^2 + 0.03^2) - I
    volts = gap["voltage"].reshape(n, 4, 3)[:, 1:]
    assert np.abs(volts[strong & turning[:, 1:]]).max() < 2e-2


@pytest.mark.slow
def test_scatter_of_increments_is_the_likelihoods_covariance():
    """Whitened with the true variances, residuals at the truth have unit variance."""
    sensors = SimulatedSensors()
    one = [PlannedRun("soft", "as_built", h, 0.1) for h in np.linspace(0.1, 6, len(PLAN))]
    cut, gap = at_truth(ROBOT, one, 11, sensors)
    n = noise(cut, ROBOT)
    v = np.array([sensors.of(m) ** 2 if of_motion(m) else 0.0 for m in n.names])
    root = np.linalg.cholesky(np.asarray(n.blocks["motion"].covariance(jnp.log(v))))
    white = np.linalg.solve(root, gap["motion"][..., None])[..., 0]
    count = white.size
    assert white.var() == pytest.approx(1.0, abs=4 * np.sqrt(2 / count))
    assert abs(white.mean()) < 4 / np.sqrt(count)
    corr = np.corrcoef(white.T) - np.eye(white.shape[1])
    assert np.abs(corr).max() < 5 / np.sqrt(len(white))


def of_motion(name):
    return name.startswith(("camera", "process", "run"))


@pytest.mark.slow
def test_files_read_back_as_they_were_made(logs, tmp_path):
    paths = write_logs(logs, ROBOT, tmp_path / "data", tmp_path / "apart")
    assert paths == [tmp_path / "data" / log.name for log in logs]
    assert set(find_logs(tmp_path / "data", "**/*")) == set(paths)
    layout = declared_layout(LAYOUT, "made")
    for path, log in list(zip(paths, logs, strict=True))[::7]:
        back = read_log(path, layout, root=tmp_path / "data", surface=log.surface, load=log.load)
        assert back.name == log.name
        np.testing.assert_allclose(back.time, log.time, atol=6e-5)
        np.testing.assert_allclose(back.wheel_angle, log.wheel_angle, atol=1e-9)
        np.testing.assert_allclose(back.current, log.current, atol=6e-5)
        np.testing.assert_allclose(back.voltage, log.voltage, atol=1e-9)
        np.testing.assert_allclose(back.pose, log.pose, atol=2e-6)
        np.testing.assert_allclose(back.twist_command, log.twist_command, atol=6e-5)
        np.testing.assert_array_equal(back.pose_fresh, log.pose_fresh)


def test_truth_is_written_apart_and_complete(logs, tmp_path):
    write_logs(logs[:1], ROBOT, tmp_path / "data", tmp_path / "apart")
    kept = json.loads((tmp_path / "apart" / "truth.json").read_text())["parameters"]
    assert kept["motor.resistance"] == {"value": 5.5, "unit": "ohm"}
    for path, value in TRUTH.items():
        np.testing.assert_allclose(kept[path]["value"], value, rtol=1e-12)
    assert not list((tmp_path / "data").rglob("*.json"))
