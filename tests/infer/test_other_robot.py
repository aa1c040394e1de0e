"""Another robot's real logs: geometry found on joystick runs predicts squares and circles."""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.app.config import read_config
from slipid.app.logs import read_dataset
from slipid.app.problem import read_fit_task
from slipid.fitting import likelihood as lk
from slipid.fitting.optimise import optimise
from slipid.infer.summary import summarise
from slipid.predict import open_loop as replay
from slipid.support.progress import Reporter

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "omni3.toml"
NOMINAL = {"wheel_radius": 0.051, "base_radius": 0.195}


LEAST_SQUARES = 0.0505
"""Mean error of least squares of radii, base radius, lag and marker place on the same runs [m]."""


def end_errors(robot, data) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of predicted and tracked end of every run, and its path length [m]."""
    error, length = np.zeros(len(data)), np.zeros(len(data))
    for w in replay.replay_windows(data, robot):
        step = np.asarray(replay.contact_increments(robot, lk.batch(w, robot)))
        track = replay.tracks_from_increments(robot, w, step)
        length[track.run] = np.linalg.norm(np.diff(track.measured[..., :2], axis=1), axis=-1).sum(1)
        error[track.run] = np.linalg.norm(track.gap[:, :2], axis=1)
    return error, length


@pytest.mark.slow
def test_radii_from_joystick_runs_predict_squares_and_circles(real_data):
    root = real_data / "omni3_optitrack"
    if not root.is_dir():
        pytest.skip(f"no logs of the second robot: {root} is no folder")
    config = read_config(CONFIG)
    job = read_fit_task(config, root, Reporter(quiet=True))
    problem = job.problem()
    fit = summarise(problem, optimise(problem), job.dataset, job.choices)
    assert fit.converged
    for name, nominal in NOMINAL.items():
        found = fit.parameters[f"robot.{name}"]
        assert found.ratio < 0.35  # two recordings, which do not agree as well as runs of one do
        assert not found.interval90[0] < nominal < found.interval90[1]
    unseen, _ = read_dataset(config, config.content.validate_.logs, root, Reporter(quiet=True))
    nominal = eqx.tree_at(  # by the metadata, everything else at its start
        lambda r: (r.geometry.wheel_radius, r.geometry.base_radius),
        fit.space.template,
        tuple(jnp.asarray(v) for v in NOMINAL.values()),
    )
    (before, _), (after, length) = end_errors(nominal, unseen), end_errors(fit.robot, unseen)
    print(
        "end error [m], nominal:", before.round(4), "identified:", after.round(4), "path:", length
    )
    assert (after < before).all()
    assert after.mean() < LEAST_SQUARES
    assert np.mean(after / length) < 0.5 * np.mean(before / length)
