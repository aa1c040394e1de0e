"""Windows are cut again where the fitted lag differs from the lag they were cut at."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from slipid.app import identify, sample
from slipid.app.config import FitSection
from slipid.app.problem import RECUT_LAG_S, FitTask
from slipid.fitting.optimise import Optimum
from slipid.fitting.problem import FitState
from slipid.model.robot import build
from slipid.search_space import Choice
from slipid.support.progress import Reporter
from tests.helpers.kinds import SHAPES, experiment

EXPECTED = 0.05
"""Lag at which a fit starts [s]."""


@pytest.fixture(scope="module")
def task():
    made = experiment("differential", headings=2)
    robot = build(SHAPES["differential"], ["firm", "soft"], ("as_built",), made.data.session)
    lag = Choice("camera.lag", prior_mean=EXPECTED, prior_std=0.1, free=True)
    return FitTask(made.data, robot, (lag,), FitSection())


def at_lag(task, lag):
    return replace(task.robot, camera=replace(task.robot.camera, lag=jnp.asarray(lag)))


@pytest.mark.slow
@pytest.mark.parametrize(("off", "moves"), [(0.9 * RECUT_LAG_S, False), (1.1 * RECUT_LAG_S, True)])
def test_windows_are_cut_at_the_expected_lag_unless_the_fitted_one_is_far_from_it(task, off, moves):
    found = task.problem(at_lag(task, EXPECTED + off)).windows
    lag = EXPECTED + off * moves
    assert found.lag == pytest.approx(lag)
    assert (found.turn == task.windows(at_lag(task, lag)).turn).all()


@pytest.mark.slow
def test_a_fit_goes_on_with_windows_at_the_lag_it_found(task, monkeypatch):
    problem, fitted = task.problem(), []

    def fit(task, problem, before, kept, report):
        """Finds a lag of 0.12 s, whatever the windows are."""
        fitted.append((problem.windows.lag, before[0]))
        z = np.array(problem.space.start)
        z[problem.space.slices["camera.lag"]] += 0.12 - EXPECTED
        shared = np.ones((len(problem.windows), 3))
        state = FitState(z, np.zeros(len(problem.noise.names)), 9, 1.0, 0.001, "joint", shared)
        return Optimum(state, np.eye(len(z)), True, "settled", (1.0,))

    monkeypatch.setattr(identify, "_optimised", fit)
    with Reporter(quiet=True) as report:
        again, optimum = identify.optimised(task, problem, None, report)
    lags, starts = zip(*fitted, strict=True)
    assert lags == pytest.approx((EXPECTED, 0.12))
    assert starts[0] is None
    assert (starts[1].z == optimum.state.z).all()
    assert starts[1].round < optimum.state.round
    assert starts[1].effect is None  # other windows may be other pieces
    assert again.windows.lag == pytest.approx(0.12)


def test_chains_are_of_windows_and_choices_as_the_fit_has_them(monkeypatch, tmp_path):
    class Asked(Exception):
        """The robot that the problem was near, and its choices."""

    @dataclass
    class Job:
        choices: str

        def problem(self, near):
            raise Asked(near, self.choices)

    fit = SimpleNamespace(
        robot="the robot of the fit", choices="those of its calibration, too", mixed=None
    )
    nothing = ("log_folder", "_refuse_other_logs", "config_of_fit")
    for name in nothing:
        monkeypatch.setattr(sample, name, lambda *_: None)
    monkeypatch.setattr(sample, "load", lambda _: fit)
    monkeypatch.setattr(sample, "read_fit_task", lambda *_: Job("those of the config"))
    with Reporter(quiet=True) as report, pytest.raises(Asked) as asked:
        sample.sample(tmp_path, None, sample.Plan(), 1, report)
    assert asked.value.args == (fit.robot, fit.choices)
