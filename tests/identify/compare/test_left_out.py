"""Nothing of a left-out run is learnt, and what sessions share widens the regions of such runs."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from slipid.data.runs import collect
from slipid.identify.compare import folds, predictive
from slipid.identify.compare import open_loop as replay
from slipid.identify.compare.noisy_rung import Noisy
from slipid.identify.fit.optimise import optimise
from slipid.job.config import FitSection
from slipid.job.problem import Task, on_runs
from slipid.search_space import Choice
from slipid.selftest.known import Sensors, blank, grid, truth
from slipid.selftest.logs import make_logs

PLAN = grid(
    setups=(("firm", "as_built"), ("soft", "as_built")), headings=6, speeds=(0.1, 0.2), turns=0
)
QUESTION = "sectors"
CHOICES = (Choice("camera.lag", free=False), Choice("camera.scale", free=True))
fit = partial(optimise, most_rounds=3)
pytestmark = pytest.mark.slow


def garbage(log, rng):
    """The log with finite nonsense in every measured channel; what was commanded stays."""

    def noise(x):
        return rng.normal(scale=3.0, size=x.shape)

    steps = rng.uniform(-0.1, 1.0, log.wheel_angle.shape)
    return replace(
        log,
        wheel_angle=np.cumsum(steps, axis=0),
        wheel_speed=noise(log.wheel_speed),
        current=np.abs(noise(log.current)),
        voltage=noise(log.voltage),
        pose=noise(log.pose),
    )


def task_of(logs):
    data = collect(logs)
    robot = on_runs(blank(PLAN), data, (0.0, 0.0))
    return Task(data, robot, CHOICES, FitSection(windows_per_piece=3))


@pytest.fixture(scope="module")
def logs():
    """Runs of which those of one speed look longer than those of the other."""
    made = make_logs(truth(PLAN), PLAN, 1, Sensors())
    longer = [1.0 + 0.03 * np.sign(d.speed - 0.15) for d in PLAN]
    return [replace(log, pose=log.pose * [k, k, 1.0]) for log, k in zip(made, longer, strict=True)]


@pytest.fixture(scope="module")
def judged(logs):
    """Runs of the sector that is left out: 60 degrees, at both speeds and on both floors."""
    return np.flatnonzero(folds.folds_of(collect(logs), QUESTION) == 1)


@pytest.fixture(scope="module")
def learnt(logs, judged):
    task = task_of(logs)
    return folds.learn(task.problem(), CHOICES, task.dataset, QUESTION, judged, fit)


def test_nothing_of_a_left_out_run_is_learnt(logs, judged, learnt):
    """All of them but one are replaced by nonsense: fits, and what they say of that one, stay."""
    rng = np.random.default_rng(0)
    witness, spoilt = judged[0], judged[1:]
    other = task_of([garbage(log, rng) if k in spoilt else log for k, log in enumerate(logs)])
    again = folds.learn(other.problem(), CHOICES, other.dataset, QUESTION, judged, fit)
    assert len(spoilt) > 2
    same = np.testing.assert_array_equal
    same(again.optimum.state.z, learnt.optimum.state.z)
    same(again.optimum.state.log_variance, learnt.optimum.state.log_variance)
    same(again.optimum.covariance, learnt.optimum.covariance)
    for now, before in zip(again.models, learnt.models, strict=True):
        assert now.variance == before.variance, now.name
        assert any(name.startswith("session.") for name in now.variance)
        same(now.covariance, before.covariance, err_msg=now.name)
        if isinstance(now, Noisy):
            assert now.rung.state.keys() == before.rung.state.keys()
            for key, numbers in before.rung.state.items():
                same(now.rung.state[key], numbers, err_msg=f"{now.name} {key}")

    def rows(task, found):
        return judge_as(found, task, judged)[list(judged).index(witness)].to_json()

    assert rows(other, again) == rows(task_of(logs), learnt)


def judge_as(found, task, judged):
    """Rows of `judge` where all has been learnt."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(folds, "learn", lambda *_: found)
        return folds.judge(found.problem, CHOICES, task.dataset, QUESTION, judged).rows


def test_regions_of_left_out_runs_know_what_sessions_share(logs, judged, learnt, monkeypatch):
    task = task_of(logs)
    known = judge_as(learnt, task, judged)
    for model in learnt.models:
        own = {k: v for k, v in model.variance.items() if not k.startswith("session.")}
        bare = replace(model, variance=own)
        regions = [
            (model.ends(w)[1], bare.ends(w)[1])
            for w in replay.cuts(task.dataset.subset(judged), model.robot)
        ]
        for wide, plain in [*regions, [m.scale(learnt.problem)[1] for m in (model, bare)]]:
            growth = np.linalg.eigvalsh(wide - plain)[:, -1]
            assert (growth > 0.01 * np.linalg.eigvalsh(plain)[:, -1]).all(), model.name
    monkeypatch.setattr(predictive, "shared", lambda model, *_: ({}, model.covariance))
    held = partial(folds.learn, fit=lambda *_, **__: learnt.optimum)
    alone = held(task.problem(), CHOICES, task.dataset, QUESTION, judged)
    for wide, narrow in zip(learnt.models, alone.models, strict=True):
        assert np.linalg.eigvalsh(wide.covariance - narrow.covariance).max() > 0, wide.name
    for one, other in zip(known, judge_as(alone, task, judged), strict=True):
        for name, score in one.models.items():
            assert score.predicted_end == other.models[name].predicted_end
            assert score.level < other.models[name].level, name
            assert score.log_density != other.models[name].log_density, name
