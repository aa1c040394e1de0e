"""Steps of open-loop predictions are as short as the wheels of a run demand."""

from pathlib import Path

import numpy as np
import pytest

from slipid.data.log import Log
from slipid.data.runs import collect
from slipid.model.geometry import differential
from slipid.model.robot import build
from slipid.predict import open_loop as replay
from slipid.predict.kinematics import nominal
from slipid.predict.selection import path_errors
from slipid.predict.slip_model import path_of
from slipid.predict.slip_models import FloorModels

SHAPE = differential(0.15, 0.05)
STEP = 0.02


def log(name, ahead, yaw_rate):
    """A run without slip at some speeds [m/s] and yaw rates [rad/s], with a pose every second."""
    twist = np.stack([ahead, 0 * ahead, yaw_rate], 1)
    rows = len(twist) + 1
    turn = twist @ np.asarray(SHAPE.forward()).T / 0.05 * STEP
    return Log(
        name=name,
        path=Path(name),
        sha256=name,
        time=STEP * np.arange(rows),
        wheel_angle=np.concatenate([np.zeros((1, 2)), np.cumsum(turn, axis=0)]),
        pose=path_of(twist, np.full(len(twist), STEP)),
        pose_fresh=np.arange(rows) % 50 == 0,
        surface="floor",
        load="as_built",
        current_is_signed=True,
    )


@pytest.fixture(scope="module")
def runs():
    t = STEP * np.arange(1600)
    turns = np.sin(2 * np.pi * t / 1.7) > 0  # ahead, then on the spot, at times of their own
    bent = log("bent", np.where(turns, 0.0, 0.4), np.where(turns, 1.2, 0.0))
    return collect([bent, log("straight", np.full(1600, 0.3), np.zeros(1600))])


def errors(w, robot):
    model = FloorModels(nominal(SHAPE))
    tracks = replay.tracks_from_increments(robot, w, model.increments(w, robot))
    return dict(zip(tracks.run.tolist(), path_errors(tracks, w.parts), strict=True))


def test_steps_in_which_wheels_change_their_speeds_are_divided(runs):
    """With a step from pose to pose the same model is off by more than a hundredth."""
    robot = build(SHAPE, ["floor"])
    cut = replay.replay_windows(runs, robot)
    parts = {int(k): w.parts for w in cut for k in w.run}
    assert parts[0] >= 4
    assert parts[1] == 1
    found = {k: error for w in cut for k, error in errors(w, robot).items()}
    assert found[0] < 0.002
    assert found[1] < 1e-6
    (whole,) = replay.whole_runs(runs.subset([0]), robot, [16])
    assert errors(whole, robot)[0] > 0.01


def test_parts_of_a_window_add_up_to_it(runs):
    robot = build(SHAPE, ["floor"])
    whole, parts = (replay.whole_runs(runs.subset([0]), robot, [8], [count])[0] for count in (1, 4))
    together = parts.turn.reshape(*whole.turn.shape[:2], 4, 2).sum(axis=2)
    np.testing.assert_allclose(together, whole.turn, atol=1e-12)
    np.testing.assert_allclose(parts.dt.reshape(*whole.dt.shape, 4).sum(axis=2), whole.dt)
    np.testing.assert_allclose(parts.pose[:, ::4], whole.pose, atol=1e-12)
