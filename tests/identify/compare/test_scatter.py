"""How far runs scatter, found before anything is fitted."""

from dataclasses import replace

import numpy as np
import pytest

from slipid.identify.compare.scatter import scatter
from slipid.identify.fit.problem import Problem
from tests.helpers.made_windows import made
from tests.helpers.made_windows import robot as made_robot

ROBOT = made_robot(sessions=("one",))
KINDS = ("process", "run")
AXES = ("along", "across", "yaw")
NOISY = {
    **{f"process.soft.{axis}": std for axis, std in zip(AXES, (0.05, 0.03, 0.2), strict=True)},
    **{f"run.soft.{axis}": std for axis, std in zip(AXES, (0.1, 0.1, 0.4), strict=True)},
}


def found(w):
    problem = Problem(w, ROBOT, [])
    std = np.exp(0.5 * scatter(problem))
    typical = dict(zip(problem.noise.names, problem.noise.typical.tolist(), strict=True))
    return dict(zip(problem.noise.names, std.tolist(), strict=True)), typical


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


def test_runs_too_few_to_be_predicted_from_each_other_scatter_far():
    w = made(ROBOT, runs=192, count=4, seed=1, std=NOISY)
    few = w.pieces(np.flatnonzero(np.asarray(w.surface) == "soft")[:3])
    assert found(few)[0]["run.soft.along"] > 0.1
    alone = replace(few, surface=("firm",) * len(few)).pieces(np.array([0]))
    assert np.isfinite(list(found(alone)[0].values())).all()
