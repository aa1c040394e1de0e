"""How far runs scatter, found before anything is fitted."""

from dataclasses import replace

import numpy as np
import pytest

from slipid.fitting.problem import Problem
from slipid.predict.agreement import scatter
from slipid.search_space import Choice
from tests.helpers.made_windows import made
from tests.helpers.made_windows import robot as made_robot

ROBOT = made_robot(sessions=("one",))
KINDS = ("process", "run")
AXES = ("along", "across", "yaw")
NOISY = {
    **{f"process.soft.{axis}": std for axis, std in zip(AXES, (0.05, 0.03, 0.2), strict=True)},
    **{f"run.soft.{axis}": std for axis, std in zip(AXES, (0.1, 0.1, 0.4), strict=True)},
}


def found(w, choices=()):
    problem = Problem(w, ROBOT, list(choices))
    std = np.exp(0.5 * scatter(problem))
    typical = dict(zip(problem.noise.names, problem.noise.typical.tolist(), strict=True))
    return dict(zip(problem.noise.names, std.tolist(), strict=True)), typical


@pytest.mark.slow
def test_noise_is_found_where_it_is_and_what_is_typical_elsewhere():
    std, typical = found(made(ROBOT, runs=192, count=4, seed=1, std=NOISY))
    for name, true in NOISY.items():
        assert 0.8 < std[name] / true < 1.6, name  # of runs that others predict
        # what a smooth function leaves of the slip of a quiet floor counts as its noise
        quiet = name.replace("soft", "firm")
        assert 0.999 * typical[quiet] < std[quiet] < 0.5 * true, quiet
    for name in std:
        if name.split(".")[0] not in KINDS:
            assert std[name] == pytest.approx(typical[name])


@pytest.mark.slow
def test_runs_too_few_to_be_predicted_from_each_other_scatter_far():
    w = made(ROBOT, runs=192, count=4, seed=1, std=NOISY)
    few = w.segments(np.flatnonzero(np.asarray(w.surface) == "soft")[:3])
    assert found(few)[0]["run.soft.along"] > 0.1
    alone = replace(few, surface=("firm",) * len(few)).segments(np.array([0]))
    assert np.isfinite(list(found(alone)[0].values())).all()


@pytest.mark.slow
def test_where_a_robot_stands_the_noise_of_the_camera_is_no_scatter():
    w = made(ROBOT, runs=96, count=4, seed=2, std=NOISY)
    moving = found(w)[0]
    rng, stands = np.random.default_rng(0), np.arange(0, len(w), 2)
    turn, speed_change, pose = w.turn.copy(), w.speed_change.copy(), w.pose.copy()
    turn[stands, 3], speed_change[stands, 3] = 1e-5, 0.0
    pose[stands, 4] = pose[stands, 3] + rng.normal(0, [5e-4, 5e-4, 3e-3], (len(stands), 3))
    standing = found(replace(w, turn=turn, speed_change=speed_change, pose=pose))[0]
    for name in NOISY:
        assert standing[name] < 1.4 * moving[name], name


@pytest.mark.slow
def test_a_marker_whose_place_is_unknown_is_no_scatter_of_turning_runs():
    w = made(ROBOT, runs=96, count=4, seed=2, std=NOISY)
    place = np.array([0.12, -0.09])
    c, s = np.cos(w.pose[..., 2]), np.sin(w.pose[..., 2])
    moved = np.stack([c * place[0] - s * place[1], s * place[0] + c * place[1]], -1)
    pose = w.pose.copy()
    pose[..., :2] += moved
    off = replace(w, pose=pose)
    free = (Choice("camera.marker_place", free=True),)
    names = ("run.firm.along", "run.firm.across")
    before, known = found(w, free)[0], found(off, free)[0]
    held = found(off)[0]
    for name in names:
        assert known[name] < 1.2 * before[name], name
        assert held[name] > 2.0 * known[name], name
